"""Fits that estimate a defect of the recordings together with the parameters."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.defects.hypotheses import Course, Hypothesis
from hil.estimator.errors import ConvergenceError, EstimationError
from hil.estimator.fit.multiple_shooting import Shooting, ShootingEstimate, estimate_by_shooting
from hil.estimator.fit.segmented_least_squares import Expected, Segmented, minimise_segmented
from hil.estimator.models.terms import FRICTIONS, kind_of, term_of
from hil.estimator.options import ShootingOptions

OPTIONS = ShootingOptions()
QUICK = ShootingOptions(ftol=1e-3, max_step=OPTIONS.coarse_step, reweightings=1)
HOPELESS = 100.0  # mean square of the residual relative to the noise above which a fit is not refined
IGNORED = 1e-3  # weight of a segment in which a sudden change occurs


@dataclass(frozen=True)
class AlteredFit:
    """Result of a fit with or without a defect.

    values: parameters by name [SI]. unknowns: values of the defect's unknowns. left: mean square of the residual in
    units of the noise.
    """

    values: dict[str, float]
    unknowns: Array
    left: float


class Altered:
    """Fits the segments of an estimate with unknowns for a defect in addition to the parameters."""

    def __init__(self, recordings: Sequence[Recording], found: ShootingEstimate) -> None:
        self.estimate = estimate = _with_every_friction(found)
        self._recordings = recordings
        self._parts: dict[tuple[object, ...], Array | None] = {}
        self._fits: dict[tuple[object, ...] | None, AlteredFit] = {}
        self.problem = Shooting(
            recordings,
            estimate.model,
            estimate.segment_length,
            zeros=estimate.zeros.size > 0,
            of=estimate.fitted,
            step=OPTIONS.coarse_step,
        )
        joints = estimate.model.joints
        zeros = () if estimate.zeros.size else tuple(f"zero_{joint}" for joint in range(1, joints + 1))
        added = (*(("torque_scale_2",) if joints == 2 else ()), *zeros)
        self.names = (*estimate.names, *(name for name in added if name not in estimate.names))
        self.values = {name: term_of(name).absent for name in self.names} | estimate.parameters
        self.offsets = estimate.zeros.reshape(-1) / OPTIONS.angle_scale

    @property
    def segments(self) -> int:
        return len(self.problem.segments)

    def measured(self, number: int) -> Array:
        """Measured angles of a segment in units of the noise (rows of joints, samples); 0 where they are missing."""
        position = self.problem.segments[number].position
        return np.asarray(np.nan_to_num(position) / self.problem.noise)

    def linear(self, number: int) -> tuple[Array, Array]:
        """Residual of a segment at the estimate (rows,), and its derivatives with respect to the parameters `names`,
        the encoder zeros and the scales of the angles (rows, all); both without the part that the initial state
        explains.
        """
        problem, own = self.problem, self.estimate.own[number]
        rows, columns = problem.derivative_by_values(number, self.values, self.offsets, own, self.names)
        joints, shape = self.estimate.model.joints, problem.segments[number].position.shape
        shared = len(self.names) + problem.zeros
        angle = self.measured(number) + rows.reshape(shape)
        scales = np.zeros((*shape, joints))
        for joint in range(joints):
            scales[joint, :, joint] = angle[joint]
        every = np.concatenate((columns[:, :shared], scales.reshape(-1, joints)), axis=1)
        Q = linalg.qr(columns[:, shared:])[0]
        return rows - Q @ (Q.T @ rows), every - Q @ (Q.T @ every)

    def direction(self, hypothesis: Hypothesis) -> Array:
        """Change in the parameters `names` per unit of each unknown (names, unknowns), as in `Direction`."""
        if hypothesis.kind == "scale":  # the angle that scaling leaves unchanged is unknown
            zeros = [name for name in self.names if kind_of(name) == "zero"]
            return np.array([[float(name == zero) for zero in zeros] for name in self.names])
        return np.array([[each.get(name, 0.0) for each in hypothesis.directions] for name in self.names])

    @staticmethod
    def sizes(hypothesis: Hypothesis, value: Array) -> Array:
        """Factors that convert relative changes to SI units (names,): `value`, or 1 for absolute changes."""
        return np.ones_like(value) if hypothesis.is_absolute else value

    def fit(self, hypothesis: Hypothesis | None, near: AlteredFit | None = None) -> AlteredFit:
        """Fit parameters, zeros and defect. Raises ConvergenceError.

        near: fit of another defect, used as a further initial guess.
        """
        key = None if hypothesis is None else (hypothesis.kind, hypothesis.joints, hypothesis.course)
        if key not in self._fits:
            self._fits[key] = self._fit(hypothesis)
        found = self._fits[key]
        if near is None or near.left > found.left:
            return found
        with suppress(ConvergenceError):
            found = min(found, self._refined(hypothesis, near, found.unknowns), key=lambda each: each.left)
        return found

    def fit_from(self, hypothesis: Hypothesis, near: AlteredFit) -> AlteredFit:
        """Fit as `fit` does, but only from the fit of the same defect at another time. Raises ConvergenceError."""
        key = (hypothesis.kind, hypothesis.joints, hypothesis.course)
        if key not in self._fits:
            self._fits[key] = self._refined(hypothesis, near, near.unknowns)
        return self._fits[key]

    def _refined(self, hypothesis: Hypothesis | None, near: AlteredFit, unknowns: Array) -> AlteredFit:
        posed = _Posed(self, hypothesis)
        value = np.array([near.values[name] for name in self.estimate.names])
        found = posed.minimum(posed.begun(value, unknowns), self.problem.start(), OPTIONS.ftol)
        return self._result(posed, hypothesis, found)

    def _fit(self, hypothesis: Hypothesis | None) -> AlteredFit:
        posed, estimate = _Posed(self, hypothesis), self.estimate
        ends, unknowns = [], np.zeros(posed.unknowns)
        with suppress(ConvergenceError):
            ends.append(posed.minimum(posed.begun(estimate.value, unknowns), estimate.own))
            unknowns = ends[0].shared[ends[0].shared.size - posed.unknowns :]
        # Friction at low speed was fitted to a recording that has the defect, so this fit may have ended in a local
        # minimum.
        without = None if hypothesis is None else self._without(hypothesis, unknowns)
        if without is not None:
            with suppress(ConvergenceError):
                ends.append(posed.minimum(posed.begun(without, unknowns), self.problem.start()))
        if not ends:
            raise ConvergenceError("the recordings cannot be fitted with this defect")
        best = min(ends, key=lambda each: each.cost)
        if best.cost < HOPELESS * sum(self.samples(k) for k in range(self.segments)):
            with suppress(ConvergenceError):
                best = posed.minimum(best.shared, best.own, OPTIONS.ftol)
        return self._result(posed, hypothesis, best)

    def _result(self, posed: "_Posed", hypothesis: Hypothesis | None, best: Segmented) -> AlteredFit:
        rows = [posed.residual(k, best.shared, own) for k, own in enumerate(best.own)]
        used = np.full(self.segments, True) if hypothesis is None else hypothesis.used
        samples = sum(self.samples(k) for k in range(self.segments) if used[k])
        values = posed.coordinates.values(best.shared[: len(self.estimate.names)])
        return AlteredFit(
            dict(zip(self.estimate.names, values.tolist(), strict=True)),
            best.shared[best.shared.size - posed.unknowns :],
            float(sum(row @ row for row, shown in zip(rows, used, strict=True) if shown)) / samples,
        )

    def _without(self, hypothesis: Hypothesis, unknowns: Array) -> Array | None:
        """Return parameters fitted to rescaled angles, or to the part of the data that the defect hardly affects."""
        estimate, course = self.estimate, hypothesis.course
        factor = np.ones(estimate.model.joints)
        if hypothesis.kind == "scale":
            factor[[joint - 1 for joint in hypothesis.joints]] += unknowns[-len(hypothesis.joints) :]
        part = (*factor.tolist(), course)
        if part not in self._parts:
            try:
                self._parts[part] = estimate_by_shooting(
                    scaled(self._recordings, factor) if course.kind == "always" else _part(self._recordings, course),
                    estimate.model,
                    estimate.value[: len(estimate.model.base_names)],
                    length=estimate.segment_length,
                    zeros=estimate.zeros.size > 0,
                    options=QUICK,
                ).value
            except EstimationError:
                self._parts[part] = None
        return self._parts[part]

    def samples(self, number: int) -> int:
        return int(np.isfinite(self.problem.segments[number].position).sum())


class _Posed:
    """Residuals as a function of shared coordinates: those of the parameters, the zeros, and the defect's unknowns."""

    def __init__(self, altered: Altered, hypothesis: Hypothesis | None) -> None:
        self._altered, self._hypothesis = altered, hypothesis
        estimate = altered.estimate
        self.coordinates = altered.problem.coordinates(estimate.parameters)
        self._direction = np.zeros((len(altered.names), 0)) if hypothesis is None else altered.direction(hypothesis)
        self._scaled = hypothesis.joints if hypothesis is not None and hypothesis.kind == "scale" else ()
        self.unknowns = self._direction.shape[1] + len(self._scaled)

    @property
    def _is_absolute(self) -> bool:
        return self._hypothesis is not None and self._hypothesis.is_absolute

    def _sizes(self, value: Array) -> Array:
        return value if self._hypothesis is None else self._altered.sizes(self._hypothesis, value)

    def begun(self, value: Array, unknowns: Array) -> Array:
        """Return the fit's shared coordinates for these values of the parameters and of the defect's unknowns."""
        return np.concatenate((self.coordinates.coordinates(value), self._altered.offsets, unknowns))

    def minimum(self, shared: Array, own: Array, ftol: float = OPTIONS.ftol_refine) -> Segmented:
        """Fit, starting from these coordinates. Raises ConvergenceError."""
        extra = np.zeros(self.unknowns)
        known = self._altered.problem.expected(self.coordinates, shared[: shared.size - self.unknowns], own)
        prior = Expected(np.concatenate((known.centre, extra)), np.concatenate((known.precision, extra)), known.weight)
        return minimise_segmented(self.residual, self.derivative, shared, own, ftol, OPTIONS.minimiser, prior)

    def residual(self, number: int, shared: Array, own: Array) -> Array:
        problem, segment = self._altered.problem, self._altered.problem.segments[number]
        values, offsets = self._moved(number, shared)
        position = problem.position_by_values(segment, values, offsets, own)
        rows = np.where(np.isfinite(segment.position), position - np.nan_to_num(segment.position), 0.0) / problem.noise
        return self._weight(number) * self._scaled_rows(number, rows, shared)[0].reshape(-1)

    def derivative(self, number: int, shared: Array, own: Array) -> tuple[Array, Array]:
        altered, problem = self._altered, self._altered.problem
        values, offsets = self._moved(number, shared)
        count, value = len(altered.estimate.names), self._constant(shared)
        rows, columns = problem.derivative_by_values(number, values, offsets, own, altered.names)
        shape, names = problem.segments[number].position.shape, len(altered.names)
        with np.errstate(over="ignore", invalid="ignore"):
            growth = 1.0 + (0.0 if self._is_absolute else 1.0) * self._change(number, shared)[:count]
            by_value = columns[:, :count] * growth @ self.coordinates.slopes(shared[:count])
            by_defect = columns[:, :names] * self._sizes(value) @ self._direction * self._strength(number)
        scaled, angle = self._scaled_rows(number, rows.reshape(shape), shared)
        factor = np.broadcast_to(self._factors(shared)[:, None], shape).reshape(-1, 1)
        by_scale = np.zeros((*shape, len(self._scaled)))
        for k, joint in enumerate(self._scaled):
            by_scale[joint - 1, :, k] = angle[joint - 1]
        zeros = columns[:, names : names + problem.zeros]
        state = columns[:, names + problem.zeros :]
        every = (by_value * factor, zeros * factor, by_defect * factor, by_scale.reshape(rows.size, -1), state * factor)
        weight = self._weight(number)
        return weight * scaled.reshape(-1), weight * np.concatenate(every, axis=1)

    def _constant(self, shared: Array) -> Array:
        """Parameters (names,) without the defect."""
        altered, count = self._altered, len(self._altered.estimate.names)
        value = np.array([altered.values[name] for name in altered.names])
        value[:count] = self.coordinates.values(shared[:count])
        return value

    def _change(self, number: int, shared: Array) -> Array:
        """Change in a segment's parameters (names,), as in `Direction`."""
        first = shared.size - self.unknowns
        change: Array = self._strength(number) * self._direction @ shared[first : first + self._direction.shape[1]]
        return change

    def _moved(self, number: int, shared: Array) -> tuple[dict[str, float], Array]:
        """Return a segment's parameters by name, and the offsets of its zeros."""
        altered, value = self._altered, self._constant(shared)
        value = value + self._sizes(value) * self._change(number, shared)
        count = len(altered.estimate.names)
        return dict(zip(altered.names, value.tolist(), strict=True)), shared[count : count + altered.problem.zeros]

    def _factors(self, shared: Array) -> Array:
        """Ratio of measured to true angle for each joint."""
        factor = np.ones(self._altered.estimate.model.joints)
        for joint, change in zip(self._scaled, shared[shared.size - len(self._scaled) :], strict=True):
            factor[joint - 1] += change
        return factor

    def _scaled_rows(self, number: int, rows: Array, shared: Array) -> tuple[Array, Array]:
        """Return the residual for scaled angles, and the simulated angles, in units of the noise (joints, samples)."""
        measured = self._altered.measured(number)
        known = np.isfinite(self._altered.problem.segments[number].position)
        angle = np.where(known, rows + measured, 0.0)
        return self._factors(shared)[:, None] * angle - measured, angle

    def _strength(self, number: int) -> float:
        return 0.0 if self._hypothesis is None else float(self._hypothesis.strength[number])

    def _weight(self, number: int) -> float:
        return 1.0 if self._hypothesis is None or self._hypothesis.used[number] else IGNORED


