"""Estimation of chains from recordings of arbitrary motion; no settled period is needed.

Stage 1 is filtered inverse dynamics. Stage 2 is the same likelihood as for settled periods: its observer needs
commanded torque, but no periodic motion. A simulation driven by a measured torque adds no information (docs/theory.md);
in that case, the result is that of the regression and is marked as such.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.chain.conflicts import chain_conflicts
from hil.estimator.chain.fit.regression import filtered_torque, filtered_torques, fit_filtered
from hil.estimator.chain.fit.stage1 import ChainLinear
from hil.estimator.chain.fit.stage2 import fit_periods
from hil.estimator.chain.identify import BELIEVED, largest_ratio
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.fourier import PeriodicMotion
from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError, RecordingError
from hil.estimator.fit.covariance import autocorrelation
from hil.estimator.models.conflicts import Conflict

CUTOFFS = (8.0, 4.0, 2.0)  # Hz; the regression uses the first one that the recordings' rate and length allow
LAG = 1e-3  # s: typical lag of a current loop, assumed by the regression
MOVES = 0.05  # mean absolute smoothed sign of velocity below which a joint counts as standing still
VELOCITY_SAMPLES = 9  # number of samples from which the initial velocity is taken


@dataclass(frozen=True)
class MotionPiece(SettledPeriod):
    """A recording resampled at equal intervals, to which the likelihood of settled periods is applied although its
    motion need not be periodic.

    The torque before the first sample is assumed to be that of the last sample.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "valid", np.isfinite(self.position))
        assert self.position_std is not None  # set by `of`
        object.__setattr__(self, "noise", self.position_std)

    @classmethod
    def of(cls, recording: Recording) -> "MotionPiece":
        """Resample a recording: angles by interpolation, torques by their mean over each interval."""
        dt = recording.interval
        count = int((recording.time[-1] - recording.time[0]) / dt + 1e-9)
        at = recording.time[0] + dt * np.arange(count + 1)
        nearest = np.clip(np.searchsorted(recording.time, at[:-1] - 0.5 * dt), 0, recording.time.size - 1)
        position = np.stack([np.interp(at[:-1], recording.time, row) for row in recording.filled()])
        position = np.where(np.isfinite(recording.position[:, nearest]), position, np.nan)
        torque = recording.mean_torque(at - recording.command_to_sample, 0.0)
        return cls(
            1.0 / dt,
            torque,
            position,
            recording.command_to_sample,
            recording.position_step,
            position_std=recording.noise,
        )


@dataclass(frozen=True)
class RecordedChain:
    """Parameters of a chain estimated from recordings of arbitrary motion."""

    model: ChainModel
    names: tuple[str, ...]
    units: tuple[str, ...]
    value: Array
    covariance: Array
    simulated: bool
    """Whether stage 2 was used; False if only the regression was used because the torque was measured."""
    residual_over_noise: Array
    """RMS of the one-step-ahead residual relative to the noise of the angles (joints,); NaN for a regression."""
    residual: Array
    """RMS of the one-step-ahead residual (joints,) [rad]; NaN for a regression."""
    positions: tuple[Array, ...]
    """One-step-ahead prediction for each recording (joints, samples) [rad] at `MotionPiece`'s times."""
    cutoff: float
    """Cut-off frequency of the regression [Hz]."""
    from_prior: tuple[str, ...]
    """Base parameters that the data barely constrain."""
    reached: bool = True
    """Whether the fit has reached its minimum; always True for a regression."""
    systematic: float = 1.0
    """Largest ratio of the base parameters' standard errors to those under white noise; 1 for a regression."""
    at_bound: tuple[str, ...] = ()
    conflicts: tuple[Conflict, ...] = ()
    """Values that contradict prior knowledge, worst first."""

    @property
    def std(self) -> Array:
        """Standard errors of `value`, in the order of `names` [SI]."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name [SI]."""
        return dict(zip(self.names, self.value.tolist(), strict=True))


@one_blas_thread
def identify_recordings(recordings: Sequence[Recording], model: ChainModel, prior: Prior) -> RecordedChain:
    """Estimate the parameters of `model` from recordings of arbitrary motion.

    Raises ModelError if the numbers of joints differ, RecordingError if a recording cannot be filtered,
    ConvergenceError if no minimum is found.
    """
    for recording in recordings:
        if recording.joints != model.joints:
            raise ModelError(f"the model has {model.joints} joints but a recording has {recording.joints}")
    value, std, cutoff = regression(recordings, model, prior)
    count = model.base.count
    if any(recording.between != "held" for recording in recordings):
        nothing = np.full(model.joints, np.nan)
        return RecordedChain(
            model,
            model.linear_names,
            model.units[: len(value)],
            value,
            np.diag(std**2) * _repeated(recordings, model, value, cutoff),
            False,
            nothing,
            nothing,
            (),
            cutoff,
            _from_prior(model, std[:count], prior),
        )
    pieces = [MotionPiece.of(recording) for recording in recordings]
    left = relative_residual(recordings, model, value, cutoff)
    linear = ChainLinear(value, std, LAG, tuple(map(_beginning, pieces)), left)
    fit = fit_periods(pieces, model, linear, prior)
    squares = [np.square(piece.position - found) for piece, found in zip(pieces, fit.positions, strict=True)]
    rms = np.sqrt(np.nanmean(np.concatenate(squares, axis=1), axis=1))
    noise = np.sqrt(np.mean([np.square(piece.noise) for piece in pieces], axis=0))
    spread = np.sqrt(np.diag(fit.white_covariance))[:count]
    return RecordedChain(
        model,
        model.names,
        model.units,
        fit.value,
        fit.total_covariance,
        True,
        rms / noise,
        rms,
        fit.positions,
        cutoff,
        _from_prior(model, spread, prior),
        fit.reached,
        largest_ratio(np.sqrt(np.diag(fit.covariance))[:count], spread),
        fit.at_bound,
        chain_conflicts(model.names, fit.value, np.sqrt(np.diag(fit.total_covariance)), prior),
    )


