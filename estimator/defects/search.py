"""Search for the most probable defect of recordings: score tests of many defects, then fits of the best few.

If friction, load or torque changed, or angles have a wrong scale, additional unknowns explain part of the residual. One
simulation with all derivatives gives the decrease in the sum of squares for each of them (a score test, as in
`hil.estimator.selection.candidates`; for changes in time, following Nyblom, J. American Statistical Association 84
(1989) 223).
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.defects.altered import Altered, AlteredFit
from hil.estimator.defects.hypotheses import Course, Hypothesis, Kind, hypotheses
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.selection.candidates import colour

FEWEST_SEGMENTS = 6
MOST_SEGMENTS = 400  # more would take too long
EXPLAINED = 1.2  # mean square of the residual, relative to the noise, above which neighbouring instants are tried
FITTED = 3  # number of hypotheses to fit, which differ in kind or joint
PROMISING = 0.45  # a hypothesis that explains less than this fraction of the residual beyond the noise is dropped
LEAST_GAIN = 1.2  # minimum factor by which a defect reduces a mean square that is below EXPLAINED
CERTAIN = 2.0  # minimum decrease in the sum of squares, relative to that expected by chance
LEAST = {"scale": 0.01, "load": 0.02, "friction": 0.04, "torque": 0.01, "offset": 0.01, "arm": 0.03}
"""Smallest change that matters, as a fraction of the parameters; for an offset, as a fraction of the RMS torque."""


@dataclass(frozen=True)
class Defect:
    """A defect that explains the recordings. fit: fit with the unknowns of the defect; given: fit without them."""

    hypothesis: Hypothesis
    fit: AlteredFit
    given: AlteredFit

    @property
    def explained(self) -> float:
        """Fraction of the residual power beyond the noise that the defect explains."""
        return (self.given.left - self.fit.left) / max(self.given.left - 1.0, 1e-6)


@dataclass(frozen=True)
class _Score:
    """A hypothesis with the expected sum of squares per sample, the explained fraction of the residual beyond the
    noise, and the evidence for it (significant above 1).
    """

    hypothesis: Hypothesis
    left: float
    explained: float
    evidence: float
    gain: float
    """Ratio of the sum of squares without the hypothesis to that with it."""

    @property
    def is_promising(self) -> bool:
        """Whether the hypothesis deserves a fit.

        A residual near the noise is nearly linear in the unknowns, so that a fit would gain little more than this test.
        """
        is_small = self.left * self.gain < EXPLAINED
        return self.evidence > CERTAIN and self.explained > PROMISING and not (is_small and self.gain < LEAST_GAIN)


def probable_defect(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool) -> Defect | None:
    """Return the most probable defect if it is significant and large enough to matter, otherwise None.

    estimate: fit of a model without terms that could imitate a defect. gravity: whether gravity acts on the arm.
    """
    altered = Altered(recordings, estimate)
    if not FEWEST_SEGMENTS <= altered.segments <= MOST_SEGMENTS:
        return None
    try:
        return _searched(altered, hypotheses(recordings, altered.problem.segments, altered.values, gravity))
    except ConvergenceError:
        return None


def _searched(altered: Altered, every: Sequence[Hypothesis]) -> Defect | None:
    linear = _Linear.of(altered)
    scores = sorted((linear.score(altered, each, len(every)) for each in every), key=lambda each: each.left)
    likely = _different([each for each in scores if each.is_promising])
    if not likely:
        return None
    given = altered.fit(None)
    found = _best(altered.fit, likely, given, linear.independent)
    if found is None or found.hypothesis.course.kind != "step" or found.explained < PROMISING:
        return found
    if found.fit.left > EXPLAINED:
        near = [found.hypothesis, *_neighbours(found.hypothesis, every)]
        found = _best(partial(altered.fit_from, near=found.fit), near, given, linear.independent) or found
    # Hypotheses that place the change in different segments were compared on different data.
    then = [each for other in likely for each in every if _is_same(other, each, found.hypothesis.course)]
    return _best(partial(altered.fit, near=found.fit), then, given, linear.independent) or found


def _is_same(hypothesis: Hypothesis, other: Hypothesis, course: Course) -> bool:
    return (
        hypothesis.course.kind == "step"
        and other.course == course
        and (other.kind, other.joints) == (hypothesis.kind, hypothesis.joints)
    )


def _different(scores: Sequence[_Score]) -> list[Hypothesis]:
    best: dict[tuple[Kind, tuple[int, ...]], Hypothesis] = {}
    for each in scores:
        best.setdefault((each.hypothesis.kind, each.hypothesis.joints), each.hypothesis)
    return list(best.values())[:FITTED]


def _neighbours(hypothesis: Hypothesis, every: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that place the same sudden change one step earlier and one step later."""
    alike = [
        each
        for each in every
        if (each.kind, each.joints, each.course.kind, each.course.recording)
        == (hypothesis.kind, hypothesis.joints, "step", hypothesis.course.recording)
    ]
    at = [each.course.time for each in alike].index(hypothesis.course.time)
    return [*alike[max(0, at - 1) : at], *alike[at + 1 : at + 2]]


