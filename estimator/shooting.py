"""Multiple shooting: maximum likelihood on any recording, cut into segments whose starting states are unknown.

Free simulation forgets nothing: on a long recording an error of the model, or the chaos of an arm that turns
over, drowns what the parameters do. On a segment of a second it cannot. Bock, "Recent advances in parameter
identification techniques for o.d.e.", in Deuflhard and Hairer (eds.), Numerical Treatment of Inverse Problems
(1983). The segments are not joined: noise that a rigid arm does not have, such as play and flexing, may
move the state between them.

Short segments come first: started far from the truth, they find it; longer ones then sharpen it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from estimator.arrays import Array
from estimator.coordinates import Coordinates, scales_of
from estimator.errors import RecordingError
from estimator.model import Model
from estimator.physics import Physics
from estimator.recording import Recording
from estimator.segmented_least_squares import Segmented, minimise_segmented
from estimator.simulation import simulate

Indices = npt.NDArray[np.int64]

LONGEST_STEP = 1e-3  # s
WIDTH_FLOOR = 3e-3  # rad/s: narrower costs much time and is not seen in a second of motion
STARTING_WIDTH = 0.05  # rad/s
START = {"stribeck_rise": 0.2, "stribeck_velocity": 0.2, "load": 0.02, "delay": 0.0, "lag": 1e-3}
SHORT = 0.25  # of the segments' length, to begin with
FEWEST = 8  # samples in a segment
COARSE = 1e-3
FINE = 3e-5
ANGLE_SCALE = 0.1  # rad
START_WINDOW = 0.03  # s on either side, for the state that a segment starts from


@dataclass(frozen=True)
class Segment:
    """A piece of a recording on the grid of its simulation."""

    recording: int
    """Which recording it is from."""
    first: int
    """Grid point of its start."""
    steps: int
    """Grid steps that it takes."""
    index: Indices
    """Grid points around each of its samples (samples, 4), counted from `first`."""
    weight: Array
    """Of each of them: cubic interpolation (samples, 4)."""
    position: Array
    """Measured (joints, samples) [rad]."""
    state: Array
    """Angles and velocities at its start by a local fit (2, joints) [rad, rad/s]."""


@dataclass(frozen=True)
class ShootingEstimate:
    """What multiple shooting found."""

    model: Model
    names: tuple[str, ...]
    """`model.names`, then zero_1 ..: what the encoder reads where the angle is 0, if asked for."""
    units: tuple[str, ...]
    value: Array
    """(parameters,) [SI]."""
    covariance: Array
    """(parameters, parameters), robust against model error: see `Segmented.covariance`."""
    residual_rms: Array
    """Measured less simulated position (joints,) [rad]."""
    segments: int
    segment_length: float
    """[s]."""
    iterations: int

    @property
    def std(self) -> Array:
        """Standard errors (parameters,)."""
        std: Array = np.sqrt(np.diag(self.covariance))
        return std

    @property
    def parameters(self) -> dict[str, float]:
        """Values by name [SI]."""
        return dict(zip(self.names, self.value.tolist(), strict=True))


@dataclass(frozen=True)
class _Grid:
    """A recording's times as equal simulation steps."""

    start: float
    step: float
    edges: Array

    @classmethod
    def of(cls, recording: Recording) -> "_Grid":
        span = float(recording.time[-1] - recording.time[0])
        count = int(np.ceil(span / LONGEST_STEP))
        step = span / count
        return cls(float(recording.time[0]), step, recording.time[0] + step * np.arange(count + 1))


