"""Entry point of the chain estimator: settled periods in, parameters with standard errors out."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.chain.conflicts import chain_conflicts
from hil.estimator.chain.fit.coordinates import ANGLES, kind_of
from hil.estimator.chain.fit.held_zeros import HeldZeros
from hil.estimator.chain.fit.options import DEFAULTS, ChainOptions
from hil.estimator.chain.fit.stage1 import ChainLinear, fit_lines
from hil.estimator.chain.fit.stage2 import ChainFit, fit_periods
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ConvergenceError, ModelError
from hil.estimator.fit.fitted_parameters import FittedParameters
from hil.estimator.models.conflicts import Conflict

EXPLAINED_RESIDUAL = 1.06
"""A motion counts as explained if the RMS residual of the worst joint, relative to the noise of its angle, is below
this value.
"""

SYSTEMATIC = 1.1
"""The residual contains model errors, not only noise, if the ratio of a base parameter's standard error to that under
white noise exceeds this value.

The ratio is 0.6 to 0.9 for encoder rounding and noise. Torque ripple of 0.2 %, or load-dependent friction of 0.3 % of
the torque, raises it to 2 or 3; with a noisy encoder, load-dependent friction of one joint raises it to 1.5.
"""

SIGNIFICANCE, LARGE_ZERO = 1e-3, 0.005
"""Significance level for errors of fixed encoder zeros, and the smallest reported error [rad]: three encoder steps,
less than the usual error of a manually adjusted zero.
"""

BELIEVED = 0.5  # a value is determined by the data up to this ratio of its white-noise standard error to the prior's


@dataclass(frozen=True)
class ChainEstimate(FittedParameters):
    """Parameters of a spatial arm estimated from settled periods; see also `hil.estimator.identify.Estimate`."""

    model: ChainModel
    start: Array
    """Angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    position: Array
    """One-step-ahead prediction of the first period (joints, samples) [rad]."""
    positions: tuple[Array, ...]
    """One-step-ahead prediction of each period (joints, samples) [rad]."""
    iterations: int
    outliers: int
    correlation_time: float
    systematic: float
    """Largest ratio of a base parameter's standard error to that under white noise: how far model errors exceed the
    noise at the frequencies that determine the parameters.
    """
    softness: float
    """Natural frequency of the observer that couples the simulation to the measurements [Hz]."""
    reached: bool
    """Whether the fit has reached its minimum; if not, the standard errors include the remaining distance."""
    from_prior: tuple[str, ...]
    """Base parameters that the data barely constrain, whose values therefore come from the prior."""
    unseen: tuple[str, ...]
    """Encoder zero errors and base tilts that the data barely constrain, which are therefore taken as zero."""
    doubtful_zeros: tuple[tuple[int, float], ...]
    """Joints (from 1) whose encoder zeros the model holds fixed although the recording contradicts them, each with its
    zero error (true minus measured angle) [rad]. Empty if not tested.
    """
    noise_steps: Array
    """Noise of one sample of each angle, including rounding (joints,) [encoder steps]; rounding alone is 0.2887."""
    at_bound: tuple[str, ...] = ()
    """Parameters at a bound although the data favour values beyond it; empty unless this affects base parameters."""
    conflicts: tuple[Conflict, ...] = ()
    """Values that contradict prior knowledge, worst first."""

    @property
    def over_noise(self) -> Array:
        """RMS residual relative to the noise of the angles (joints,)."""
        return np.asarray(self.residual_steps / self.noise_steps)

    @property
    def explained(self) -> bool:
        """Whether the residual consists of noise only, so that no further term needs to be tried."""
        return float(self.over_noise.max()) <= EXPLAINED_RESIDUAL and self.systematic <= SYSTEMATIC


