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
    """Parameters of the arm estimated from settled periods.

    `std` and `covariance` describe the uncertainty due to position errors. They are scaled by the actual residual and
    widened if it is correlated (`hil.estimator.fit.covariance`), so they include the true effect of rounding (rounding
    alone leaves a residual of 0.2887 encoder steps RMS). They do not include systematic errors of the torque constant,
    of the encoder's zero or linearity, or of the model. A residual well above 0.29 steps means that the model is
    incomplete and that the parameters may be off by more than `std`.
    """

    model: Model
    """The fitted model."""
    start: Array
    """Angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    position: Array
    """Simulated positions (joints, samples) [rad]."""
    iterations: int
    """Number of simulations with derivatives used to maximise the likelihood."""
    outliers: int = 0
    """Number of samples excluded or downweighted because they are far from their neighbours or from the model."""
    correlation_time: float = 1.0
    """Number of samples over which the residual is correlated; 1 for white noise. `covariance` takes this into account.
    """
    at_bound: tuple[str, ...] = ()
    """Parameters at a bound although the data favour values beyond it; empty unless this affects base parameters."""


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
    """Estimate the parameters of `model`: regression on Fourier coefficients, then maximum likelihood.

    The result is deterministic to the last digit.

    Args:
        periods: one settled period, or several of the same arm, which are fitted together.
        model: the model to fit.
        coarse: whether to end the fit early if the residual is well above the noise; such a fit suffices to compare
            models.
        starts: additional initial guesses, parameters by name [SI], such as those from another experiment or similar
            arms.
        near: point known to be close to a minimum, used as the only initial guess; this is much faster.
        options: tolerances and limits of the likelihood.

    Returns:
        The parameters with standard errors, and the simulated motion and residual of the first period.

    Raises:
        ModelError: if `model` and a period differ in their number of joints.
        UnidentifiableError: if the motion does not separate the parameters.
        ConvergenceError: if no initial guess leads to a minimum.
    """
    given = (periods,) if isinstance(periods, SettledPeriod) else tuple(periods)
    for period in given:
        if model.joints != period.joints:
            raise ModelError(f"the model has {model.joints} joints but the period has {period.joints}")
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
        at_bound=fit.at_bound,
    )


def predict(
    estimate: Estimate,
    torque: Array,
    rate: float,
    command_to_sample: float,
    pose: Array | None = None,
    settling: SettlingOptions = SETTLING,
) -> Array:
    """Predict the settled period under another multisine from its torque alone.

    The arm starts at rest and is simulated until its motion repeats.

    Args:
        estimate: the estimate whose parameters are used.
        torque: one period (joints, samples) [N m].
        rate: sampling rate [1/s].
        command_to_sample: time from a command to the sample of the same index [s], as in `SettledPeriod`.
        pose: initial joint angles (joints,) [rad]; by default those at the start of the identified period.
        settling: tolerances and limits.

    Returns:
        Positions (joints, samples) [rad].

    Raises:
        ShapeError: if `torque` does not have the estimate's number of joints.
        PeriodicityError: if the motion does not become periodic.
    """
    joints = estimate.model.joints
    if torque.ndim != 2 or torque.shape[0] != joints:
        raise ShapeError(f"torque has shape {torque.shape}; an estimate of {joints} joints needs ({joints}, samples)")
    physics = Physics.of(estimate.parameters)
    steps = steps_per_sample(rate)
    step = 1.0 / (rate * steps)
    motor = motor_torque(torque, rate, command_to_sample, steps, delay=physics.delays, lag=physics.lags)
    state = np.stack((estimate.start[0] if pose is None else pose, np.zeros(joints), np.zeros(joints)))
    for period in range(settling.max_periods):
        position, end = simulate(physics, state, motor, step)
        change = float(np.abs(end - state).max())
        if change < (settling.atol if period < settling.max_periods - 1 else settling.acceptable):
            return measured(physics, position)
        state = end
    raise PeriodicityError(
        f"after {settling.max_periods} periods the simulated motion still changes by {change:.2g} rad or rad/s "
        "from one period to the next: lower the torque, or check the identified friction"
    )
