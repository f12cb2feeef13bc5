"""Multiple shooting: maximum likelihood on any recording, cut into segments with unknown initial states.

Open-loop simulation accumulates errors: on a long recording, model errors or the chaos of a tumbling arm mask the
parameters' influence. On segments of one second, this does not happen. Source: Bock, "Recent advances in parameter
identification techniques for o.d.e.", in Deuflhard and Hairer (eds.), Numerical Treatment of Inverse Problems (1983).
The segments are not joined, since effects that the rigid model lacks, such as backlash and flexing, may change the
state between them.

Short segments are fitted first, since they converge even from a poor initial guess. Longer segments then refine the
result, first with coarse integration steps. `Term.spread` serves as a prior.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.data.recording import Recording
from hil.estimator.data.segments import FEWEST, Grid, RecordingSegment, cut, grid_torque, grid_torque_slopes
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.covariance import by_parameters
from hil.estimator.fit.reparametrisation import CoordinatePrior, Coordinates, Sizes, scales_of
from hil.estimator.fit.resolved_widths import resolved_widths
from hil.estimator.fit.segmented_least_squares import Expected, Segmented, minimise_segmented
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import term_of
from hil.estimator.options import ShootingOptions
from hil.estimator.simulation.arm import simulate
from hil.estimator.simulation.presliding_sensitivity import sensitive

DEFAULTS = ShootingOptions()
ALL = slice(None)
MOST_WEIGHT = 1e9
ENOUGH = 1.25  # minimum number of samples in a short segment, relative to FEWEST
MOST_SHORT = 0.6  # short segments are not tried if they would have to be longer than this fraction of a segment


@dataclass(frozen=True)
class ShootingEstimate:
    """Result of multiple shooting."""

    model: Model
    names: tuple[str, ...]
    """Parameter names, as in `Model.names`."""
    units: tuple[str, ...]
    value: Array
    """Parameter values (parameters,) [SI]."""
    covariance: Array
    """Covariance (parameters, parameters), robust to model errors; see `Segmented.covariance`."""
    zeros: Array
    """Zero errors, true minus measured angle (recordings, joints) [rad]; shape (0, joints) if not estimated."""
    zeros_std: Array
    """Standard errors of `zeros`, with the same shape."""
    residual_rms: Array
    """RMS of measured minus simulated position (joints,) [rad]."""
    segments: int
    segment_length: float
    """Nominal length of a segment [s]."""
    iterations: int
    residual_over_noise: Array
    """RMS residual in units of the noise (joints,)."""
    own: Array
    """Initial state of each segment (segments, 2 joints), in units of `Shooting.state_scale`."""
    fitted: slice = field(default_factory=lambda: ALL)
    """Which segments of each recording were fitted."""

    @property
    def std(self) -> Array:
        """Standard errors of the parameters (parameters,) [SI]."""
        std: Array = np.sqrt(np.diag(self.covariance))
        return std

    @property
    def parameters(self) -> dict[str, float]:
        """Parameter values by name [SI]."""
        return dict(zip(self.names, self.value.tolist(), strict=True))


class Shooting:
    """The residuals of all segments as a function of coordinates."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        model: Model,
        length: float,
        *,
        zeros: bool = False,
        of: slice = ALL,
        most: int | None = None,
        step: float | None = None,
        options: ShootingOptions = DEFAULTS,
    ) -> None:
        """Cut the recordings into segments.

        most: maximum number of segments, evenly distributed; by default all. step: longest integration step [s].
        """
        self._options = options
        self._recordings = recordings
        self.zeros = len(recordings) * model.joints if zeros else 0
        self._grids = [Grid.of(recording, step or options.max_step) for recording in recordings]
        every = [
            segment
            for number, (recording, grid) in enumerate(zip(recordings, self._grids, strict=True))
            for segment in cut(recording, number, grid, length)[of]
        ]
        self.segments = every[:: max(1, -(-len(every) // most))] if most else every
        self.noise = np.max([recording.noise for recording in recordings], axis=0)[:, None]
        velocity = float(np.sqrt(np.mean([np.mean(segment.state[1] ** 2) for segment in self.segments]))) + 0.1
        torque = float(np.sqrt(np.mean([np.mean(recording.torque**2) for recording in recordings])))
        self.state_scale = np.repeat([options.angle_scale, velocity], model.joints).reshape(2, -1)
        self._scales = (torque, velocity)
        self.speeds = np.max([np.abs(segment.state[1]) for segment in self.segments], axis=0)
        self._model = model
        self._trust = np.ones((len(self.segments), model.joints))
        self._driven: dict[tuple[float, ...], list[tuple[Array, Array]]] = {}

    def coordinates(self, base: Mapping[str, float]) -> Coordinates:
        """Return the parameters' coordinates, given approximate base parameters by name [SI]."""
        names, options = self._model.names, self._options
        scales = scales_of(names, Sizes(*self._scales, max(base["inertia_1"], 1e-6)))
        resolved = resolved_widths(names, base, options.max_step, options.coordinates.widths_per_substep)
        # The regression may make a joint much too light, but its Coulomb step must not stay wide.
        return Coordinates(names, scales, options.coordinates, np.minimum(resolved, options.initial_width))

    def position(self, segment: RecordingSegment, physics: Physics, state: Array) -> Array:
        """Return the simulated positions at a segment's samples (joints, samples) [rad] from `state` (2, joints)."""
        torque = self._torque(segment, physics)[0]
        step = self._grids[segment.recording].step
        most = self._options.max_substeps
        grid, end = simulate(physics, state, np.ascontiguousarray(torque[:, :, None]), step, most, held=True)
        return segment.at_samples(np.concatenate((grid, end[:1].T), axis=1))

    def position_by_values(
        self, segment: RecordingSegment, values: Mapping[str, float], offsets: Array, own: Array
    ) -> Array:
        """Return the simulated positions for parameter values [SI], `offsets` of the zeros, and the segment's own
        coordinates.
        """
        state = own.reshape(2, -1) * self.state_scale
        return self.position(segment, self._with_zeros(values, segment, offsets), state)

    def residual(self, coordinates: Coordinates, number: int, shared: Array, own: Array) -> Array:
        """Return simulated minus measured positions of one segment, in units of their noise (rows,)."""
        segment = self.segments[number]
        position = self.position(
            segment, self._physics(coordinates, segment, shared), own.reshape(2, -1) * self.state_scale
        )
        return self._rows(number, position)

    def derivative(self, coordinates: Coordinates, number: int, shared: Array, own: Array) -> tuple[Array, Array]:
        """Return the residual and its derivatives (rows, all) with respect to the shared and then the segment's own
        coordinates.
        """
        count = len(coordinates.names)
        values = dict(zip(coordinates.names, coordinates.values(shared[:count]).tolist(), strict=True))
        rows, columns = self.derivative_by_values(number, values, shared[count:], own, coordinates.names)
        # A diverging motion has no finite derivatives; the minimiser reports this.
        with np.errstate(over="ignore", invalid="ignore"):
            columns[:, :count] = columns[:, :count] @ coordinates.slopes(shared[:count])
        return rows, columns

    def derivative_by_values(
        self, number: int, values: Mapping[str, float], offsets: Array, own: Array, names: Sequence[str]
    ) -> tuple[Array, Array]:
        """Return the residual at the parameters `values` [SI], and its derivatives (rows, all).

        The columns are the derivatives with respect to the parameters `names`, the `offsets` of the zeros and the
        segment's own coordinates, in this order.
        """
        segment = self.segments[number]
        physics = self._with_zeros(values, segment, offsets)
        joints = self._model.joints
        zeros = tuple(f"zero_{joint + 1}" for joint in range(joints) if self.zeros)
        state = tuple(f"{what}_{joint + 1}" for what in ("position", "velocity") for joint in range(joints))
        motion = sensitive(physics)(
            physics,
            own.reshape(2, -1) * self.state_scale,
            (*names, *zeros, *state),
            self._grids[segment.recording].step,
            self._options.max_substeps,
            held=True,
        )
        # One step is appended so that the state after the last step is returned; its torque is irrelevant.
        torque, slopes = (
            np.pad(each, ((0, 0),) * (each.ndim - 1) + ((0, 1),)) for each in self._torque(segment, physics)
        )
        grid, change = motion.advance(torque[:, :, None], slopes[:, :, :, None])
        by_value = segment.at_samples(change)
        count = len(names)
        shared = count + self.zeros
        columns = np.zeros((*by_value.shape[:2], shared + own.size))
        columns[:, :, :count] = by_value[:, :, :count]
        its_zeros = columns[:, :, count:shared][:, :, self._zeros_of(segment)]
        its_zeros[:] = by_value[:, :, count : count + len(zeros)] * self._options.angle_scale
        columns[:, :, shared:] = by_value[:, :, count + len(zeros) :] * self.state_scale.reshape(-1)
        known = np.isfinite(segment.position)[:, :, None]
        with np.errstate(over="ignore", invalid="ignore"):
            columns = np.where(known, columns / self._noise(number)[:, :, None], 0.0)
        return self._rows(number, segment.at_samples(grid)), columns.reshape(-1, columns.shape[2])

    def errors(self, coordinates: Coordinates, found: Segmented) -> Array:
        """Return the RMS of simulated minus measured position of each segment (segments, joints) [rad]."""
        rms = np.empty_like(self._trust)
        for number, (segment, own) in enumerate(zip(self.segments, found.own, strict=True)):
            rows = self.residual(coordinates, number, found.shared, own).reshape(self._model.joints, -1)
            rms[number] = np.sqrt(np.sum((rows * self._noise(number)) ** 2, axis=1) / _samples(segment))
        return rms

    def over_noise(self, coordinates: Coordinates, found: Segmented) -> Array:
        """Return the RMS residual in units of the noise (joints,)."""
        errors, samples = self.errors(coordinates, found), np.stack([_samples(each) for each in self.segments])
        mean = np.sum(errors**2 * samples, axis=0) / samples.sum(axis=0)
        return np.asarray(np.sqrt(mean) / self.noise[:, 0])

    def downweight(self, errors: Array) -> None:
        """Downweight the segments whose `errors` (segments, joints) [rad] are larger than usual."""
        usual = np.median(errors, axis=0)
        self._trust = np.minimum(1.0, usual / np.maximum(errors, 1e-12))

    def weight_as(self, other: "Shooting") -> None:
        """Use the weights of `other`, which has the same segments."""
        self._trust = other._trust

    def expected(self, coordinates: Coordinates, shared: Array, own: Array) -> Expected:
        """Return the prior on small terms, weighted by the mean square residual at these coordinates."""
        count = len(coordinates.names)
        inertia = float(coordinates.scales[coordinates.names.index("inertia_1")])
        prior = CoordinatePrior.of(coordinates.names, coordinates.scales, Sizes(*self._scales, inertia))
        centre, precision = np.zeros(shared.size), np.zeros(shared.size)
        centre[:count], precision[:count] = prior.centre, prior.precision
        if not precision.any():
            return Expected.nothing(shared.size)
        rows = [self.residual(coordinates, number, shared, each) for number, each in enumerate(own)]
        with np.errstate(over="ignore"):  # if the motion diverges
            weight = min(max(1.0, float(np.mean(np.concatenate(rows) ** 2))), MOST_WEIGHT)
        return Expected(centre, weight * precision, weight)

    def start(self) -> Array:
        """Return initial guesses (segments, 2 joints) of each segment's own coordinates from its measured positions."""
        return np.stack([(segment.state / self.state_scale).reshape(-1) for segment in self.segments])

    def _zeros_of(self, segment: RecordingSegment) -> slice:
        """Return the indices of a segment's encoder zeros among those of all recordings; empty if not estimated."""
        if not self.zeros:
            return slice(0, 0)
        first = segment.recording * self._model.joints
        return slice(first, first + self._model.joints)

    def _physics(self, coordinates: Coordinates, segment: RecordingSegment, shared: Array) -> Physics:
        count = len(coordinates.names)
        values = dict(zip(coordinates.names, coordinates.values(shared[:count]).tolist(), strict=True))
        return self._with_zeros(values, segment, shared[count:])

    def _with_zeros(self, values: Mapping[str, float], segment: RecordingSegment, offsets: Array) -> Physics:
        zeros = self._options.angle_scale * offsets[self._zeros_of(segment)]
        return Physics.of({**values, **{f"zero_{joint + 1}": float(zero) for joint, zero in enumerate(zeros)}})

    def _noise(self, number: int) -> Array:
        """Return the assumed standard deviation of a segment's samples (joints, 1) [rad]."""
        noise: Array = self.noise / self._trust[number][:, None]
        return noise

    def _rows(self, number: int, position: Array) -> Array:
        measured = self.segments[number].position
        difference = np.where(np.isfinite(measured), position - measured, 0.0)
        return np.asarray((difference / self._noise(number)).reshape(-1))

    def _torque(self, segment: RecordingSegment, physics: Physics) -> tuple[Array, Array]:
        """Return the motor torque over a segment's grid steps (joints, steps) and its slopes (2, joints, steps)."""
        joints = self._model.joints
        times = physics.delays[:joints], physics.lags[:joints]
        key = tuple(np.concatenate(times).tolist())
        driven = self._driven.get(key)
        if driven is None:
            pairs = list(zip(self._recordings, self._grids, strict=True))
            driven = [(grid_torque(*pair, *times), grid_torque_slopes(*pair, *times)) for pair in pairs]
            if len(self._driven) > 8:
                self._driven.clear()
            self._driven[key] = driven
        torque, slopes = driven[segment.recording]
        part = slice(segment.first, segment.first + segment.steps)
        return torque[:, part], slopes[:, :, part]


@one_blas_thread
def estimate_by_shooting(
    recordings: Sequence[Recording],
    model: Model,
    start: Array,
    *,
    length: float = 1.0,
    zeros: bool = False,
    of: slice = ALL,
    near: ShootingEstimate | None = None,
    options: ShootingOptions = DEFAULTS,
) -> ShootingEstimate:
    """Estimate parameters by maximum likelihood over all `recordings`, cut into segments.

    Args:
        recordings: recordings of one arm.
        model: the model to fit.
        start: initial guess of the base parameters (base parameters,) [SI], such as that of
            `hil.estimator.baselines.idim`.
        length: nominal length of a segment [s].
        zeros: whether to estimate the encoders' zero errors too, one per joint and recording, for servos whose zero
            changes at every start. The zeros can only be determined if gravity acts on the arm.
        of: which segments of each recording to fit; the others are left for validation.
        near: an estimate from another model or from other segments of the same recordings, used as the only initial
            guess.
        options: tolerances.

    Raises:
        RecordingError: if no segment is long enough.
        ConvergenceError: if no minimum is found.
    """

    def posed(part: float, most: int | None, step: float) -> Shooting:
        return Shooting(recordings, model, part * length, zeros=zeros, of=of, most=most, step=step, options=options)

    coarse = posed(1.0, None, options.coarse_step)
    coordinates = coarse.coordinates(dict(zip(model.base_names, start.tolist(), strict=True)))
    if near is None:
        least = ENOUGH * FEWEST * max(each.interval for each in recordings) / length
        short = posed(
            max(options.short, least if least < MOST_SHORT else 0.0), options.start_segments, options.coarse_step
        )
        long = posed(1.0, options.start_segments, options.coarse_step)
        x = _from_guesses(short, long, coordinates, model, start, options)
    else:
        x = _from_estimate(near, coordinates, model, coarse.zeros, options)
    found = _fit(coarse, coordinates, x, coarse.start(), options.ftol_start, options)
    for _ in range(options.reweightings):
        coarse.downweight(coarse.errors(coordinates, found))
        found = _fit(coarse, coordinates, found.shared, found.own, options.ftol_refine, options)
    problem = posed(1.0, None, options.max_step)
    problem.weight_as(coarse)
    found = _fit(problem, coordinates, found.shared, found.own, options.ftol, options)
    sharp = coordinates.without_wide_steps(found.shared, problem.speeds)
    if not np.array_equal(sharp, found.shared):
        found = _fit(problem, coordinates, sharp, found.own, options.ftol, options)
    return replace(_estimate(problem, coordinates, model, found, length, options.angle_scale), fitted=of)


def _from_guesses(
    short: Shooting, long: Shooting, coordinates: Coordinates, model: Model, start: Array, options: ShootingOptions
) -> Array:
    """Fit from several guesses, since Stribeck friction causes local minima; return the best shared coordinates."""
    ends: list[Segmented] = []
    lost: list[ConvergenceError] = []
    for x in _initial_guesses(short, coordinates, model, start, options):
        try:
            near = _fit(short, coordinates, x, short.start(), options.ftol_start, options)
            ends.append(_fit(long, coordinates, near.shared, long.start(), options.ftol_start, options))
        except ConvergenceError as error:
            lost.append(error)
    if not ends:
        raise lost[0]
    return min(ends, key=lambda end: end.cost).shared


def _from_estimate(
    near: ShootingEstimate, coordinates: Coordinates, model: Model, zeros: int, options: ShootingOptions
) -> Array:
    """Return the shared coordinates of `near`, with initial guesses for parameters that it lacks."""
    known = near.parameters
    for joint in range(1, model.joints + 1):
        known.setdefault(f"coulomb_width_{joint}", options.initial_width)
        known.setdefault(f"presliding_stiffness_{joint}", abs(known[f"coulomb_{joint}"]) / options.initial_bend)
        known.setdefault(f"presliding_damping_{joint}", abs(known[f"viscous_{joint}"]))
    value = np.array([known.get(name, term_of(name).initial) for name in model.names])
    offsets = near.zeros.reshape(-1) if near.zeros.size == zeros else np.zeros(zeros)
    return np.concatenate((coordinates.coordinates(value), offsets / options.angle_scale))


def _fit(
    problem: Shooting, coordinates: Coordinates, shared: Array, own: Array, ftol: float, options: ShootingOptions
) -> Segmented:
    residual, derivative = partial(problem.residual, coordinates), partial(problem.derivative, coordinates)
    expected = problem.expected(coordinates, shared, own)
    moved = coordinates.moved_in_proportion
    return minimise_segmented(residual, derivative, shared, own, ftol, options.minimiser, expected, moved)


def _estimate(
    problem: Shooting, coordinates: Coordinates, model: Model, found: Segmented, length: float, angle_scale: float
) -> ShootingEstimate:
    count = len(model.names)
    slope = np.eye(found.shared.size) * angle_scale
    slope[:count, :count] = coordinates.slopes(found.shared[:count])
    value = angle_scale * found.shared
    value[:count] = coordinates.values(found.shared[:count])
    recording = np.array([segment.recording for segment in problem.segments])
    floored = np.zeros(value.size, dtype=np.bool_)
    floored[:count] = coordinates.floored
    covariance = by_parameters(found.covariance(recording, problem.zeros), slope, value, floored)
    samples = np.stack([_samples(segment) for segment in problem.segments])
    squares = problem.errors(coordinates, found) ** 2 * samples
    return ShootingEstimate(
        model,
        model.names,
        model.units,
        value[:count],
        covariance[:count, :count],
        value[count:].reshape(-1, model.joints),
        np.sqrt(np.diag(covariance)[count:]).reshape(-1, model.joints),
        np.sqrt(squares.sum(axis=0) / samples.sum(axis=0)),
        len(problem.segments),
        length,
        found.iterations,
        problem.over_noise(coordinates, found),
        found.own,
    )


def _samples(segment: RecordingSegment) -> Array:
    """Return the number of valid samples (joints,)."""
    return np.asarray(np.isfinite(segment.position).sum(axis=1), dtype=np.float64)


def _initial_guesses(
    problem: Shooting, coordinates: Coordinates, model: Model, base: Array, options: ShootingOptions
) -> Iterator[Array]:
    """Yield initial shared coordinates: `base` and guesses for friction."""
    known = dict(zip(model.base_names, base.tolist(), strict=True))
    known |= dict.fromkeys((f"coulomb_width_{joint + 1}" for joint in range(model.joints)), options.initial_width)
    for joint in range(1, model.joints + 1):
        known[f"presliding_stiffness_{joint}"] = abs(known[f"coulomb_{joint}"]) / options.initial_bend
        known[f"presliding_damping_{joint}"] = abs(known[f"viscous_{joint}"])
    rising = "stribeck_velocity_1" in model.names
    velocities = options.initial_stribeck_velocities
    for velocity in velocities if rising else velocities[:1]:
        known |= {f"stribeck_velocity_{joint}": velocity for joint in range(1, model.joints + 1)}
        value = np.array([known.get(name, term_of(name).initial) for name in model.names])
        yield np.concatenate((coordinates.coordinates(value), np.zeros(problem.zeros)))
