"""Prediction of a settled period that was not used for the fit, from its torque and the state one period earlier."""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate, predict
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.closed_loop import Stabilised
from hil.estimator.simulation.drive import motor_torque
from hil.estimator.simulation.encoder import measured, without_errors


def predict_period(estimate: Estimate, other: SettledPeriod) -> Array:
    """Predict the positions (joints, samples) [rad] of another settled period from `estimate`.

    The simulation starts one period earlier from the measured state, since a motion that counts as settled may still
    contain the end of a transient, and then uses only the torque. If the earlier state is not known, the arm is
    simulated from rest until its motion repeats.

    Raises PeriodicityError if the simulated motion never repeats.
    """
    if other.before is not None:
        return _from_before(Physics.of(estimate.parameters), other, other.before)
    if other.stabiliser is None:
        return predict(estimate, other.torque, other.rate, other.command_to_sample)
    pose = other.stabiliser.feedback.pose
    return other.stabiliser.settled_positions(
        Physics.of(estimate.parameters), pose, other.rate, other.command_to_sample
    )


def _from_before(physics: Physics, other: SettledPeriod, before: Array) -> Array:
    """Return the mean of all simulated periods but the first, which starts in the state `before` (2, joints)."""
    start = np.stack((without_errors(physics, before[0][:, None])[:, 0], before[1]))
    periods = (
        _free(physics, other, start) if other.stabiliser is None else _held(physics, other, other.stabiliser, start)
    )
    return measured(physics, np.mean(periods[1:], axis=0))


def _free(physics: Physics, other: SettledPeriod, state: Array) -> list[Array]:
    steps = steps_per_sample(other.rate)
    of = other.torque, other.rate, other.command_to_sample, steps
    torque = motor_torque(*of, delay=physics.delays, lag=physics.lags)
    periods = []
    for _ in range(1 + other.periods):
        position, state = simulate(physics, state, torque, 1.0 / (other.rate * steps))
        periods.append(position)
    return periods


def _held(physics: Physics, other: SettledPeriod, stabiliser: Stabilised, start: Array) -> list[Array]:
    """Return the simulated periods, with the stabiliser's feedback computed from the simulated state."""
    former = np.stack((start[0] - start[1] / other.rate, start[1]))
    state = np.concatenate((start, stabiliser.former_torque[None], former))
    periods = []
    for _ in range(1 + other.periods):
        position, state = stabiliser.continued(physics, state, other.rate, other.command_to_sample)
        periods.append(position)
    return periods
