"""A run stopped because this computer was late is repeated; one stopped by the arm or a fault is not."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.config.schema import Config
from hil.errors import Cause, SafetyStop
from hil.pilot.punctual import MOST_REPEATS, punctual
from hil.runs.run_folder import RunFolder

Arm = Callable[..., Config]


class Plays:
    """A run stopped by each cause in turn, then finished; each time it leaves a recording in the folder."""

    def __init__(self, folder: RunFolder, *causes: Cause) -> None:
        self.folder = folder
        self.causes = list(causes)
        self.times = 0

    def __call__(self) -> str:
        assert not self.folder.samples_path.exists(), "the previous recording has been set aside"
        self.times += 1
        self.folder.samples_path.write_text(f"recording {self.times}")
        if not self.causes:
            return "Torque is off."
        stop = SafetyStop("50 ms without a command.", self.causes.pop(0))
        stop.add_note("Torque is off on both servos.")
        raise stop


def test_a_late_computer_repeats_a_run_and_keeps_what_was_recorded(arm: Arm, tmp_path: Path) -> None:
    config = arm()
    folder = RunFolder.create(tmp_path / "run", config)
    plays, said = Plays(folder, Cause.LATE, Cause.LATE), []
    assert punctual(plays, config, folder, "Pilot", said.append) == "Torque is off."
    assert [line.splitlines()[0] for line in said] == [
        "Pilot ended early: 50 ms without a command. Torque is off on both servos."
    ] * 2
    kept = [(folder.path / each / folder.samples_path.name).read_text() for each in ("late-1", "late-2", ".")]
    assert kept == ["recording 1", "recording 2", "recording 3"]


def test_a_computer_that_stays_late_gets_its_stop(arm: Arm, tmp_path: Path) -> None:
    config = arm()
    folder = RunFolder.create(tmp_path / "run", config)
    plays = Plays(folder, *[Cause.LATE] * 9)
    with pytest.raises(SafetyStop, match="without a command"):
        punctual(plays, config, folder, "Pilot", lambda _: None)
    assert plays.times == 1 + MOST_REPEATS


@pytest.mark.parametrize("cause", [cause for cause in Cause if cause is not Cause.LATE])
def test_any_other_stop_is_final(arm: Arm, tmp_path: Path, cause: Cause) -> None:
    config = arm()
    folder = RunFolder.create(tmp_path / "run", config)
    plays = Plays(folder, cause)
    with pytest.raises(SafetyStop):
        punctual(plays, config, folder, "Pilot", lambda _: None)
    assert plays.times == 1
