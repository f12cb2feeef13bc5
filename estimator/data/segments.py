"""A recording cut into segments on its simulation grid, each with its own initial state and motor torque."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError

Indices = npt.NDArray[np.int64]

LONGEST_STEP = 1e-3  # s
FEWEST = 8
"""Minimum number of samples in a segment."""
START_WINDOW = 0.03  # s before and after a segment's start, used to estimate its initial state
DIFFERENCE = 1e-7  # s


@dataclass(frozen=True)
class RecordingSegment:
    """A piece of a recording, on the recording's simulation grid."""

    recording: int
    """Index of the recording."""
    first: int
    """Grid point at which the segment starts."""
    steps: int
    """Number of grid steps."""
    index: Indices
    """Grid points around each sample (samples, 4), counted from `first`."""
    weight: Array
    """Weights of the grid points in `index` for cubic interpolation (samples, 4)."""
    position: Array
    """Measured positions (joints, samples) [rad]."""
    state: Array
    """Angles and velocities at the segment's start, from a local fit (2, joints) [rad, rad/s]."""
    samples: slice
    """The recording's samples that belong to the segment."""

    def at_samples(self, grid: Array) -> Array:
        """Interpolate values on the grid (joints, grid points, ...) at the sampling times (joints, samples, ...)."""
        weight = self.weight.reshape(*self.weight.shape, *(1,) * (grid.ndim - 2))
        values = np.zeros((grid.shape[0], len(self.index), *grid.shape[2:]))
        with np.errstate(invalid="ignore"):  # if the simulation has diverged, in which case the fit rejects it
            for n in range(4):
                values += grid[:, self.index[:, n]] * weight[:, n]
        return values


@dataclass(frozen=True)
class Grid:
    """The duration of a recording divided into equal simulation steps."""

    start: float
    """Time of the first grid point [s]."""
    step: float
    """Length of a step [s]."""
    edges: Array
    """Times of all grid points (steps + 1,) [s]."""

    @classmethod
    def of(cls, recording: Recording, longest: float = LONGEST_STEP) -> "Grid":
        """Return the grid from the first sample to the last, in steps of at most `longest` [s]."""
        span = float(recording.time[-1] - recording.time[0])
        count = int(np.ceil(span / longest - 1e-9))
        step = span / count
        return cls(float(recording.time[0]), step, recording.time[0] + step * np.arange(count + 1))


def cut(recording: Recording, number: int, grid: Grid, length: float) -> list[RecordingSegment]:
    """Cut a recording into equal pieces of about `length` [s]; `number` is the recording's index.

    Pieces in which the recording has a gap are omitted. Raises RecordingError if no piece contains FEWEST samples.
    """
    steps = len(grid.edges) - 1
    pieces = max(1, round(steps * grid.step / length))
    edges = np.round(np.linspace(0, steps, pieces + 1)).astype(np.int64)
    place = (recording.time - grid.start) / grid.step
    gaps = np.diff(recording.time) > recording.longest_interval
    before, after = place[:-1][gaps], place[1:][gaps]
    segments = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        inside = (place >= first - 1e-6) & (place < last) if last < steps else (place >= first - 1e-6)
        if np.any((before < last) & (after > first)):
            continue
        if inside.sum() < FEWEST or not np.isfinite(recording.position[:, inside]).any(axis=1).all():
            continue
        index, weight = _cubic(place[inside] - first, last - first)
        state = _state_at(recording, grid.start + grid.step * first)
        segments.append(
            RecordingSegment(
                number, first, last - first, index, weight, recording.position[:, inside], state, _slice(inside)
            )
        )
    if not segments:
        raise RecordingError(
            f"no segment of {length:g} s holds {FEWEST} samples: the median rate is {1 / recording.interval:.3g} Hz; "
            f"record at more than {FEWEST / length:g} Hz, or choose longer segments (columns.segment)"
        )
    return segments


def _slice(inside: Mask) -> slice:
    at = np.flatnonzero(inside)
    return slice(int(at[0]), int(at[-1]) + 1)


def grid_torque(recording: Recording, grid: Grid, delays: Array, lags: Array) -> Array:
    """Return the mean motor torque over each grid step (joints, steps) [N m].

    delays, lags: one value per joint (joints,) [s].
    """
    torque = recording.mean_torque(grid.edges, delays)
    return np.stack([_lagging(row, grid.step, float(lag)) for row, lag in zip(torque, lags, strict=True)])


def _lagging(torque: Array, step: float, lag: float) -> Array:
    if lag <= 0.0:
        return torque
    from scipy.signal import lfilter

    # lag y' = u - y with constant u during a step: the end value and the mean of y are exact.
    a = np.exp(-step / lag)
    end, _ = lfilter([1.0 - a], [1.0, -a], torque, zi=a * torque[:1])
    before = np.concatenate((torque[:1], end[:-1]))
    mean: Array = torque - lag / step * (end - before)
    return mean


def grid_torque_slopes(recording: Recording, grid: Grid, delays: Array, lags: Array) -> Array:
    """Differentiate `grid_torque` with respect to each joint's delay and lag (2, joints, steps) [N m/s].

    Central differences are used. If any joint has no lag, the derivatives with respect to lag are set equal to those
    with respect to delay, which is the limit for a small lag.
    """

    def by(delay: Array | float, lag: Array | float) -> Array:
        less, more = (grid_torque(recording, grid, delays + s * delay, lags + s * lag) for s in (-1.0, 1.0))
        return np.asarray((more - less) / (2.0 * np.reshape(delay + lag, (-1, 1))))

    late = by(DIFFERENCE, 0.0)
    return np.stack((late, by(0.0, np.minimum(DIFFERENCE, 0.1 * lags)) if np.all(lags > 0.0) else late))


def _cubic(place: Array, steps: int) -> tuple[Indices, Array]:
    """Return the grid points around each position (samples, 4) and the weights of the cubic through them."""
    first = np.clip(np.floor(place).astype(np.int64) - 1, 0, steps - 3)
    index = first[:, None] + np.arange(4)
    u = place - first
    weight = np.ones((place.size, 4))
    for i in range(4):
        for j in range(4):
            if i != j:
                weight[:, i] *= (u - j) / (i - j)
    return index, weight


def _state_at(recording: Recording, time: float) -> Array:
    """Return angles and velocities (2, joints) at `time` from a cubic fitted to the samples around it."""
    window = max(START_WINDOW, 5.0 * recording.interval)
    near = np.abs(recording.time - time) <= window
    filled = recording.filled()[:, near]
    cubic = linalg.polyfit(recording.time[near] - time, filled.T, 3)
    return np.asarray(cubic[:2])