def torque_error(recordings: Sequence[Recording], found: RecordedChain) -> Array:
    """Return the RMS error of the torque that the parameters `found` predict for `recordings`, relative to the torque's
    RMS (joints,); NaN for joints that stand still.

    At standstill, static friction balances any torque up to its level, so an error below that level does not count.
    """
    scale = [found.parameters.get(f"torque_scale_{joint}", 1.0) for joint in range(1, found.model.joints + 1)]
    true = [replace(each, torque=each.torque * np.array(scale)[:, None]) for each in recordings]
    Y, torque = filtered_torques(true, found.model, found.cutoff, LAG)
    error = torque - Y @ np.array([found.parameters[name] for name in found.model.linear_names])
    joints, viscous = range(found.model.joints), found.model.base.count
    moves = np.empty(found.model.joints)
    for joint in joints:
        velocity, slides = Y[joint, :, viscous + joint], Y[joint, :, viscous + len(joints) + joint]
        coulomb, rise, fading = (
            found.parameters.get(f"{term}_{joint + 1}", absent)
            for term, absent in (("coulomb", 0.0), ("stribeck_rise", 0.0), ("stribeck_velocity", 1.0))
        )
        risen = coulomb * rise * np.exp(-np.square(velocity / fading))
        undetermined = np.maximum(coulomb + risen, 0.0) * np.maximum(1.0 - np.abs(slides), 0.0)
        error[joint] = np.maximum(np.abs(error[joint] - risen * slides) - undetermined, 0.0)
        moves[joint] = np.mean(np.abs(slides))
    return np.where(moves < MOVES, np.nan, _relative(error, torque))


def regression(recordings: Sequence[Recording], model: ChainModel, prior: Prior) -> tuple[Array, Array, float]:
    """Return the values of `ChainModel.linear_names`, their standard errors assuming a white residual [SI], and the
    cut-off frequency [Hz]. Raises RecordingError if a recording cannot be filtered.
    """
    for cutoff in CUTOFFS[:-1]:
        try:
            return (*fit_filtered(recordings, model, prior, cutoff, LAG), cutoff)
        except RecordingError:
            continue
    return (*fit_filtered(recordings, model, prior, CUTOFFS[-1], LAG), CUTOFFS[-1])


def relative_residual(recordings: Sequence[Recording], model: ChainModel, value: Array, cutoff: float) -> Array:
    """Return the RMS of the regression's torque residual relative to that of the torque (joints,)."""
    Y, torque = filtered_torques(recordings, model, cutoff, LAG)
    return _relative(torque - Y @ value, torque)


def _repeated(recordings: Sequence[Recording], model: ChainModel, value: Array, cutoff: float) -> float:
    """Return the factor by which correlation of the torque residual increases the variance of the parameters.

    It is the sum of the autocorrelation up to its first negative value, for the worst joint. Errors of the regressor
    itself are not included.
    """
    most = 1.0
    for recording in recordings:
        Y, torque = filtered_torque(recording, model, cutoff, LAG)
        for row in torque - Y @ value:
            rho = autocorrelation(row, row.size // 4)
            negative = np.flatnonzero(rho <= 0.0)
            most = max(most, 1.0 + 2.0 * float(rho[1 : negative[0] if negative.size else rho.size].sum()))
    return most


def _relative(error: Array, torque: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(error**2, axis=1) / np.maximum(np.mean(torque**2, axis=1), 1e-12)))


def _beginning(piece: MotionPiece) -> PeriodicMotion:
    """Return the motion, with velocities from smoothed angles; only its initial state and RMS velocity are used."""
    position = piece.filled()
    kernel = np.ones(VELOCITY_SAMPLES) / VELOCITY_SAMPLES
    padded = np.pad(position, ((0, 0), (VELOCITY_SAMPLES // 2,) * 2), mode="edge")
    smooth = np.stack([np.convolve(row, kernel, mode="valid") for row in padded])
    velocity = np.gradient(smooth, 1.0 / piece.rate, axis=1)
    velocity[:, : VELOCITY_SAMPLES // 2] = velocity[:, VELOCITY_SAMPLES // 2 : VELOCITY_SAMPLES // 2 + 1]
    return PeriodicMotion(position, velocity, np.zeros_like(velocity))


def _from_prior(model: ChainModel, std: Array, prior: Prior) -> tuple[str, ...]:
    wide = std > BELIEVED * prior.std
    return tuple(name for name, open_ in zip(model.base.names, wide, strict=True) if open_)
