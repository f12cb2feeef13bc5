"""While only a stabiliser drives the arm, no joint may leave its rest pose."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config.schema import load_config
from hil.errors import Cause, SafetyStop
from hil.experiment.guard import Guard
from hil.experiment.held_at_rest import AWAY_RAD, OVERSHOOT, HeldAtRest
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress
from hil.plan.plan import make_plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.motion import STILL

UPRIGHT = load_config("fake_inverted")
POSE = np.array(UPRIGHT.arm.rest_pose)


@given(start=st.tuples(*2 * [st.floats(-0.5, 0.5)]), share=st.floats(-1.0, 1.0))
def test_a_joint_may_swing_as_far_as_the_arm_was_away_and_a_little_more(
    start: tuple[float, float], share: float
) -> None:
    held = HeldAtRest(UPRIGHT, POSE + start)
    allowed = OVERSHOOT * max(map(abs, start)) + AWAY_RAD
    assert held.look(POSE + share * 0.999 * allowed) is None
    for joint in range(2):
        away = POSE.copy()
        away[joint] -= 1.001 * allowed
        found = held.look(away)
        assert found is not None and found[0] == joint and f"{-1.001 * allowed:+.3f} rad" in found[1]


@pytest.mark.parametrize(("known", "stops"), [(True, False), (False, True)])
def test_how_far_the_arm_was_away_before_torque_was_on_counts(known: bool, stops: bool) -> None:
    """If that is not known, the first sample counts: the stabiliser may have moved the arm by then."""
    guard, pose = Guard(UPRIGHT), tuple(POSE)
    if known:
        guard.rests_at((pose[0] + 0.4, pose[1]))
    guard.look_while_held(STILL._replace(position=pose))
    away = STILL._replace(position=(pose[0] + 0.3, pose[1]))
    if stops:
        with pytest.raises(SafetyStop, match="rad from its rest pose"):
            guard.look_while_held(away)
    else:
        guard.look_while_held(away)


@pytest.mark.parametrize("velocity", [0.3, 3.0])
def test_an_upright_arm_that_something_pushes_before_the_start_is_stopped(
    tmp_path: Path, ports: list[Any], velocity: float
) -> None:
    """The spring would pull back a joint that is pushed by 0.5 rad only once the hand lets go."""
    pushed: list[float] = []

    def push(progress: Progress) -> None:
        if progress.phase is Phase.REST and progress.taken >= 20 and not pushed:
            plant = ports[0].bus.plant
            pushed.append(plant.position[1])
            plant._state = (*plant._state[:3], velocity, *plant._state[4:])
        if progress.phase is Phase.RAMP_IN:
            raise KeyboardInterrupt

    run = RunFolder.create(tmp_path / "run", UPRIGHT)
    with pytest.raises((SafetyStop, KeyboardInterrupt)) as stop:
        run_experiment(UPRIGHT, run, UPRIGHT.path, push, make_plan(UPRIGHT).first_segment())
    if velocity < 1.0:
        assert stop.type is KeyboardInterrupt, "a small push is no reason to stop"
        return
    assert isinstance(stop.value, SafetyStop) and stop.value.cause is Cause.EARLY_MOTION
    assert "'elbow'" in str(stop.value) and "rad from its rest pose, but the stabiliser should hold" in str(stop.value)
    angle = load_samples(run.samples_path, 2)["position"][:, 1]
    assert abs(angle[-1] - pushed[0]) < 0.3
