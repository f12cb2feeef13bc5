"""Checks of an estimate: residual relative to noise, whiteness, conditioning, open-loop simulation, spectrum."""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.data.fourier import cut_off, lines_of, motion_of, noise_power
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import PeriodicityError
from hil.estimator.fit.covariance import autocorrelation
from hil.estimator.identify import Estimate, predict
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import joint_of, kind_of
from hil.estimator.selection.distortion import Distortion, distortion, excited_lines

LAGS = 100
LITTLE_TORQUE = 0.1  # fraction of the RMS torque below which the torque due to a parameter is negligible


@dataclass(frozen=True)
class Levels:
    """RMS by source, in encoder steps (joints,)."""

    excited: Array
    """Motion on the spectral lines on which at least one joint was excited."""
    distortion: Array
    """Motion on the other spectral lines, caused by the arm's nonlinearity."""
    noise: Array
    """Measured noise of one sample (`SettledPeriod.noise`)."""
    scatter: Array
    """Noise of one sample of the mean period, from the scatter between periods; 0 for a single period."""
    model_error: Array
    """Residual of the fit beyond rounding and scatter."""
    lines: Distortion
    """Levels per Fourier line, separately for odd and even lines if the excitation allows it."""


@dataclass(frozen=True)
class Validation:
    """Results of the checks."""

    residual_over_floor: Array
    """RMS residual relative to the known noise, rounding and scatter (joints,); 1 means fully explained."""
    correlated_lags: Array
    """Fraction of the residual's autocorrelations outside the 95 % band of white noise (joints,); 0.05 if white.

    Lags of 1 to LAGS samples are used.
    """
    free_run: Array | None
    """RMS error of a simulation of the fitted period from rest, relative to the motion's RMS (joints,).

    None if the simulation does not settle.
    """
    condition: float
    """Condition number of the base parameters' correlation matrix; 1 if they are independent."""
    confounded: tuple[str, str, float]
    """The two base parameters that are hardest to separate, and their correlation."""
    relative_std: dict[str, float]
    """Relative standard error of each base parameter except offsets."""
    torque_std: dict[str, float]
    """Standard error of each base parameter except offsets, expressed as a torque relative to the joint's RMS torque,
    for the worst joint.
    """
    levels: Levels

    @property
    def weakest(self) -> str:
        """The base parameter with the largest relative standard error."""
        return max(self.relative_std, key=lambda name: self.relative_std[name])