def _with_every_friction(found: ShootingEstimate) -> ShootingEstimate:
    """Return the estimate with all dry-friction terms, so that no defect is found in place of a missing term.

    Load terms that the estimate lacks are set to 0, other missing terms to their usual initial guess.
    """
    model = replace(found.model, friction=FRICTIONS[-1])
    values = {name: term_of(name).initial for name in model.names} | {
        f"load_{joint}": 0.0 for joint in range(1, model.joints + 1)
    }
    value = np.array([(values | found.parameters)[name] for name in model.names])
    return replace(found, model=model, names=model.names, units=model.units, value=value)


def scaled(recordings: Sequence[Recording], factor: Array) -> list[Recording]:
    """Return the recordings with angles divided by `factor` (joints,)."""
    return [
        replace(each, position=each.position / factor[:, None], position_step=each.position_step / factor)
        for each in recordings
    ]


def _part(recordings: Sequence[Recording], course: Course) -> list[Recording]:
    """Return the longest part of the recordings in which the defect hardly changes."""
    if course.kind == "recording":
        return [each for number, each in enumerate(recordings) if number != course.recording]
    parts = []
    for number, each in enumerate(recordings):
        time = each.time - each.time[0]
        begin, end = 0.5 * time[-1], np.inf
        if course.kind == "step":
            at = course.time - each.time[0]
            before = number != course.recording or 2.0 * at > time[-1]
            begin, end = -np.inf if before else at, at if number == course.recording and before else np.inf
        some = (time >= begin) & (time <= end)
        parts.append(replace(each, time=each.time[some], torque=each.torque[:, some], position=each.position[:, some]))
    return parts