class Shooting:
    """The residuals of all segments by coordinates."""

    def __init__(self, recordings: Sequence[Recording], model: Model, zeros: bool, length: float) -> None:
        self._recordings = recordings
        self._grids = [_Grid.of(recording) for recording in recordings]
        self.segments = [
            segment
            for number, (recording, grid) in enumerate(zip(recordings, self._grids, strict=True))
            for segment in cut(recording, number, grid.start, grid.step, len(grid.edges) - 1, length)
        ]
        self.noise = np.max([recording.noise for recording in recordings], axis=0)[:, None]
        self.zeros = model.joints if zeros else 0
        velocity = float(np.sqrt(np.mean([np.mean(segment.state[1] ** 2) for segment in self.segments]))) + 0.1
        torque = float(np.sqrt(np.mean([np.mean(recording.torque**2) for recording in recordings])))
        self.state_scale = np.repeat([ANGLE_SCALE, velocity], model.joints).reshape(2, -1)
        self._scales = (torque, velocity)
        self._model = model
        self._driven: dict[tuple[float, float], list[Array]] = {}

    def coordinates(self, inertia: float) -> Coordinates:
        """The parameters' coordinates; `inertia` [kg m^2] of the arm as a scale."""
        return Coordinates(self._model.names, scales_of(self._model.names, *self._scales, inertia), WIDTH_FLOOR)

    def torque(self, physics: Physics) -> list[Array]:
        """Mean motor torque over each grid step (joints, steps) of each recording, late and lagging."""
        key = (physics.delay, physics.lag)
        driven = self._driven.get(key)
        if driven is None:
            driven = [_driven(*pair, physics) for pair in zip(self._recordings, self._grids, strict=True)]
            if len(self._driven) > 64:
                self._driven.clear()
            self._driven[key] = driven
        return driven

    def position(self, segment: Segment, physics: Physics, state: Array) -> Array:
        """Simulated positions at a segment's samples (joints, samples) [rad] from `state` (2, joints)."""
        torque = self.torque(physics)[segment.recording][:, segment.first : segment.first + segment.steps]
        step = self._grids[segment.recording].step
        grid, end = simulate(physics, state, np.ascontiguousarray(torque[:, :, None]), step)
        grid = np.concatenate((grid, end[:1].T), axis=1)
        interpolated: Array = np.einsum("jsn,sn->js", grid[:, segment.index], segment.weight)
        return interpolated

    def residual(self, coordinates: Coordinates, number: int, shared: Array, own: Array) -> Array:
        """Simulated less measured positions of one segment in units of their noise (rows,)."""
        segment = self.segments[number]
        count = len(coordinates.names)
        physics = Physics.of(dict(zip(coordinates.names, coordinates.values(shared[:count]).tolist(), strict=True)))
        position = self.position(segment, physics, own.reshape(2, -1) * self.state_scale)
        if self.zeros:
            position = position + ANGLE_SCALE * shared[count:, None]
        difference = np.where(np.isfinite(segment.position), position - segment.position, 0.0)
        return np.asarray((difference / self.noise).reshape(-1))

    def start(self) -> Array:
        """Each segment's own coordinates as its measured positions suggest (segments, 2 joints)."""
        return np.stack([(segment.state / self.state_scale).reshape(-1) for segment in self.segments])


def estimate_by_shooting(
    recordings: Sequence[Recording], model: Model, start: Array, *, length: float = 1.0, zeros: bool = False
) -> ShootingEstimate:
    """Maximum likelihood over all `recordings`, cut into segments of about `length` [s].

    `start`: base parameters (base parameters,) [SI], for instance of `estimator.idim`. `zeros`: joint zero
    offsets [rad] are unknown too; with gravity they are seen, without they are not. The same recordings give
    the same numbers. Raises RecordingError when nothing is long enough, ConvergenceError.
    """
    shared = None
    for part, enough in ((SHORT, COARSE), (1.0, FINE)):
        problem = Shooting(recordings, model, zeros, part * length)
        coordinates = problem.coordinates(max(float(start[0]), 1e-6))
        if shared is None:
            shared = np.concatenate((coordinates.coordinates(_start(model, start)), np.zeros(problem.zeros)))
        found = _fit(problem, coordinates, shared, enough)
        shared = found.shared
    return _estimate(problem, coordinates, model, found, length)


