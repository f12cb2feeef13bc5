"""Paths whose amplitudes, phases and centre make the least certain base parameter as certain as possible.

The search varies the coefficients of the finite Fourier series of `hil.estimator.chain.excitation.fourier_path`. It is
an evolution strategy with a single step size, whose mean moves towards the best of many random variations (N. Hansen
and A. Ostermeier, Evolutionary Computation 9 (2001) 159). Every variation is scaled to the limits of position and speed
and then shrunk until `allowed` accepts it.

Friction, too, is treated as unknown. If it were known, slow, creeping motion would seem to identify a light joint,
whose torque is mostly friction.

This designer is for the pilot experiment, where only limits are known: it also chooses the centre and width of the
motion. For a given box, use `fourier_path.design_path`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.excitation.fourier_path import Path, random_lines
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.prior import Prior
from hil.estimator.errors import ExcitationError
from hil.estimator.progress import Tell, counted

LOOKED_AT = 120  # number of samples at which a variation is evaluated
NOISE = 0.02  # assumed residual of a regression, relative to a joint's RMS torque, friction included
SLOW = 0.1  # rad/s: width of the smoothed Coulomb step
CENTRES = 48
WIDEST_OF = 12
OFFSPRING, PARENTS = 20, 6
GENERATIONS = 60
FIRST_STEP, FASTER, SLOWER = 0.3, 1.1, 0.9
SHRINKS = (1.0, 0.85, 0.7, 0.55, 0.4, 0.25)
SWING_SHARE = 0.9  # swing of a path, as a fraction of the distance from its centre to the nearer limit
LEAST_SWING_SHARE = 0.15
_MEAN_SHARE = 0.1  # weight of the mean log error in the criterion; the largest log error has the remaining weight


@dataclass(frozen=True)
class PathLimits:
    """Limits of the angles, `low` and `high` [rad], and of the `speed` [rad/s] (joints,).

    `allowed` returns whether a path respects the limits of torque and clearance.
    """

    low: Array
    high: Array
    speed: Array
    allowed: Callable[[Path], bool]


@dataclass(frozen=True)
class Design:
    """A path within the limits, and how well it determines the base parameters.

    centre: centre of the path (joints,) [rad]. lines: complex Fourier coefficients (joints, harmonics), before scaling
    to the limits.
    worst, median: largest and median standard error of the base parameters estimated from the path, each relative to
    its prior's standard deviation.
    """

    centre: Array
    lines: Array
    path: Path
    worst: float
    median: float


class PathDesigner:
    """Designs paths that last one `period` [s], sampled at `rate`, with harmonics up to `highest` [Hz]. Raises
    ExcitationError.

    friction: typical Coulomb friction (joints,) [N m].
    """

    def __init__(
        self,
        base: BaseParameters,
        prior: Prior,
        friction: Array,
        rate: float,
        period: float,
        highest: float,
        limits: PathLimits,
    ) -> None:
        self._count = int(np.floor(highest * period + 1e-9))
        if self._count < 2 or highest > rate / 8:
            raise ExcitationError(
                f"a path of {period:g} s with harmonics up to {highest:g} Hz at {rate:g} samples/s: it needs at least "
                "two harmonics below an eighth of the rate"
            )
        if (limits.low >= limits.high).any():
            raise ExcitationError("no position range is left for a path")
        self._base, self._prior, self._limits, self._friction = base, prior, limits, friction
        self._samples, self._period = round(rate * period), period
        few = min(LOOKED_AT, self._samples)
        self._few = self._waves(few)
        self._all: tuple[Array, Array, Array] | None = None
        self._joints = len(limits.low)

    def plain(self, centre: Array, seed: int) -> Design:
        """Return a random path about a centre, scaled to the limits; raises ExcitationError if it is not allowed."""
        random = np.random.default_rng(seed)
        found = self._finished(centre, self._random_lines(random))
        if found is None:
            raise ExcitationError("no path about this centre stays within the torque and clearance limits")
        return found

    def design(self, seed: int, tell: Tell | None = None) -> Design:
        """Return the best path found; raises ExcitationError if none is allowed.

        tell: called with the number of steps done and the total.
        """
        random = np.random.default_rng(seed)
        told = counted(tell, CENTRES + GENERATIONS)
        centre, lines = self._start(random, told)
        mean = np.concatenate((self._shares_of(centre), lines.real.reshape(-1), lines.imag.reshape(-1)))
        score = self._score(mean)
        best, step = mean, FIRST_STEP
        scale = np.concatenate((np.full(self._joints, 0.15), np.full(mean.size - self._joints, 1.0)))
        for _ in range(GENERATIONS):
            normal = random.standard_normal((OFFSPRING, mean.size))
            offspring = mean + step * scale * normal
            scores = np.array([self._score(each) for each in offspring])
            order = np.argsort(scores)
            better = scores[order[0]] < score
            if better:
                best, score = offspring[order[0]], scores[order[0]]
            step *= FASTER if (scores[order[:PARENTS]] < score * 1.02).mean() > 0.2 or better else SLOWER
            chosen = order[: PARENTS - 1]
            finite = chosen[np.isfinite(scores[chosen])]
            mean = np.mean([best, *offspring[finite]], axis=0)
            told()
        centre, lines = self._split(best)
        found = self._finished(centre, lines)
        if found is None:
            raise ExcitationError("no path stays within the torque and clearance limits")
        return found

    def scaled(self, design: Design, share: float) -> Path:
        """Return the design's path with its amplitude scaled by `share`."""
        centre = design.path.position.mean(axis=1, keepdims=True)
        path = design.path
        return Path(centre + share * (path.position - centre), share * path.velocity, share * path.acceleration)

    def worth(self, path: Path) -> tuple[float, float]:
        """Return the largest and the median standard error of the base parameters estimated from a path.

        Each is relative to the prior's standard deviation.
        """
        errors = self._errors(path, max(1, path.position.shape[1] // LOOKED_AT))
        return float(errors.max()), float(np.median(errors))

    def _start(self, random: np.random.Generator, told: Callable[[], None]) -> tuple[Array, Array]:
        """Return the centre and coefficients of the best random path.

        The centres tried are the middle of the limits and random points.
        """
        low, high = self._limits.low, self._limits.high
        best: tuple[float, Array, Array] | None = None
        for number in range(CENTRES):
            told()
            share: Array = np.full(self._joints, 0.5) if number < 4 else random.uniform(0.15, 0.85, self._joints)
            centre, lines = low + share * (high - low), self._random_lines(random)
            path = self._fitted(centre, lines, self._few)
            if path is None:
                continue
            value = self._value(path)
            if best is None or value < best[0]:
                best = value, centre, lines
        if best is None:
            raise ExcitationError(
                f"no path about any of the {CENTRES} centres tried stays within the torque and clearance limits"
            )
        return best[1], best[2]

    def widest(self, centre: Array, seed: int) -> Design:
        """Return, out of several random paths about a centre, the one whose least-moving joint moves farthest.

        Such a path is used for validation, which cannot resolve prediction errors below encoder rounding and therefore
        needs a wide motion. Raises ExcitationError if no path is allowed.
        """
        random = np.random.default_rng(seed)
        found = [self._finished(centre, self._random_lines(random)) for _ in range(WIDEST_OF)]
        allowed = [design for design in found if design is not None]
        if not allowed:
            raise ExcitationError("no path about this centre stays within the torque and clearance limits")
        return max(allowed, key=lambda design: float(design.path.position.std(axis=1).min()))

    def _random_lines(self, random: np.random.Generator) -> Array:
        return np.asarray(random_lines(random, self._joints, self._count))

    def _score(self, vector: Array) -> float:
        path = self._fitted(*self._split(vector), self._few)
        return np.inf if path is None else self._value(path)

    def _value(self, path: Path) -> float:
        errors = np.log(self._errors(path, 1))
        return float((1.0 - _MEAN_SHARE) * errors.max() + _MEAN_SHARE * errors.mean())

    def _errors(self, path: Path, every: int) -> Array:
        """Return the base parameters' standard errors after one period, relative to those of the prior (base
        parameters,).
        """
        some = slice(0, None, every)
        Y = self._base.regressor(path.position[:, some], path.velocity[:, some], path.acceleration[:, some])
        level = np.sqrt(np.mean((Y @ self._prior.value) ** 2, axis=1) + self._friction**2) + 1e-6
        weight = np.sqrt(self._samples / Y.shape[1]) / (NOISE * level)
        rows = Y * self._prior.std * weight[:, None, None]
        velocity = path.velocity[:, some]
        friction = np.stack((velocity, np.tanh(velocity / SLOW), np.ones_like(velocity)), axis=2)
        friction *= (self._friction * weight)[:, None, None]
        information = np.eye(self._base.count)
        for row, unknown in zip(rows, friction, strict=True):
            both = unknown.T @ row
            information += row.T @ row - both.T @ linalg.solve(np.eye(3) + unknown.T @ unknown, both)
        errors: Array = np.sqrt(np.diag(linalg.inv(information)))
        return errors

    def _finished(self, centre: Array, lines: Array) -> Design | None:
        if self._all is None:
            self._all = self._waves(self._samples)
        path = self._fitted(centre, lines, self._all)
        if path is None:
            return None
        worst, median = self.worth(path)
        return Design(centre, lines, path, worst, median)

    def _fitted(self, centre: Array, lines: Array, waves: tuple[Array, Array, Array]) -> Path | None:
        """Return the path scaled to the limits of position and speed, then shrunk until `allowed` accepts it; None if
        it is never accepted.
        """
        room = np.minimum(centre - self._limits.low, self._limits.high - centre)
        span = self._limits.high - self._limits.low
        swing = np.maximum(SWING_SHARE * room, 0.0)
        if (swing < LEAST_SWING_SHARE * 0.5 * span).any():
            centre = np.clip(
                centre,
                self._limits.low + LEAST_SWING_SHARE * span,
                self._limits.high - LEAST_SWING_SHARE * span,
            )
            swing = SWING_SHARE * np.minimum(centre - self._limits.low, self._limits.high - centre)
        position, velocity, acceleration = (np.asarray((lines @ wave).real) for wave in waves)
        scale = np.minimum(
            swing / np.maximum(np.abs(position).max(axis=1), 1e-9),
            self._limits.speed / np.maximum(np.abs(velocity).max(axis=1), 1e-9),
        )[:, None]
        for shrink in SHRINKS:
            s = shrink * scale
            path = Path(centre[:, None] + s * position, s * velocity, s * acceleration)
            if self._limits.allowed(path):
                return path
        return None

    def _waves(self, samples: int) -> tuple[Array, Array, Array]:
        """Return exp(i k w t) and its first two time derivatives (harmonics, samples)."""
        turn = 2j * np.pi * np.arange(1, self._count + 1)[:, None] / self._period
        wave = np.exp(turn * np.arange(samples) * self._period / samples)
        return wave, turn * wave, turn**2 * wave

    def _shares_of(self, centre: Array) -> Array:
        low, high = self._limits.low, self._limits.high
        return np.asarray((centre - low) / (high - low))

    def _split(self, vector: Array) -> tuple[Array, Array]:
        n, low, high = self._joints, self._limits.low, self._limits.high
        centre = low + np.clip(vector[:n], 0.05, 0.95) * (high - low)
        real, imaginary = vector[n:].reshape(2, n, self._count)
        return centre, real + 1j * imaginary
