"""How well given parameters foretell a recording that was not used to find them."""

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

LEAST_WIDTH = 1e-3  # rad/s of a Coulomb step, where a method knows none
SETTLING = SettlingOptions(max_periods=20, atol=1e-6)


def prediction_rms(
    recordings: Sequence[Recording],
    parameters: Mapping[str, float],
    length: float,
    joints: int,
    zeros: Array | None = None,
    of: slice = ALL,
) -> Array:
    """RMS of measured less simulated position (joints,) [rad] over all that `prediction_errors` looks at.

    Arguments as there.
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
    """RMS of measured less simulated position (segments, joints) [rad], and samples (segments,) of each segment.

    The simulation is set on its way every `length` [s].

    It starts from angle and velocity as the samples right around the start show them, and then sees the torque
    only. `parameters` [SI] by the names of `Model.names`; `zeros` (recordings, joints) [rad]: true less measured
    angle of each recording, in place of what `parameters` say; `of`: which segments. A simulation that runs away
    counts as wrong by pi.
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
    """RMS of measured less freely predicted position over the RMS of the motion (joints,) of a settled period.

    The arm starts at rest where the period's positions lie on average and is simulated under the period's torque
    until its motion repeats; no measurement enters. Raises PeriodicityError when it does not repeat.
    """
    physics = Physics.of(_complete(parameters, period.joints))
    steps = steps_per_sample(period.rate)
    step = 1.0 / (period.rate * steps)
    motor = motor_torque(
        period.torque, period.rate, period.command_to_sample, steps, delay=physics.delay, lag=physics.lags
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
    raise PeriodicityError(f"under these parameters the arm does not settle within {SETTLING.max_periods} periods")


def _complete(parameters: Mapping[str, float], joints: int) -> dict[str, float]:
    """With a narrow Coulomb step where the method that found the parameters knows of no width."""
    return {f"coulomb_width_{joint + 1}": LEAST_WIDTH for joint in range(joints)} | dict(parameters)


def _zeros(row: Array) -> dict[str, float]:
    return {f"zero_{joint + 1}": float(zero) for joint, zero in enumerate(row)}
