"""Prediction errors of given parameters on recordings that were not used to estimate them."""

from collections.abc import Mapping, Sequence

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import PeriodicityError
from hil.estimator.fit.multiple_shooting import ALL, Shooting
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.options import SettlingOptions
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.drive import motor_torque
from hil.estimator.simulation.encoder import measured

LEAST_WIDTH = 1e-3  # rad/s: width of the smoothed Coulomb step for methods that do not estimate one
SETTLING = SettlingOptions(max_periods=20, atol=1e-6)


def prediction_rms(
    recordings: Sequence[Recording],
    parameters: Mapping[str, float],
    length: float,
    joints: int,
    zeros: Array | None = None,
    of: slice = ALL,
) -> Array:
    """Return the RMS of measured minus simulated position (joints,) [rad] over all segments.

    Arguments as in `prediction_errors`.
    """
    errors, samples = prediction_errors(recordings, parameters, length, joints, zeros, of)
    rms: Array = np.sqrt(samples @ errors**2 / samples.sum())
    return rms


def prediction_errors(
    recordings: Sequence[Recording],
    parameters: Mapping[str, float],
    length: float,
    joints: int,
    zeros: Array | None = None,
    of: slice = ALL,
) -> tuple[Array, Array]:
    """Predict segments of recordings; return RMS errors (segments, joints) [rad] and numbers of samples (segments,).

    The simulation is restarted for every segment from the angle and velocity estimated from the surrounding samples,
    and then uses only the torque. A diverging simulation counts as an error of pi rad.

    Args:
        recordings: recordings of one arm.
        parameters: parameters by name, as in `Model.names` [SI].
        length: length of a segment [s].
        joints: number of joints.
        zeros: true minus measured angle of each recording (recordings, joints) [rad], overriding `parameters`.
        of: the segments of each recording to use.
    """
    problem = Shooting(recordings, Model(joints), length, of=of)
    known = _complete(parameters, joints)
    shifts: list[dict[str, float]] = [{} for _ in recordings] if zeros is None else [_zeros(row) for row in zeros]
    physics = [Physics.of(known | shift) for shift in shifts]
    rms, samples = [], []
    for segment in problem.segments:
        error = segment.position - problem.position(segment, physics[segment.recording], segment.state)
        error = np.where(np.isfinite(segment.position), error, 0.0)
        error = np.clip(np.nan_to_num(error, nan=np.pi, posinf=np.pi, neginf=-np.pi), -np.pi, np.pi)
        rms.append(np.sqrt(np.mean(error**2, axis=1)))
        samples.append(error.shape[1])
    return np.stack(rms), np.array(samples, dtype=np.float64)


def settled_prediction_error(period: SettledPeriod, parameters: Mapping[str, float]) -> Array:
    """Return the relative error of an open-loop prediction of a settled period (joints,).

    This is the RMS of measured minus predicted position divided by the RMS of the motion. The arm starts at rest at the
    period's mean position and is simulated under the period's torque until the motion repeats; no other measurement is
    used. Raises PeriodicityError if the motion does not become periodic.
    """
    physics = Physics.of(_complete(parameters, period.joints))
    steps = steps_per_sample(period.rate)
    step = 1.0 / (period.rate * steps)
    motor = motor_torque(
        period.torque, period.rate, period.command_to_sample, steps, delay=physics.delays, lag=physics.lags
    )
    filled = period.filled()
    state = np.stack((filled.mean(axis=1), np.zeros(period.joints), np.zeros(period.joints)))
    for _ in range(SETTLING.max_periods):
        position, end = simulate(physics, state, motor, step)
        if float(np.abs(end - state).max()) < SETTLING.atol:
            read = measured(physics, position)
            error: Array = np.sqrt(np.nanmean((period.position - read) ** 2, axis=1)) / filled.std(axis=1)
            return error
        state = end
    raise PeriodicityError(f"with these parameters the arm does not settle within {SETTLING.max_periods} periods")


def _complete(parameters: Mapping[str, float], joints: int) -> dict[str, float]:
    """Return the parameters, with a narrow Coulomb step added for each joint that has none."""
    return {f"coulomb_width_{joint + 1}": LEAST_WIDTH for joint in range(joints)} | dict(parameters)


def _zeros(row: Array) -> dict[str, float]:
    return {f"zero_{joint + 1}": float(zero) for joint, zero in enumerate(row)}
