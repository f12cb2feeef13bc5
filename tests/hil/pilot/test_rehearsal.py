"""`hil dry-run` of every kind of arm that `hil init` writes simulates what `hil identify` would do."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.api.dry_run import dry_run
from hil.config.schema import Config, load_config
from hil.drivers.servo_model import Mode
from hil.dry_run.stopping_distance import Stopping, Way
from hil.dry_run.summary import DryRun, dry_run_lines
from hil.errors import NoSafeTorque
from hil.pilot import rehearsal as rehearsal_module
from hil.pilot.belief import prior_belief
from hil.pilot.gains import with_stabiliser
from hil.pilot.options import PilotOptions
from hil.setup.config_template import ArmAnswers, JointAnswers, arm_toml
from tests.support.command_line import hil
from tests.support.edits import replaced

HANGING, FLAT, UPRIGHT = (-math.pi / 2, 9.81), (0.0, 0.0), (math.pi / 2, 9.81)
ARMS = 24


def written(folder: Path, kind: tuple[float, float], joints: int = 1, swing: float = 1.2, **joint: Any) -> Path:
    """The file that `hil init` writes for such an arm, with a shorter period and half the rate."""
    rest, gravity = kind
    each = tuple(
        JointAnswers(
            f"j{number}",
            number,
            joint.get("model", "XM430-W350"),
            2048,
            rest if number == 1 else 0.0,
            1,
            swing,
            joint.get("length", 0.12),
        )
        for number in range(1, joints + 1)
    )
    path = folder / "arm.toml"
    text = arm_toml(ArmAnswers("fake://arm.toml", 1_000_000, each, gravity, "# Test."))
    shorter = ("period = 10.0 ", "period = 2.5 "), ("band = [0.1, 5.0]", "band = [0.4, 5.0]")
    text = replaced(text, ("rate = 400.0 ", "rate = 200.0 "), *shorter)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(autouse=True)
def _without_stopping_distance(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes most of the time of a dry run and has its own tests."""

    def none(config: Config, *_: object) -> Stopping:
        beyond = dict.fromkeys(Way, np.zeros(len(config.joints)))
        return Stopping(beyond, beyond)

    monkeypatch.setattr(rehearsal_module, "stopping_distance", none)


@pytest.mark.parametrize(
    ("kind", "joints"),
    [
        pytest.param(HANGING, 1, id="hanging"),
        pytest.param(FLAT, 2, id="flat-2", marks=pytest.mark.slow),
        pytest.param(UPRIGHT, 1, id="upright", marks=pytest.mark.slow),
        pytest.param(UPRIGHT, 2, id="upright-2"),
    ],
)
def test_every_arm_that_init_writes_can_be_rehearsed(tmp_path: Path, kind: tuple[float, float], joints: int) -> None:
    path = written(tmp_path, kind, joints)
    rehearsal = dry_run(path, arms=ARMS)
    assert rehearsal.is_safe and len(rehearsal.largest_peak_torque) == joints
    first = rehearsal.to_json()["first_run"]
    assert first["guard_stop_chance"] <= load_config(path).safety.limit_chance
    config = load_config(path)
    proposed = with_stabiliser(config, prior_belief(config, PilotOptions().arms)).stabiliser
    assert (proposed is None) is (kind is HANGING)
    assert (first["stabiliser"] is None) is (kind is HANGING)
    if proposed is not None:
        assert first["stabiliser"]["stiffness"] == list(proposed.stiffness)
    assert config.joints[0].drive_mode is Mode.CURRENT


def test_the_rehearsal_says_which_stabiliser_and_torque_come_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hil("dry-run", written(tmp_path, UPRIGHT), "--arms", ARMS) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "The pilot proposes a stabiliser, simulated here: stiffness = [" in printed
    assert "SAFE: the first run of the pilot starts with peak_torque = [" in printed
    assert "Chance: probability that" in printed and "hil identify" in printed


def test_where_no_torque_is_safe_for_every_arm_the_pilot_starts_with_little(tmp_path: Path) -> None:
    rehearsal = dry_run(written(tmp_path, HANGING, swing=0.03, model="XL330-M288"), arms=ARMS)
    assert rehearsal.is_safe and rehearsal.largest_peak_torque == ()
    found = rehearsal.to_json()
    assert found["largest_peak_torque"] is None and found["safe"]
    config = rehearsal.config
    most = config.joints[0].goal_limit * config.joints[0].torque_per_goal
    assert found["first_run"]["peak_torque"][0] < 0.03 * most
    assert isinstance(rehearsal.found, DryRun)
    assert "the pilot will find one" in " ".join(dry_run_lines(config, rehearsal.found.shown, rehearsal.found))


def test_an_upright_arm_without_room_is_refused_as_by_identify(tmp_path: Path) -> None:
    with pytest.raises(
        NoSafeTorque, match=r"lower position_limit of joint .* omit \[stabiliser\] so that the pilot proposes one"
    ):
        dry_run(written(tmp_path, UPRIGHT, swing=0.015), arms=ARMS)