def _fit(problem: Shooting, coordinates: Coordinates, shared: Array, enough: float) -> Segmented:
    def residual(number: int, shared: Array, own: Array) -> Array:
        return problem.residual(coordinates, number, shared, own)

    return minimise_segmented(residual, shared, problem.start(), enough)


def _estimate(
    problem: Shooting, coordinates: Coordinates, model: Model, found: Segmented, length: float
) -> ShootingEstimate:
    count = len(model.names)
    slope = np.eye(found.shared.size) * ANGLE_SCALE
    slope[:count, :count] = coordinates.slopes(found.shared[:count])
    squares = np.zeros(model.joints)
    samples = np.zeros(model.joints)
    for number, (segment, own) in enumerate(zip(problem.segments, found.own, strict=True)):
        rows = problem.residual(coordinates, number, found.shared, own).reshape(model.joints, -1) * problem.noise
        squares += np.sum(rows**2, axis=1)
        samples += np.isfinite(segment.position).sum(axis=1)
    zero_names = tuple(f"zero_{joint + 1}" for joint in range(problem.zeros))
    return ShootingEstimate(
        model,
        (*model.names, *zero_names),
        (*model.units, *("rad",) * problem.zeros),
        np.concatenate((coordinates.values(found.shared[:count]), ANGLE_SCALE * found.shared[count:])),
        slope @ found.covariance() @ slope.T,
        np.sqrt(squares / samples),
        len(problem.segments),
        length,
        found.iterations,
    )


def _start(model: Model, base: Array) -> Array:
    known = dict(zip(model.base_names, base.tolist(), strict=True))
    known |= dict.fromkeys((f"coulomb_width_{joint + 1}" for joint in range(model.joints)), STARTING_WIDTH)
    return np.array([known.get(name, START.get(name.rstrip("_12"), 0.0)) for name in model.names])


def _driven(recording: Recording, grid: _Grid, physics: Physics) -> Array:
    torque = recording.mean_torque(grid.edges, physics.delay)
    if physics.lag <= 0.0:
        return torque
    # lag y' = u - y over a step of constant u: exact, and so is the step's mean of y.
    a = np.exp(-grid.step / physics.lag)
    start = torque[:, :1]
    end, _ = lfilter([1.0 - a], [1.0, -a], torque, axis=1, zi=a * start)
    before = np.concatenate((start, end[:, :-1]), axis=1)
    mean: Array = torque - physics.lag / grid.step * (end - before)
    return mean


def cut(recording: Recording, number: int, start: float, step: float, steps: int, length: float) -> list[Segment]:
    """Cut a recording, on a grid of `steps` of `step` [s] from `start` [s], into equal pieces of about `length` [s]."""
    pieces = max(1, round(steps * step / length))
    edges = np.round(np.linspace(0, steps, pieces + 1)).astype(np.int64)
    place = (recording.time - start) / step
    segments = []
    for first, last in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        inside = (place >= first - 1e-6) & (place < last) if last < steps else (place >= first - 1e-6)
        if inside.sum() < FEWEST or not np.isfinite(recording.position[:, inside]).any(axis=1).all():
            continue
        index, weight = _cubic(place[inside] - first, last - first)
        state = _state_at(recording, start + step * first)
        segments.append(Segment(number, first, last - first, index, weight, recording.position[:, inside], state))
    if not segments:
        raise RecordingError(
            f"no piece of {length:g} s holds {FEWEST} samples: record faster, or choose longer segments"
        )
    return segments


def _cubic(place: Array, steps: int) -> tuple[Indices, Array]:
    """Grid points around each place (samples, 4) and the weights of the cubic through them."""
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
    """Angles and velocities (2, joints) at `time` by a cubic through the samples around it."""
    window = max(START_WINDOW, 5.0 * recording.interval)
    near = np.abs(recording.time - time) <= window
    filled = recording.filled()[:, near]
    cubic = np.polynomial.polynomial.polyfit(recording.time[near] - time, filled.T, 3)
    return np.asarray(cubic[:2])
