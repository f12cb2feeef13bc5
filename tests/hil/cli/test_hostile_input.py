"""Malicious or suspicious files: code in a TOML file, names that contain markup, archive bombs."""

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.errors import ConfigError, RunFolderError
from hil.fakes.description import load_fake
from hil.fakes.pty_server import LinkError, PtyServer
from hil.runs.period_file import load_periods
from hil.runs.recording import load_samples
from hil.runs.recording_folder import load_recordings
from hil.runs.run_folder import RunFolder
from tests.support.command_line import hil
from tests.support.edits import QUICK

ArmFile = Callable[..., Path]


def with_plant(arm_file: ArmFile, plant: str) -> Path:
    path = arm_file()
    head, fake = path.read_text(encoding="utf-8").split("[fake.arm]")
    del fake
    path.write_text(head.replace("[fake]\n", f"[fake]\n{plant}\n"), encoding="utf-8")
    return path


@pytest.mark.parametrize("command", ["check", "scan", "init", "fake"])
def test_a_file_runs_no_command(
    arm_file: ArmFile, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "made"
    path = with_plant(arm_file, f'plant = "os:system"\nplant_options = {{ command = "touch {made}" }}')
    options = ["--pty"] if command == "fake" else []
    assert hil(command, path, *options) != 0
    assert not made.exists()
    said = capsys.readouterr()
    assert "--allow-code" in said.out + said.err
    assert hil(command, path, *options, "--allow-code") != 0, "its return value is not a plant"
    assert made.exists()
    made.unlink()
    assert hil(command, path, *options) != 0 and not made.exists(), "permission applies to one command only"


def test_a_link_made_by_somebody_else_while_the_cable_was_out_stays(arm_file: ArmFile, tmp_path: Path) -> None:
    link = tmp_path / "link"
    server = PtyServer(load_fake(arm_file()), link)
    server._unplug()
    link.write_text("mine")
    with pytest.raises(LinkError, match="created by another program"):
        server._plug_in()
    server.close()
    assert link.read_text() == "mine"


@pytest.mark.usefixtures("few_stops")
def test_a_name_that_is_markup_is_a_name(arm_file: ArmFile, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("[/red]é中--", "<b>&\"'&amp;]]>")
    quoted = [name.replace("\\", "\\\\").replace('"', '\\"') for name in names]
    lengths = ("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.18]\n")
    named = [(f'name = "{old}"', f'name = "{new}"') for old, new in zip(("shoulder", "elbow"), quoted, strict=True)]
    path = arm_file(*QUICK, lengths, *named)
    run = tmp_path / "run"
    assert hil("identify", path, "--out", run) == 0
    assert hil("check", path) == 0
    assert hil("dry-run", path, "--arms", 20) in (0, 1)
    said = capsys.readouterr().out
    assert "inertia_2" in said and all(name in said for name in names)
    assert hil("export", run, "--format", "urdf", "--format", "mjcf") == 0
    for file in (*run.rglob("*.urdf"), *run.rglob("*.xml")):
        assert {*names} <= {element.get("name") for element in ET.parse(file).iter("joint")}
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "<b>&" not in page


@pytest.mark.parametrize("name", ["a\\u0007b", "a\\nb", "\\u001b[31m", "\\u202e", "\\u200b"])
def test_control_characters_are_no_name(arm: Callable[..., Config], name: str) -> None:
    with pytest.raises(
        ConfigError, match=r"name = .*: must not contain line breaks, tabs or other unprintable characters"
    ):
        arm(('name = "elbow"', f'name = "{name}"'))


def test_an_archive_that_bursts_is_not_read(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = identified / "period.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("identify_rate.npy", "w") as file:
        for _ in range(64):
            file.write(bytes(2**20))
    assert path.stat().st_size < 2**17
    with pytest.raises(RunFolderError, match="64 MB"):
        load_periods(identified)
    assert hil("report", identified) == 2
    assert "not read" in capsys.readouterr().err


@pytest.mark.parametrize("read", [load_periods, load_recordings])
@pytest.mark.parametrize("content", [b"\xff\xfePK", b"", b"PK\x03\x04 cut off"])
def test_a_damaged_archive_is_named_without_advice_to_unpickle_it(
    read: Callable[[Path], object], content: bytes, tmp_path: Path
) -> None:
    for name in ("period.npz", "recordings.npz"):
        (tmp_path / name).write_bytes(content)
    with pytest.raises(RunFolderError, match=r"\.npz cannot be read: ") as caught:
        read(tmp_path)
    assert "pickle" not in str(caught.value)


def test_a_link_to_nowhere_is_not_called_a_missing_file(tmp_path: Path) -> None:
    for name in ("config.toml", "samples.npy"):
        (tmp_path / name).touch()
    (tmp_path / "run.json").symlink_to("run.json")
    with pytest.raises(RunFolderError, match=r"run\.json is a broken link"):
        RunFolder.open(tmp_path)


def test_an_array_that_promises_more_than_it_holds_is_not_read(identified: Path, tmp_path: Path) -> None:
    path = identified / "samples.npy"
    rows = load_samples(path, 2)
    short = tmp_path / "short.npy"
    with short.open("wb") as file:
        header: dict[str, Any] = {
            "descr": np.lib.format.dtype_to_descr(rows.dtype),
            "fortran_order": False,
            "shape": (10**12,),
        }
        np.lib.format.write_array_header_1_0(file, header)
        file.write(rows[:10].tobytes())
    shutil.copy(short, path)
    with pytest.raises(RunFolderError, match="its header declares"):
        load_samples(path, 2)


def test_a_file_may_name_the_plants_of_the_package(arm_file: ArmFile) -> None:
    path = with_plant(arm_file, 'plant = "hil.fakes.plants.independent:make_plant"\nplant_options = { joints = [] }')
    assert load_config(path).fake is not None
    assert hil("check", path) != 0
