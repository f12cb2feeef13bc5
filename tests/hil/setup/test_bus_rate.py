"""The rate that `hil check` measures on the fake bus, whose wire takes the time of a real one."""

import re
from pathlib import Path

import hil
from tests.support.paths import CONFIGS

SERVOS = ((1, 1), (2, 2), (3, 2), (4, 3), (5, 3), (6, 4))  # ID, joint


def six_servos(folder: Path, baud: str) -> Path:
    """An arm of four joints, two of them with a second servo, at 400 Hz."""
    text = (CONFIGS / "open_manipulator_x.toml").read_text(encoding="utf-8")
    text = text.replace('urdf = "', f'urdf = "{CONFIGS}/').replace("baud = 1_000_000", f"baud = {baud}")
    text = re.sub(r"^rate = .*$", "rate = 400.0", text, flags=re.MULTILINE)
    real, fake = text.split("[fake]")
    ids = iter(("1", "[2, 3]", "[4, 5]", "6"))
    real = re.sub(r"^id = .*$", lambda _: f"id = {next(ids)}", real, flags=re.MULTILINE)
    before, after = fake.split("[[fake.servos]]")[0], fake[fake.index("[fake.chain]") :]
    servos = "".join(
        f'[[fake.servos]]\nid = {number}\njoint = {joint}\nmodel = "XM430-W350"\nbaud = {baud}\nzero_ticks = 2048\n'
        for number, joint in SERVOS
    )
    path = folder / "arm.toml"
    path.write_text(f"{real}[fake]{before}{servos}{after}", encoding="utf-8")
    return path


def rate_of(path: Path) -> tuple[int, bool]:
    """The rate that is possible [Hz] and whether it is enough."""
    (finding,) = [each for each in hil.check(path).findings if each.what == "rate"]
    found = re.search(r"(\d+) Hz possible", finding.found)
    assert found, finding
    return int(found[1]), not finding.fix


def test_six_servos_with_shadows_hold_400_hz_at_1_mbaud(tmp_path: Path) -> None:
    possible, enough = rate_of(six_servos(tmp_path, "1_000_000"))
    assert enough and possible >= 400


def test_a_slower_bus_does_not_and_says_so(tmp_path: Path) -> None:
    possible, enough = rate_of(six_servos(tmp_path, "115_200"))
    assert not enough and possible < 150