@one_blas_thread
def identify_chain(
    periods: SettledPeriod | Sequence[SettledPeriod],
    model: ChainModel,
    prior: Prior,
    added: Sequence[Array | None] = (),
    *,
    test_zeros: bool = False,
) -> ChainEstimate:
    """Estimate the parameters of `model` from settled periods by regression, then maximum likelihood.

    `prior` supplies what the data barely constrain (`ChainEstimate.from_prior`). `added`: as for `fit_lines`, if
    `model` has `added_mass`. test_zeros: whether to test the encoder zeros that `model` holds fixed
    (`ChainEstimate.doubtful_zeros`), which takes 10 % longer. Raises ModelError if `model` and a period differ in
    their number of joints, ConvergenceError if no minimum is found.
    """
    given = (periods,) if isinstance(periods, SettledPeriod) else tuple(periods)
    for period in given:
        if model.joints != period.joints:
            raise ModelError(f"the model has {model.joints} joints but the period has {period.joints}")
    used = [without_spikes(period) for period in given]
    linear = fit_lines(used, model, prior, added)
    fit = _best_fit(used, model, linear, prior, replace(DEFAULTS, test_zeros=test_zeros), added)
    spikes = sum(int(period.valid.sum()) for period in given) - sum(int(period.valid.sum()) for period in used)
    count = model.base.count
    # White-noise errors show how far the values depend on the prior; model errors and an unfinished fit do not alter
    # this.
    std = np.sqrt(np.diag(fit.white_covariance))
    systematic = largest_ratio(np.sqrt(np.diag(fit.covariance))[:count], std[:count])
    wide = std[:count] > BELIEVED * prior.std
    return ChainEstimate(
        names=model.names,
        units=model.units,
        value=fit.value,
        covariance=fit.total_covariance,
        residual=np.where(used[0].valid, used[0].position - fit.positions[0], np.nan),
        position_step=used[0].position_step,
        model=model,
        start=fit.starts[0],
        position=fit.positions[0],
        positions=fit.positions,
        iterations=fit.iterations,
        outliers=fit.outliers + spikes,
        correlation_time=fit.correlation_time,
        systematic=systematic,
        softness=fit.softness,
        reached=fit.reached,
        from_prior=tuple(name for name, open_ in zip(model.base.names, wide, strict=True) if open_),
        unseen=tuple(
            name
            for name, each in zip(model.names, std, strict=True)
            if each > BELIEVED * ANGLES.get(kind_of(name), np.inf)
        ),
        doubtful_zeros=doubtful_zeros(fit.held_zeros, systematic),
        noise_steps=used[0].noise / used[0].position_step,
        at_bound=fit.at_bound,
        conflicts=chain_conflicts(model.names, fit.value, np.sqrt(np.diag(fit.total_covariance)), prior),
    )


def doubtful_zeros(held: HeldZeros | None, systematic: float) -> tuple[tuple[int, float], ...]:
    """Return the joints (from 1) whose fixed zeros have significant errors larger than LARGE_ZERO, with these errors.

    A model error that widens the standard errors by the factor `systematic` can mimic zero errors, so it raises the
    threshold.
    """
    if held is None or held.gain <= max(systematic, 1.0) ** 2 * float(chdtri(held.shift.size, SIGNIFICANCE)):
        return ()
    return tuple((joint, float(each)) for joint, each in enumerate(held.shift, start=2) if abs(each) > LARGE_ZERO)


def largest_ratio(one: Array, other: Array) -> float:
    """Return the largest element-by-element ratio of two vectors of standard errors; infinite if no pair is finite.

    The maximum is used because an unmodelled effect may act on only one joint.
    """
    known = np.isfinite(one) & np.isfinite(other)
    return float(np.max(one[known] / other[known])) if known.any() else np.inf


def _best_fit(
    periods: Sequence[SettledPeriod],
    model: ChainModel,
    linear: ChainLinear,
    prior: Prior,
    options: ChainOptions,
    added: Sequence[Array | None],
) -> ChainFit:
    """Fit, refit from narrower Coulomb steps while the motion remains unexplained, and return the best minimum.

    If a joint often reverses or sticks, the sum of squares has several minima with respect to the shape of its
    friction.
    """
    best = fit_periods(periods, model, linear, prior, options, added)
    widths = np.array([kind_of(name) == "coulomb_width" for name in model.names])
    for width in options.other_initial_widths:
        before = _worst_residual(periods, best)
        if before <= EXPLAINED_RESIDUAL:
            break
        if np.all(best.value[widths] <= width):
            continue  # that fit would start from the minimum itself
        with suppress(ConvergenceError):
            narrow = replace(options, initial_width=width)
            again = fit_periods(periods, model, linear, prior, narrow, added, best)
            best = again if _worst_residual(periods, again) < before else best
    before = _worst_residual(periods, best)
    if before > options.far and not model.zeros and model.joints > 1:
        with suppress(ConvergenceError):
            again = _around(periods, model, linear, prior, options, added, best)
            best = again if _worst_residual(periods, again) < before else best
    return best


def _around(
    periods: Sequence[SettledPeriod],
    model: ChainModel,
    linear: ChainLinear,
    prior: Prior,
    options: ChainOptions,
    added: Sequence[Array | None],
    stuck: ChainFit,
) -> ChainFit:
    """Fit with free encoder zeros, then fit `model` from there.

    The additional freedom may lead out of the valley in which `stuck` ended.
    """
    wider = replace(model, zeros=True)
    freed = fit_periods(periods, wider, fit_lines(periods, wider, prior, added), prior, options, added)
    value = dict(zip(wider.names, freed.value.tolist(), strict=True))
    near = replace(freed, value=np.array([value[name] for name in model.names]))
    narrow = replace(options, initial_width=options.other_initial_widths[-1])
    fitted = fit_periods(periods, model, linear, prior, narrow, added, near)
    return replace(fitted, iterations=fitted.iterations + stuck.iterations)


def _worst_residual(periods: Sequence[SettledPeriod], fit: ChainFit) -> float:
    """RMS residual of the worst joint in any period, relative to the noise of its angle."""
    return max(
        float(
            np.sqrt(
                np.nanmean(np.square(np.where(period.valid, period.position - position, np.nan)), axis=1)
                / period.noise**2
            ).max()
        )
        for period, position in zip(periods, fit.positions, strict=True)
    )