def validate(period: SettledPeriod, estimate: Estimate, gravity: bool = True) -> Validation:
    """Check `estimate` against the period to which it was fitted. gravity: whether gravity acts in the arm's plane."""
    residual = np.nan_to_num(estimate.residual)
    lags = min(LAGS, period.samples // 4)
    band = 1.96 / np.sqrt(period.samples)
    outside = [float(np.mean(np.abs(autocorrelation(row, lags)[1:]) > band)) for row in residual]
    names = estimate.model.base_names
    correlation = _correlation(estimate.covariance[: len(names), : len(names)])
    off_diagonal = np.abs(np.triu(correlation, 1))
    first, second = np.unravel_index(np.argmax(off_diagonal), off_diagonal.shape)
    return Validation(
        np.sqrt(np.nanmean(estimate.residual**2, axis=1)) / period.noise,
        np.array(outside),
        _free_run(period, estimate),
        float(linalg.cond(correlation)),
        (names[first], names[second], float(correlation[first, second])),
        relative_errors(names, estimate.value, estimate.std, *_rms(period), gravity, little_friction=0.0),
        _torque_std(period, estimate),
        levels(period, estimate),
    )


def relative_errors(
    names: tuple[str, ...],
    value: Array,
    std: Array,
    torque: Array,
    speed: Array,
    gravity: bool = True,
    little_friction: float = LITTLE_TORQUE,
) -> dict[str, float]:
    """Return the relative standard error of each base parameter except offsets and, without gravity, gravity torques.

    A parameter may be zero, such as the dry friction of an ideal joint or the weight of a horizontal arm. If the torque
    due to a parameter is negligible, its error is relative to the value at which it would not be.

    Args:
        names: names of the base parameters.
        value, std: their values and standard errors, optionally followed by those of other parameters [SI].
        torque, speed: RMS torque and velocity of each joint (joints,) [SI].
        gravity: whether gravity acts in the arm's plane.
        little_friction: fraction of the RMS torque below which friction is negligible; 0 for a designed excitation,
            which determines even slight friction.
    """
    relative = {}
    for name, each, error in zip(names, map(float, value), map(float, std), strict=False):
        kind, joint = kind_of(name), (joint_of(name) or 1) - 1
        if kind == "offset" or (kind == "gravity" and not gravity):
            continue
        share = LITTLE_TORQUE if kind == "gravity" else little_friction
        size = max(abs(each), _negligible(kind, share * float(torque[joint]), float(speed[joint])))
        relative[name] = error / size if size else np.inf
    return relative


def _negligible(kind: str, torque: float, speed: float) -> float:
    """Return the value of a parameter that causes `torque`; 0 for inertias, whose torque depends on the motion."""
    if kind == "viscous":
        return torque / max(speed, 1e-9)
    return torque if kind in {"gravity", "coulomb"} else 0.0


def _rms(period: SettledPeriod) -> tuple[Array, Array]:
    """Return the RMS torque and velocity of each joint (joints,) [SI]."""
    velocity = np.gradient(period.filled(), 1.0 / period.rate, axis=1)
    return np.sqrt(np.mean(period.torque**2, axis=1)), np.sqrt(np.mean(velocity**2, axis=1))


def _torque_std(period: SettledPeriod, estimate: Estimate) -> dict[str, float]:
    """Return the standard error of each base parameter except offsets, as a fraction of the joints' torque."""
    lines = lines_of(estimate.position)
    motion = motion_of(lines, cut_off(lines), period.fundamental, period.samples)
    torque = np.sqrt(np.mean(period.torque**2, axis=1))
    Y = regressor(motion.position, motion.velocity, motion.acceleration)
    per_unit = np.sqrt(np.mean(Y**2, axis=1)) / torque[:, None]
    named = zip(estimate.model.base_names, estimate.std.tolist(), per_unit.max(axis=0).tolist(), strict=False)
    return {name: std * share for name, std, share in named if kind_of(name) != "offset"}


def levels(period: SettledPeriod, estimate: Estimate) -> Levels:
    """Return noise, distortion and model error of one period."""
    lines = lines_of(period.filled())
    order = np.arange(lines.shape[1])
    excited = excited_lines(period)
    other = ~excited & (order > 0) & (order <= cut_off(lines))
    noise = np.minimum(noise_power(lines), np.square(period.noise) / period.samples)
    step = period.position_step

    def rms(chosen: Mask) -> Array:
        power = 2.0 * np.sum(np.abs(lines[:, chosen]) ** 2 - noise[:, None], axis=1)
        return np.asarray(np.sqrt(np.maximum(power, 0.0)) / step)

    scatter = np.zeros(period.joints) if period.position_std is None else period.position_std / step
    left = np.nanmean(estimate.residual**2, axis=1) - period.noise**2
    return Levels(
        rms(excited),
        rms(other),
        period.noise / step,
        scatter,
        np.sqrt(np.maximum(left, 0.0)) / step,
        distortion(period, estimate),
    )


def _free_run(period: SettledPeriod, estimate: Estimate) -> Array | None:
    if period.stabiliser is not None:
        return None  # without the stabiliser it would fall over or drift away
    try:
        predicted = predict(estimate, period.torque, period.rate, period.command_to_sample)
    except PeriodicityError:
        return None
    motion = np.nanstd(period.position, axis=1)
    error: Array = np.sqrt(np.nanmean((period.position - predicted) ** 2, axis=1)) / motion
    return error


def _correlation(covariance: Array) -> Array:
    size = np.sqrt(np.diag(covariance))
    known = np.isfinite(size) & (size > 0.0)
    correlation = np.eye(size.size)
    correlation[np.ix_(known, known)] = covariance[np.ix_(known, known)] / np.outer(size[known], size[known])
    return correlation
