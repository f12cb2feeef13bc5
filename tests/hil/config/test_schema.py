"""The TOML schema: both fake arms load; every kind of error names file, key, value and what is allowed."""

from pathlib import Path

import pytest

from hil.config.schema import load_config, parse_config
from hil.errors import ConfigError
from hil.fakes.bus.hand import parse_move
from hil.fakes.servo.encoder import Encoder
from tests.support.paths import CONFIGS

REALISTIC = (CONFIGS / "fake_two_link.toml").read_text(encoding="utf-8")


def change(old: str, new: str) -> str:
    assert REALISTIC.count(old) >= 1, f"{old!r} is not in the file that this test changes"
    return REALISTIC.replace(old, new, 1)


def test_a_path_is_text_or_a_path() -> None:
    path = CONFIGS / "fake_two_link.toml"
    assert load_config(str(path)) == load_config(path)
    assert load_config("fake_two_link").joints == load_config(path).joints


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_ready_file_is_right(path: Path) -> None:
    config = load_config(path)
    assert len(config.joints) == len(
        config.experiment.peak_torque
        or config.arm.link_lengths
        or (config.joint_path and config.joint_path.centre)
        or config.arm.rest_pose
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rate = 400.0 ", "rate = true ", r"experiment\.rate = true: must be a number"),
        ("rate = 400.0 ", 'rate = "fast" ', r"experiment\.rate = 'fast': must be a number"),
        ("rate = 400.0 ", "rate = 5.0 ", r"experiment\.rate = 5\.0: must be at least 20"),
        ("rate = 400.0 ", "rate = nan ", r"experiment\.rate = nan: must be"),
        ("rate = 400.0 ", "rate = 400.05 ", r"rate \* period = 4000\.5 must be a whole number.*period = 9\.99875"),
        ("rate = 400.0 ", "rrate = 400.0 ", r"experiment\.rrate is not a known key; did you mean rate\?"),
        ("seed = 1", "colour = 1", r"experiment\.colour is not a known key; allowed: rate, period"),
        ("[experiment]", "[experimentt]", r"experimentt is not a known key; did you mean experiment\?"),
        ('model = "XM430-W350"', 'model = "XC430-W240"', r"joints\[1\]\.model = 'XC430-W240': must be one of 'XM430-W"),
        ('model = "XM430-W350"', 'model = "XM430-W351"', r"joints\[1\]\.model = 'XM430-W351': did you mean XM430-W350"),
        ('model = "XM430-W350"', 'model = "a motor"', r"joints\[1\]\.model = 'a motor': must be one of"),
        ("id = 2", "id = 1", r"two joints have the same id 1"),
        ("id = 2", "id = 300", r"joints\[2\]\.id = 300: must be at most 252"),
        ("id = 2", "id = 2.5", r"joints\[2\]\.id = 2\.5: must be a whole number"),
        ("direction = 1 ", "direction = 2 ", r"joints\[1\]\.direction = 2: must be one of -1 or 1"),
        ("direction = 1 ", "direction = true ", r"joints\[1\]\.direction = true: it must be 1, or -1"),
        ("seed = 1\n", "seed = 99999999999999999999999\n", r"experiment\.seed = 9+: must be at most"),
        ("[-4.2, 1.06]", "[1.06, -4.2]", r"the first value must be the smaller one"),
        ("[-4.2, 1.06]", "[-4.2]", r"joints\[1\]\.position_limit = \[-4\.2\]: must have exactly 2 entries"),
        ("[arm]\n", "[arm]\nbase = [0, 0.5]\n", r"arm\.base = \[0, 0\.5\]: must have exactly 3 entries"),
        (
            "zero_ticks = 2048",
            "zero_ticks = [2048, 1902]",
            r"zero_ticks = \[2048, 1902\]: .* for two servos, give the first",
        ),
        ("[-4.2, 1.06]", "[-1.2, 1.06]", r"arm\.rest_pose: -1\.5708 rad for joint 'shoulder' is outside"),
        ("[0.80, 0.42]", "[0.80]", r"experiment\.peak_torque has 1 entry; it needs 2"),
        ("[0.80, 0.42]", "[4.0, 0.42]", r"peak_torque: 4 N m for joint 'shoulder' is more than current_limit"),
        ("band = [0.1, 5.0]", "band = [5.0, 0.1]", r"band = \[5\.0, 0\.1\]: must satisfy 0 < low < high"),
        ("band = [0.1, 5.0]", "lines = [[1, 2], [2, 3]]", r"two joints share a harmonic"),
        ("band = [0.1, 5.0]", "", r"give either band or lines"),
        ("baud = 1_000_000", "baud = 1234", r"port\.baud = 1234: must be one of 9600"),
        ("torque_constant = 1.80 ", "", r"joints\[1\]: torque_constant is missing; current"),
        ("mass = 0.180 ", "mass = -1.0 ", r"fake\.arm\.links\[1\]\.mass = -1\.0: must be at least 0"),
        ("mass = 0.180 ", 'mass = "0.18" ', r"fake\.arm\.links\[1\]\.mass = '0\.18': must be a number"),
        ("gear_ratio = 353.5", "gear = 353.5", r"fake\.arm\.drives\[1\]\.gear is not a known key; .*gear_ratio"),
        (
            "[experiment]",
            "[safety]\nwatchdog = 0.05\n[experiment]",
            r"safety\.watchdog.*must be a multiple of 0\.02 s",
        ),
        ("url =", "url ", r"not valid TOML"),
        ('friction = "stribeck"', 'friction = "auto"\npresliding = true', r"chooses presliding.*: remove them"),
        ("[model]", "[model]\ntorque_scale = 1", r"model\.torque_scale = 1: must be true or false"),
    ],
)
def test_a_fault_names_key_value_and_what_is_allowed(old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        parse_config(change(old, new), Path("arm.toml"))
    assert str(caught.value).startswith("arm.toml: ")


def test_one_joint_has_no_ratio_of_torque_constants() -> None:
    path = CONFIGS / "fake_pendulum.toml"
    text = path.read_text(encoding="utf-8").replace("[model]\n", "[model]\ntorque_scale = true\n")
    with pytest.raises(ConfigError, match=r"model\.torque_scale compares two joints' torque constants"):
        parse_config(text, path)


def test_all_faults_are_told_at_once() -> None:
    text = change("rate = 400.0", "rate = -1").replace("id = 2", "id = 300", 1)
    with pytest.raises(ConfigError, match=r"(?s)2 errors:.*joints\[2\]\.id.*experiment\.rate"):
        parse_config(text, Path("arm.toml"))


def test_fake_url_without_a_fake_arm() -> None:
    with pytest.raises(ConfigError, match=r"needs a \[fake\] table"):
        parse_config(REALISTIC[: REALISTIC.index("\n[fake]")], Path("arm.toml"))


def test_a_real_port_needs_no_fake_arm() -> None:
    text = change('"fake://" ', '"/dev/ttyUSB0" ')
    config = parse_config(text[: text.index("\n[fake]")], Path("arm.toml"))
    assert config.url == "/dev/ttyUSB0"
    assert not config.is_fake


def test_an_absent_file_and_one_that_is_no_text(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml cannot be read: No such file"):
        load_config(tmp_path / "nowhere.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match=r"binary\.toml cannot be read: it is not UTF-8"):
        load_config(binary)
    with pytest.raises(ConfigError, match=r"cannot be read: it is a folder; did you mean .*binary\.toml\?$"):
        load_config(tmp_path)
    (tmp_path / "other.toml").touch()
    with pytest.raises(ConfigError, match=r"cannot be read: it is a folder\. Name a TOML file\.$"):
        load_config(tmp_path)
    for here in ("", "."):
        with pytest.raises(
            ConfigError, match=r"^\. cannot be read: it is the current folder \(an empty name means the same\)"
        ):
            load_config(here)


def test_a_misspelt_bundled_name_is_guessed() -> None:
    with pytest.raises(ConfigError, match="Did you mean the bundled configuration fake_two_link"):
        load_config(Path("fake_two_lnk"))
    with pytest.raises(ConfigError, match="Did you mean the bundled configuration fake_two_link"):
        load_config(Path("no_such_folder/fake_two_link.toml"))
    with pytest.raises(ConfigError, match="Bundled configurations: fake_horizontal, "):
        load_config(Path("no_such_arm_at_all"))


def test_an_angle_that_was_rounded_is_within_its_bounds() -> None:
    """Pi and its multiples, written with four digits, are larger than they are."""
    text = (CONFIGS / "fake_two_link.toml").read_text(encoding="utf-8")
    flat = text.replace("[fake.arm]\n", "[fake.arm]\ntilt = 1.5708\n", 1).replace(
        "[arm]\n", "[arm]\nrest_tolerance = 3.1416\n"
    )
    assert parse_config(flat, Path("arm.toml")).fake is not None
    with pytest.raises(ConfigError, match=r"tilt = 1\.58: must be at most 1\.571"):
        parse_config(flat.replace("1.5708", "1.58"), Path("arm.toml"))
    assert Encoder(once_phase=6.2832).once_phase > 6.28 and parse_move("2:to=12.567").to == 12.567
