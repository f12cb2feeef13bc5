"""One settled period of an experiment, the estimator's input."""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array, Mask
from hil.estimator.data.fourier import white_noise
from hil.estimator.data.repeated_noise import agreed_noise
from hil.estimator.errors import RecordingError, ShapeError, StandstillError
from hil.estimator.simulation.closed_loop import Stabilised

Indices = npt.NDArray[np.intp]

FEWEST_SAMPLES = 32
SPIKE = 8.0  # deviation from the local median, relative to the typical one, above which a reading is a spike
MOST_SPIKES = 0.05  # fraction of spikes above which they are assumed to be real motion
LEAST_VALID = 0.5  # minimum fraction of a joint's samples that must be valid
LEAST_MOTION = 4.0  # minimum range of motion in encoder steps
MOST_GAP = 4.0  # allowed gap from the last sample to the first, relative to the largest change between neighbours
MOST_DRIFT = 0.1  # allowed gap from the last sample to the first, relative to the range of motion


@dataclass(frozen=True)
class SettledPeriod:
    """One period of a settled periodic experiment, or the mean of several, sampled without gaps in time.

    Command k takes effect at the motors and holds until command k + 1; sample k is taken `command_to_sample` later. The
    first command is preceded by the last one, as in a periodic signal. Missing samples are NaN.

    Raises ShapeError for incompatible arrays; RecordingError for non-finite values, for a rate or position step that is
    not positive and for a period with too few samples; StandstillError for a joint that moved by only a few encoder
    steps.
    """

    rate: float
    """Sampling rate [1/s]."""
    torque: Array
    """Commanded motor torque (joints, samples) [N m], each value held until the next."""
    position: Array
    """Joint angles (joints, samples) [rad]."""
    command_to_sample: float
    """Time from a command's effect at the motor to the sample of the same index [s]."""
    position_step: Array
    """Quantisation of each joint's angle (joints,) [rad]."""
    periods: int = 1
    """Number of settled periods that were averaged."""
    position_std: Array | None = None
    """Standard deviation of the mean angles, estimated from the scatter between periods (joints,) [rad], if known."""
    repeated_noise: Array | None = None
    """Standard deviation of one sample's error, estimated from the difference between successive periods (joints,)
    [rad], if known (`hil.estimator.data.repeated_noise`).
    """
    coloured_noise: Array | None = None
    """Standard deviation of the non-white part of a sample's error (joints,) [rad], if known; see `repeated_noise`."""
    stabiliser: Stabilised | None = None
    """The software stabiliser, if one produced part of `torque`.

    Without it, a simulated arm may diverge from the real one.
    """
    before: Array | None = None
    """Angles and velocities one period before the first sample (2, joints) [rad, rad/s], from encoder readings.

    A motion counts as settled if it differs little from that of the previous period; what remains of the transient can
    be predicted from this state.
    """
    valid: Mask = field(init=False)
    """Whether each sample was received (joints, samples)."""
    noise: Array = field(init=False)
    """Standard deviation of one sample's error (joints,) [rad]: coloured noise, combined with the larger of measured
    white noise and rounding noise.

    At a low sampling rate, the highest lines contain motion as well as noise, so the part that repeats from period to
    period is left out.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "valid", np.isfinite(self.position))
        _check_shapes(self)
        _check_values(self)
        _check_motion(self)
        rounding = self.position_step / np.sqrt(12.0)
        white = agreed_noise(white_noise(self.filled(), self.valid), self.repeated_noise, self.samples)
        coloured = 0.0 if self.coloured_noise is None else self.coloured_noise
        object.__setattr__(self, "noise", np.hypot(np.maximum(white, rounding), coloured))

    @property
    def joints(self) -> int:
        return int(self.position.shape[0])

    @property
    def samples(self) -> int:
        return int(self.position.shape[1])

    @property
    def fundamental(self) -> float:
        """Angular frequency of the period [rad/s]."""
        return 2.0 * np.pi * self.rate / self.samples

    def filled(self) -> Array:
        """Return the positions (joints, samples) [rad], with missing ones interpolated between their neighbours."""
        position = self.position.copy()
        index = np.arange(self.samples)
        for row, valid in zip(position, self.valid, strict=True):
            if not valid.all():
                row[~valid] = np.interp(index[~valid], index[valid], row[valid], period=self.samples)
        return position


def without_spikes(period: SettledPeriod) -> SettledPeriod:
    """Return the period with isolated outliers (caused by bit errors, for example) marked as missing.

    Two distances are computed for each reading: from the median of itself and two neighbours on either side, and from a
    cubic through its neighbours. The reading is an outlier if both exceed SPIKE encoder steps and SPIKE times the
    typical distance from the median. At a low sampling rate, the median alone would mistake every fast reversal for an
    outlier. If more than the fraction MOST_SPIKES would be marked, none are, since the joint is then moving too fast
    for this sampling rate.
    """
    from scipy.ndimage import median_filter

    position = period.filled()
    away = np.abs(position - median_filter(position, size=(1, 5), mode="wrap"))
    usual = np.maximum(1.5 * np.median(away, axis=1), np.maximum(period.position_step, period.noise))
    wild = (away > SPIKE * usual[:, None]) & period.valid
    wild &= wild.mean(axis=1, keepdims=True) <= MOST_SPIKES
    for row, far, valid, most in zip(position, wild, period.valid, SPIKE * usual, strict=True):
        bridged = _bridged(row, np.flatnonzero(far), np.flatnonzero(valid & ~far))
        far[far] = np.abs(row[far] - bridged) > most
    if not wild.any():
        return period
    return replace(period, position=np.where(wild, np.nan, period.position))


def _bridged(row: Array, places: Indices, kept: Indices) -> Array:
    """Return the cubic through the two nearest `kept` samples on either side, evaluated at each of `places`.

    The row (samples,) is periodic.
    """
    if not places.size:
        return np.empty(0)
    after = np.searchsorted(kept, places)[:, None] + np.arange(-2, 2)
    turns, index = np.divmod(after, kept.size)
    at = kept[index] + turns * row.size - places[:, None]
    value = np.zeros(places.size)
    for i in range(4):
        others = np.delete(at, i, axis=1)
        value += row[kept[index[:, i]]] * np.prod(others / (others - at[:, i : i + 1]), axis=1)
    return value


def _check_shapes(period: SettledPeriod) -> None:
    if period.position.ndim != 2 or period.torque.shape != period.position.shape:
        raise ShapeError(
            f"torque has shape {period.torque.shape} and position {period.position.shape}; "
            "both must be (joints, samples)"
        )
    per_joint = (period.position.shape[0],)
    if period.position_step.shape != per_joint:
        raise ShapeError(f"position_step has shape {period.position_step.shape}; it must be {per_joint}: one per joint")
    for name in ("position_std", "repeated_noise", "coloured_noise"):
        std = getattr(period, name)
        if std is not None and std.shape != per_joint:
            raise ShapeError(f"{name} has shape {std.shape}; it must be {per_joint}: one per joint")


def _check_values(period: SettledPeriod) -> None:
    if not (period.rate > 0.0 and np.isfinite(period.command_to_sample) and np.all(period.position_step > 0.0)):
        raise RecordingError(
            f"rate {period.rate:g} 1/s and position_step {period.position_step} rad must be positive, "
            f"and command_to_sample {period.command_to_sample:g} s must be finite"
        )
    if period.samples < FEWEST_SAMPLES:
        raise RecordingError(f"the period has {period.samples} samples; at least {FEWEST_SAMPLES} are needed")
    for joint in range(period.joints):
        bad = int(np.sum(~np.isfinite(period.torque[joint])))
        if bad:
            raise RecordingError(f"joint {joint + 1}: {bad} commanded torques are not finite")
        received = float(np.mean(period.valid[joint]))
        if received < LEAST_VALID:
            raise RecordingError(
                f"joint {joint + 1}: {100 * received:.0f} % of {period.samples} samples were received; at "
                f"least {100 * LEAST_VALID:.0f} % are needed: check the bus before you record again"
            )


def _check_motion(period: SettledPeriod) -> None:
    for joint in range(period.joints):
        swing = float(np.nanmax(period.position[joint]) - np.nanmin(period.position[joint]))
        least = LEAST_MOTION * float(period.position_step[joint])
        if swing <= least:
            raise StandstillError(
                f"joint {joint + 1} was held by friction and moved by only {swing:.2g} rad; at least {least:.2g} rad "
                "are needed: raise its peak torque"
            )
    filled = period.filled()
    for joint, row in enumerate(filled):
        gap = abs(float(row[0] - row[-1]))
        # Friction that changes as the arm warms up leaves a gap. This does no harm, since the initial state is
        # estimated.
        most = max(MOST_GAP * float(np.abs(np.diff(row)).max()), MOST_DRIFT * float(np.ptp(row)))
        if gap > most:
            raise RecordingError(
                f"joint {joint + 1} ends the period {gap:.3g} rad from where it began (at most {most:.3g} rad is "
                "allowed): it went over the top or has not settled; lower the peak torque or wait longer"
            )
