"""A period that was not fitted is predicted from the state one period earlier, transient included."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np

from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.selection.other_period import predict_period
from hil.estimator.simulation.closed_loop import Feedback, Stabilised, respond, resting
from tests.support.recorded_arm import RATE, STEP, wave

# Little damping: the start is not forgotten within one period.
ARM = {
    **{"inertia_1": 0.02, "gravity_1": 0.6, "viscous_1": 0.02, "coulomb_1": 0.002, "coulomb_width_1": 0.05},
    "lag": 1e-3,
}
POSE = np.array([-np.pi / 2])


def estimate(parameters: dict[str, float]) -> Estimate:
    start = np.stack((POSE, np.zeros(1)))
    return cast(Estimate, SimpleNamespace(parameters=parameters, start=start, model=SimpleNamespace(joints=1)))


def second_period(feedback: Feedback, offset: float, error: float = 0.0) -> SettledPeriod:
    """The second period after a start that is `offset` [rad] away from rest, read with an error once per turn."""
    torque, physics = wave(3, [0.25], 4.0).torque, Physics.of(ARM)
    state = resting(POSE + offset)
    first = respond(physics, state, torque, RATE, feedback)
    second = respond(physics, first.state, torque, RATE, feedback)

    def read(position: np.ndarray) -> np.ndarray:
        return np.asarray(position + error * np.sin(position))

    stabilised = Stabilised(feedback, torque, np.stack((POSE, np.zeros(1))), np.zeros(1))
    return SettledPeriod(
        RATE,
        second.torque,
        np.round(read(second.position) / STEP) * STEP,
        0.0,
        np.array([STEP]),
        before=np.stack((read(POSE + offset), np.zeros(1))),
        stabiliser=stabilised if feedback.stiffness.any() else None,
    )


def test_what_is_left_of_a_transient_is_predicted() -> None:
    other = second_period(Feedback.none(1), 0.2)
    settled = relative_error(other.position, predict_period(estimate(ARM), replace(other, before=None)))
    found = relative_error(other.position, predict_period(estimate(ARM), other))
    assert found[0] < 0.01 < settled[0]


def test_so_it_is_with_a_stabiliser() -> None:
    feedback = Feedback(np.array([0.3]), np.array([0.002]), POSE, np.array([5.0]))
    other = second_period(feedback, 0.4)
    settled = relative_error(other.position, predict_period(estimate(ARM), replace(other, before=None)))
    found = relative_error(other.position, predict_period(estimate(ARM), other))
    assert found[0] < 0.01 and found[0] < 0.5 * settled[0]


def test_the_start_is_what_the_encoder_read() -> None:
    other = second_period(Feedback.none(1), 0.2, error=0.02)
    bent = estimate({**ARM, "encoder_sin_once_1": 0.02})
    assert relative_error(other.position, predict_period(bent, other))[0] < 0.01
