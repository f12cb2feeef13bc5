"""An arm or a servo that is not as it should be before the excitation starts."""

from pathlib import Path
from typing import Any

import pytest

from hil.drivers.bus import ServoBus
from hil.errors import Cause, ExperimentError
from hil.experiment import run
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from hil.setup.session import servo_session
from tests.support.stops.stopped_runs import Arm, assert_stopped, fault, once, run_until_stopped, swing_elbow


@pytest.mark.parametrize(("where", "after"), [(servo_session, "others_on_the_bus"), (run, "_check_pose")])
def test_a_joint_that_turns_before_torque_comes_on_is_refused(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch, where: Any, after: str
) -> None:
    """Its horn slips, or another servo answers: every angle would be off, by less than the rest pose's tolerance."""
    monkeypatch.setattr(where, after, lambda *_: fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=60))
    config = arm()
    made = RunFolder.create(tmp_path / "run", config)
    said = r"'elbow'.* has turned by \+0\.092 rad since .* before torque was"
    with pytest.raises(ExperimentError, match=said) as stop:
        run_experiment(config, made, config.path, lambda _: None, plan)
    assert_stopped(ports[0])
    off = "Torque is off on all servos, confirmed by reading it back; this command has not switched it on."
    assert stop.value.__notes__ == [off]
    assert "None" not in (made.path / "events.jsonl").read_text(encoding="utf-8")


@pytest.mark.parametrize("holds", [False, True], ids=["free", "with a stabiliser"])
def test_an_arm_that_is_elsewhere_once_torque_is_on_has_moved_before_the_start(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch, holds: bool
) -> None:
    """With a stabiliser, the first sample must not differ: from the second one on, the arm is driven."""
    torque = ServoBus._torque_on

    def shift(bus: ServoBus, watchdog: float) -> None:
        torque(bus, watchdog)
        fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=60)

    monkeypatch.setattr(ServoBus, "_torque_on", shift)
    held = (("[experiment]\n", "[stabiliser]\nstiffness = [0.5, 0.2]\ndamping = [0.05, 0.02]\n\n[experiment]\n"),)
    stop, samples = run_until_stopped(arm(*(held if holds else ())), tmp_path / "run", lambda _: None, plan)
    assert stop.cause is Cause.EARLY_MOTION and "'elbow'" in str(stop) and "moved before the start: +0.09" in str(stop)
    assert len(samples) <= 2 and not samples["goal_current"].any()
    assert_stopped(ports[0])


def test_an_arm_that_moves_before_the_start(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    def push() -> None:
        swing_elbow(ports, 1.5)

    stop, samples = run_until_stopped(arm(), tmp_path / "run", once(push, Phase.REST, 10), plan)
    assert stop.cause is Cause.EARLY_MOTION
    assert set(samples["phase"]) == {Phase.REST} and not samples["goal_current"].any()
    assert_stopped(ports[0])


def test_an_arm_that_is_still_moving_when_the_rest_is_over(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm()

    def push() -> None:
        swing_elbow(ports, 0.6)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError, match=r"is moving before the start: joint 'elbow' \(ID 2.* at 0\.\d\d rad/s"):
        run_experiment(config, run, config.path, once(push, Phase.REST, 180), plan)
    assert not load_samples(run.samples_path, 2)["goal_current"][:200].any()
    assert_stopped(ports[0])


FALSE_VELOCITY = (
    r"'elbow' \(ID 2.* reports a velocity of 0\.\d\d rad/s before the start, but its position .* by 0\.000\d rad"
)
MOVES = r"^The arm is moving before the start: joint 'elbow'.* another program is commanding it, or something is push"


@pytest.mark.parametrize(("before_the_end", "said"), [(20, FALSE_VELOCITY), (1, MOVES)])
def test_a_velocity_without_motion_before_the_start_is_a_false_reading_unless_it_has_just_begun(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, before_the_end: int, said: str
) -> None:
    since = plan.rest_samples - before_the_end
    config = arm()

    def freeze() -> None:
        elbow = ports[0].bus.servos[2]
        right = elbow.present.state
        elbow.present.state = lambda position, _velocity, current: right(position, 0.5, current)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError, match=said):
        run_experiment(config, run, config.path, once(freeze, Phase.REST, since), plan)
    is_braked = Phase.BRAKING in load_samples(run.samples_path, 2)["phase"]
    assert is_braked == (said == MOVES), "no brake may rely on a false velocity"
    assert_stopped(ports[0])
