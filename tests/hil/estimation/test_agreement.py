"""Recordings of one arm whose load was changed in between are said to disagree."""

from dataclasses import replace

import numpy as np
import pytest

from hil.estimation.unsettled.agreement import disagreement
from hil.estimation.unsettled.warnings import doubts_of
from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import estimate_by_shooting
from hil.estimator.models.model import Model
from hil.fakes.plants.plant import make_plant
from tests.support.recorded_arm import SERVO, STEP, servo_arm


def swing(heavier: float, seed: int) -> Recording:
    """Four seconds of a pendulum whose link has `heavier` times its mass."""
    arm = servo_arm({}, 1)
    link = arm.links[0]
    update = {"mass": link.mass * heavier, "inertia": link.inertia * heavier}
    arm = arm.model_copy(update={"links": (link.model_copy(update=update),)})
    random = np.random.default_rng(seed)
    time = np.arange(1600) / 400.0
    torque = 0.3 * np.sin(np.outer(random.uniform(2.0, 9.0, 4), time) + random.uniform(0.0, 6.0, (4, 1))).sum(axis=0)
    plant = make_plant(arm)
    position = np.empty(time.size)
    for k, now in enumerate(time):
        plant.advance(now, [torque[k - 1] / SERVO["torque_constant"] if k else 0.0])
        (position[k],) = plant.position
    return Recording(time, torque[None], np.round(position / STEP)[None] * STEP, np.array([STEP]), between="held")


def test_a_torque_that_is_logged_after_it_acted_is_named() -> None:
    """Each torque is stored two samples late."""
    recording = swing(1.0, 1)
    late = replace(recording, torque=np.roll(recording.torque, 2, axis=1))
    said = []
    for each in (recording, late):
        start = fit_inverse_dynamics([each], 8.0, 0.05).value
        estimate = estimate_by_shooting([each], Model(1), start)
        said.append([one for one in doubts_of([each], estimate).warnings if "delay" in one])
    assert said[0] == []
    assert said[1][0].startswith("The delay is negative, -5") and "(2 samples)" in said[1][0]


@pytest.mark.parametrize("heavier", [1.0, 1.2])
def test_a_load_that_changed_between_two_files_is_named(heavier: float) -> None:
    recordings = [swing(1.0, 1), swing(heavier, 2)]
    start = fit_inverse_dynamics(recordings, 8.0, 0.05).value
    estimate = estimate_by_shooting(recordings, Model(1), start)
    said = disagreement(recordings, ("a.csv", "b.csv"), estimate, 1.0, zeros=False)
    if heavier == 1.0:
        assert said == ()
    else:
        assert "The recordings disagree" in said[0] and "Estimate each separately" in said[0]
        assert "gravity_1 is" in said[0] and "in a.csv and" in said[0] and "in b.csv" in said[0]