def _best(
    fit_of: Callable[[Hypothesis], AlteredFit], likely: Sequence[Hypothesis], given: AlteredFit, independent: float
) -> Defect | None:
    """Fit the `likely` hypotheses and return the most probable one. independent: number of independent samples."""
    found: list[Defect] = []
    for hypothesis in likely:
        with suppress(ConvergenceError):
            fit = fit_of(hypothesis)
            if float(np.abs(fit.unknowns[-hypothesis.unknowns :]).max()) >= LEAST[hypothesis.kind]:
                found.append(Defect(hypothesis, fit, given))

    def criterion(each: Defect) -> float:
        unknowns = each.hypothesis.unknowns + (1 if each.hypothesis.course.kind == "step" else 0)
        return independent * float(np.log(each.fit.left)) + unknowns * float(np.log(independent))

    return min(found, key=criterion, default=None)


@dataclass(frozen=True)
class _Linear:
    """Normal equations of each segment near the estimate, in all linear unknowns.

    normal: (segments, unknowns, unknowns); gradient: (segments, unknowns); squares, samples: sum of squares, and number
    of measured angles (segments,). fitted: unknowns that are fitted even without a defect. colour: see `candidates`.
    """

    normal: Array
    gradient: Array
    squares: Array
    samples: Array
    fitted: tuple[int, ...]
    colour: float

    @classmethod
    def of(cls, altered: Altered) -> "_Linear":
        linear = [altered.linear(k) for k in range(altered.segments)]
        shapes = [each.position.shape for each in altered.problem.segments]
        size, joints = linear[0][1].shape[1], altered.estimate.model.joints
        return cls(
            np.stack([J.T @ J for _, J in linear]),
            np.stack([J.T @ r for r, J in linear]),
            np.array([r @ r for r, _ in linear]),
            np.array([altered.samples(k) for k in range(altered.segments)]),
            (*range(len(altered.estimate.names)), *range(len(altered.names), size - joints)),
            float(np.median([colour(r.reshape(shape)) for (r, _), shape in zip(linear, shapes, strict=True)])),
        )

    @property
    def independent(self) -> float:
        """Number of samples, reduced to allow for the residual's correlation."""
        return float(self.samples.sum()) / self.colour

    def score(self, altered: Altered, hypothesis: Hypothesis, tried: int) -> _Score:
        """Return the result of the score test of a hypothesis; tried: number of hypotheses tested."""
        base = np.eye(self.gradient.shape[1])[:, self.fitted]
        added = _added(hypothesis, altered, len(base))
        before = self._fall(base, None, hypothesis)
        fall = self._fall(base, added, hypothesis) - before
        samples = float(self.samples[hypothesis.used].sum())
        left = float(self.squares[hypothesis.used].sum()) - before
        chance = self.colour * (hypothesis.unknowns * np.log(samples) + 2.0 * np.log(tried)) * left / samples
        explained = fall / max(left - samples, 1e-6 * samples)
        rest = max(left - fall, 1e-6 * left)
        return _Score(hypothesis, rest / samples, explained, fall / max(float(chance), 1e-300), left / rest)

    def _fall(self, base: Array, added: Array | None, hypothesis: Hypothesis) -> float:
        """Return the decrease in the sum of squares if the unknowns `base` and `added` are freed."""
        used = np.where(hypothesis.used, 1.0, 0.0)
        parts = [(base, used)] if added is None else [(base, used), (added, used * hypothesis.strength)]
        blocks = [[a.T @ np.einsum("s,sij->ij", p * q, self.normal) @ b for b, q in parts] for a, p in parts]
        matrix = np.block(blocks)
        slope = np.concatenate([a.T @ (p @ self.gradient) for a, p in parts])
        scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
        inverse = linalg.pinv(matrix / np.outer(scale, scale), rcond=1e-10, hermitian=True)
        return float((slope / scale) @ inverse @ (slope / scale))


def _added(hypothesis: Hypothesis, altered: Altered, size: int) -> Array:
    """Return the derivative of all linear unknowns with respect to those of the hypothesis (size, unknowns)."""
    value = np.array([altered.values[name] for name in altered.names])
    direction = altered.direction(hypothesis) * altered.sizes(hypothesis, value)[:, None]
    added = np.concatenate((direction, np.zeros((size - len(direction), direction.shape[1]))))
    if hypothesis.kind != "scale":
        return added
    scales = [size - altered.estimate.model.joints + joint - 1 for joint in hypothesis.joints]
    return np.concatenate((added, np.eye(size)[:, scales]), axis=1)
