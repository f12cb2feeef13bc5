"""Entry point of the estimator: settled periods in, parameters with standard errors and predictions out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ModelError, PeriodicityError, ShapeError
from hil.estimator.fit.fitted_parameters import FittedParameters
from hil.estimator.fit.stage1 import fit_lines
from hil.estimator.fit.stage2 import Near, fit_runs
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.options import LikelihoodOptions, SettlingOptions
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.drive import motor_torque
from hil.estimator.simulation.encoder import measured

LIKELIHOOD = LikelihoodOptions()
SETTLING = SettlingOptions()


@dataclass(frozen=True)
class Estimate(FittedParameters):
    """What settled periods say of the arm.

    `std` and `covariance` hold what position errors leave open, scaled by the residual as it is and widened
    where it is correlated (`hil.estimator.fit.covariance`), so that they include the actual rounding errors (a residual
    of 0.2887 encoder steps RMS is rounding alone). They do not include systematic errors: an error of
    the torque constant, by which all parameters of a joint scale, of the encoder's zero or linearity, or of the
    model. A residual well above 0.29 steps means that the model is incomplete and that the parameters may be
    off by more than `std`.
    """

    model: Model
    """The fitted model."""
    start: Array
    """Angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    position: Array
    """Simulated positions (joints, samples) [rad]."""
    iterations: int
    """Simulations with derivatives that the likelihood took."""
    outliers: int = 0
    """Samples left out or downweighted because they are far from their neighbours or from the model."""
    correlation_time: float = 1.0
    """Samples over which the residual is seen to be correlated; 1 is white. `covariance` allows for more."""


@one_blas_thread
def identify(
    periods: SettledPeriod | Sequence[SettledPeriod],
    model: Model,
    *,
    coarse: bool = False,
    starts: Sequence[Mapping[str, float]] = (),
    near: Near | None = None,
    options: LikelihoodOptions = LIKELIHOOD,
) -> Estimate:
    """Estimate the parameters of `model`: regression on Fourier lines, then maximum likelihood.

    The same periods give the same numbers to the last digit.

    Args:
        periods: one settled period, or several of one arm, which are fitted together.
        model: the model to fit.
        coarse: for trying models: one whose residual is well above the noise is not fitted to full convergence.
        starts: parameters by name [SI], of another experiment or of arms like this one; further initial guesses,
            nothing more.
        near: where a minimum is known to be close: the only initial guess, for a fraction of the time.
        options: tolerances and limits of the likelihood.

    Returns:
        Parameters with standard errors, simulated motion and residual of the first period.

    Raises:
        ModelError: when `model` has another number of joints than a period.
        UnidentifiableError: when the motion does not tell parameters apart.
        ConvergenceError: when no initial guess leads to a minimum.
    """
    given = (periods,) if isinstance(periods, SettledPeriod) else tuple(periods)
    for period in given:
        if model.joints != period.joints:
            raise ModelError(f"the model has {model.joints} joints and the period {period.joints}: they must agree")
    used = [without_spikes(period) for period in given]
    linear = fit_lines(*used)
    fit = fit_runs(used, model, linear, coarse=coarse, starts=starts, near=near, options=options)
    spikes = sum(int(period.valid.sum()) for period in given) - sum(int(period.valid.sum()) for period in used)
    return Estimate(
        names=model.names,
        units=model.units,
        value=fit.value,
        covariance=fit.covariance,
        residual=np.where(used[0].valid, used[0].position - fit.positions[0], np.nan),
        position_step=used[0].position_step,
        model=model,
        start=fit.starts[0],
        position=fit.positions[0],
        iterations=fit.iterations,
        outliers=fit.outliers + spikes,
        correlation_time=fit.correlation_time,
    )


def predict(
    estimate: Estimate,
    torque: Array,
    rate: float,
    command_to_sample: float,
    pose: Array | None = None,
    settling: SettlingOptions = SETTLING,
) -> Array:
    """Predict the settled period under another multisine, without using measurements of it.

    The arm starts at rest and is simulated until its motion repeats.

    Args:
        estimate: whose parameters.
        torque: one period (joints, samples) [N m].
        rate: samples per second.
        command_to_sample: from a command to the sample of its index [s], as in `SettledPeriod`.
        pose: where the arm starts (joints,) [rad]; by default where the identified period began.
        settling: tolerances and limits.

    Returns:
        Positions (joints, samples) [rad].

    Raises:
        ShapeError: when `torque` is not of the estimate's joints.
        PeriodicityError: when the motion does not repeat.
    """
    joints = estimate.model.joints
    if torque.ndim != 2 or torque.shape[0] != joints:
        raise ShapeError(f"torque is {torque.shape}, the estimate is of {joints} joints: it must be (joints, samples)")
    physics = Physics.of(estimate.parameters)
    steps = steps_per_sample(rate)
    step = 1.0 / (rate * steps)
    motor = motor_torque(torque, rate, command_to_sample, steps, delay=physics.delay, lag=physics.lags)
    state = np.stack((estimate.start[0] if pose is None else pose, np.zeros(joints), np.zeros(joints)))
    for period in range(settling.max_periods):
        position, end = simulate(physics, state, motor, step)
        change = float(np.abs(end - state).max())
        if change < (settling.atol if period < settling.max_periods - 1 else settling.acceptable):
            return measured(physics, position)
        state = end
    raise PeriodicityError(
        f"after {settling.max_periods} periods the simulated arm changes by {change:.2g} rad or rad/s from one to "
        "the next: lower the torque, or check the identified friction"
    )
