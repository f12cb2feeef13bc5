"""While only a stabiliser drives the arm, no joint may leave its rest pose."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config.schema import load_config
from hil.errors import Cause, SafetyStop
from hil.experiment.held_at_rest import AWAY_RAD, OVERSHOOT, HeldAtRest
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress
from hil.plan.plan import make_plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder

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
