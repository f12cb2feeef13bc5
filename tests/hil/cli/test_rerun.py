"""`--live rerun`: what is logged, by a stand-in for the SDK; and a real recording, where the SDK is installed."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.api.progress import Progress
from hil.cli.views.rerun_view import rerun_view, wants_rerun
from hil.errors import MissingExtra, RunFolderError
from hil.experiment.stream import Progress as StreamProgress
from hil.runs.recording import Phase, missed
from tests.support.command_line import hil
from tests.support.paths import CONFIGS

ARM = CONFIGS / "fake_two_link.toml"
NAN = float("nan")


class Recording:
    """Records the calls to a RecordingStream."""

    def __init__(self, name: str) -> None:
        self.name, self.places, self.logged, self.seconds = name, [], [], []
        RECORDINGS.append(self)

    def save(self, path: str) -> None:
        self.places.append(("save", path))

    def spawn(self) -> None:
        self.places.append(("spawn", ""))

    def connect_grpc(self, url: str) -> None:
        self.places.append(("connect", url))

    def log(self, path: Any, what: Any, *, static: bool = False) -> None:
        self.logged.append((path if isinstance(path, str) else "/".join(path), what))

    def set_time(self, _: str, *, duration: float) -> None:
        self.seconds.append(duration)

    def flush(self, *, timeout_sec: float) -> None:
        self.places.append(("flush", ""))

    def disconnect(self) -> None:
        self.places.append(("end", ""))


RECORDINGS: list[Recording] = []


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    RECORDINGS.clear()
    shapes = {name: (lambda values, name=name: (name, values)) for name in ("Scalars", "TextLog", "LineStrips2D")}
    monkeypatch.setitem(sys.modules, "rerun", SimpleNamespace(RecordingStream=Recording, **shapes))
    return RECORDINGS


def report(taken: int, position: tuple[float, float]) -> Progress:
    state = missed([0.1, 0.2], 0.0)._replace(position=position, velocity=(0.5, NAN), current=(0.1, NAN))
    return Progress("experiment", stream=StreamProgress(taken, 1000, Phase.PERIODIC, "identify", state))


def test_curves_and_arm_are_logged_and_time_goes_on_from_run_to_run(sdk: list[Recording]) -> None:
    with rerun_view("rerun", ARM) as show:
        show(report(400, (0.0, 0.0)))
        show(report(800, (0.0, NAN)))
        show(report(20, (0.0, 0.0)))  # the next run of a pilot
        show(Progress("experiment", "Pilot, peak torque 0.1 N m"))
    (recording,) = sdk
    assert recording.places == [("spawn", ""), ("flush", ""), ("end", "")]
    assert recording.seconds == pytest.approx([1.0, 2.0, 2.05])
    logged = dict(recording.logged)
    assert logged["shoulder/position [rad]/measured"] == ("Scalars", [0.0])
    assert logged["shoulder/position [rad]/highest"] == ("Scalars", [1.06])
    assert logged["elbow/drive [A]/goal"] == ("Scalars", [0.2])
    assert "elbow/velocity [rad/s]" not in logged, "a servo that did not answer has no value"
    assert logged["messages"] == ("TextLog", "Pilot, peak torque 0.1 N m")


def test_a_stretched_arm_is_drawn_to_the_right(sdk: list[Recording]) -> None:
    with rerun_view("rerun", CONFIGS / "first_time.toml") as show:
        show(report(1, (0.0, 0.0)))
        show(report(2, (0.0, 0.0)))
    (_, (corners,)) = dict(sdk[0].logged)["arm"]
    assert sum(corners, ()) == pytest.approx((0.0, 0.0, 0.147, 0.0, 0.327, 0.0))


@pytest.mark.parametrize(
    ("live", "place"),
    [
        ("rerun:watch.rrd", ("save", "watch.rrd")),
        ("rerun:rerun+http://localhost:9876/proxy", ("connect", "rerun+http://localhost:9876/proxy")),
    ],
)
def test_places(sdk: list[Recording], live: str, place: tuple[str, str]) -> None:
    assert wants_rerun(live) and not wants_rerun("rerunning")
    with rerun_view(live, ARM):
        pass
    assert sdk[0].places[0] == place


def test_a_folder_that_is_not_there(sdk: list[Recording]) -> None:
    with (
        pytest.raises(RunFolderError, match="the folder nowhere does not exist"),
        rerun_view("rerun:nowhere/a.rrd", ARM),
    ):
        pass


def test_without_the_sdk_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match=r"pip install 'hil\[rerun\]'"), rerun_view("rerun", ARM):
        pass


def test_another_place_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("record", ARM, "--out", tmp_path / "run", "--live", "paper") == 2
    assert "must be terminal, rerun" in " ".join(capsys.readouterr().err.split())


def test_a_real_recording_holds_every_joint(arm_file: Any, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    file = tmp_path / "watch.rrd"
    assert hil("record", arm_file(), "--out", tmp_path / "run", "--live", f"rerun:{file}") == 0
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(file)]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
    for joint in ("shoulder", "elbow"):
        assert joint in printed
    assert "velocity" in printed and "arm" in printed
