"""Detection of wrong columns in a chain's recording: reversed signs, torques that contradict each other, and a wrong
time scale.

As for planar arms (`hil.estimator.baselines.signs`), the torque residual of filtered inverse dynamics with a column
changed is compared with the residual for the columns as given. Changing the signs and scale factors of torques only
changes how the joints' normal equations are combined, so that all combinations can be tried quickly.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.baselines.signs import Signs
from hil.estimator.chain.fit.regression import filtered_torques
from hil.estimator.chain.fit.stage1 import PASSES
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.recordings import CUTOFFS, LAG
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError, RecordingError

SUSPICIOUS = 0.1  # relative torque residual of the worst joint, below which only contradictory torques are sought
CLEAR = 0.5  # largest ratio of the worst joint's residual with a change to that without it
WELL = 0.3  # largest relative residual with a change
GAIN = 0.03  # minimum decrease in the log residual, averaged over the joints, for credible torque factors
AS_WELL = 1.05  # ratio of the residuals up to which fewer reversals are preferred
EQUALLY_FAR = 4.0  # smallest difference in squared distance to the description that decides between two reversals
SIGNIFICANT = 3.0  # standard errors
FACTORS = np.exp(np.linspace(-np.log(6.0), np.log(6.0), 41))  # torque factors to try
STEPS = 1.0 + 0.08 * np.linspace(-1.0, 1.0, 17)  # factors by which to refine the best one
RIDGE = 1e-12  # added to normal equations with unit diagonal to keep them nonsingular if a joint hardly moves
SWEEPS = 3  # number of sweeps over the joints
DELAYS = 0.005 * np.arange(-12, 13)  # s: torque delays to try
LEAST_LATE = 0.01  # s
LATE = 0.6  # largest ratio of a joint's residual with a delay to that without it
ONE_LATE = 0.3  # decrease in the log residuals, beyond that of a common delay, that makes a delay of one joint credible
TIMES = np.array([0.1, 0.2, 0.25, 1.0 / 3.0, 0.5, 0.7, 1.4, 2.0, 3.0, 4.0, 5.0, 10.0])  # time scales to try


@dataclass(frozen=True)
class Reversed:
    """Reversed columns.

    residuals: relative RMS of the worst joint's torque residual with the change and without it.
    impossible: whether friction is negative with the columns as given. This happens if all torques are reversed, or if
    the first joint's axis is vertical and its torque or position is reversed.
    """

    residuals: tuple[float, float]
    signs: Signs
    impossible: bool
    instead: Signs | None = None
    """Another reversal, of the same number of columns, that explains the recordings equally well."""


@dataclass(frozen=True)
class WrongTimes:
    """Recorded times that are `factor` times the true times. residuals: as for reversed columns."""

    residuals: tuple[float, float]
    factor: float


@dataclass(frozen=True)
class Swapped:
    """Exchanged columns of two joints, which are counted from 0. residuals: as for reversed columns."""

    residuals: tuple[float, float]
    joints: tuple[int, int]
    columns: str
    """"torques", "positions", or "torques and positions"."""


@dataclass(frozen=True)
class Late:
    """Torque that was logged `seconds` after it acted (before, if negative). residuals: those of the joint's torque."""

    residuals: tuple[float, float]
    joint: int | None
    """The joint, counted from 0; None if all torques are late (the residuals are then the worst joint's)."""
    seconds: float


@dataclass(frozen=True)
class Solved:
    value: Array
    std: Array
    relative: Array
    """RMS torque residual of each joint, relative to the RMS of its torque (joints,)."""

    @property
    def worst(self) -> float:
        return float(self.relative.max())

    def distance(self, prior: Prior) -> float:
        """Squared distance between the base parameters and those of the description, in units of the prior's standard
        deviations.
        """
        return float(np.sum(np.square((self.value[: prior.value.size] - prior.value) / prior.std)))

    @property
    def misfit(self) -> float:
        """Negative log likelihood, up to a constant, with each joint's torque scaled by its RMS."""
        return float(np.log(self.relative).sum())


@dataclass(frozen=True)
class ColumnCheck:
    """A chain's recordings, whose columns may be wrong. cutoff [Hz], delay [s]: see `filtered_torques`."""

    recordings: Sequence[Recording]
    model: ChainModel
    prior: Prior
    cutoff: float
    delay: float

    @classmethod
    def of(cls, recordings: Sequence[Recording], model: ChainModel, prior: Prior) -> "ColumnCheck | None":
        """Return a check of the recordings, filtered as in the regression; None if they are too short to filter."""
        for cutoff in CUTOFFS:
            with suppress(RecordingError):
                check = cls(recordings, model, prior, cutoff, LAG)
                assert check._given
                return check
        return None

    @cached_property
    def _given(self) -> tuple["Normal", Solved]:
        normal = Normal.of(*self._rows)
        return normal, self.solved(normal)

    @cached_property
    def _rows(self) -> tuple[Array, Array]:
        return self._filtered(self.recordings, 0.0)

    def _filtered(self, recordings: Sequence[Recording], late: float) -> tuple[Array, Array]:
        return filtered_torques(recordings, self.model, self.cutoff, self.delay - late)

    def _normal(self, recordings: Sequence[Recording]) -> "Normal":
        return Normal.of(*self._filtered(recordings, 0.0))

    def solved(self, normal: "Normal") -> Solved:
        return normal.solved(np.ones(self.model.joints), self.prior)

    @property
    def suspicious(self) -> bool:
        """Whether inverse dynamics leaves so much torque unexplained that a search for mistakes is worthwhile."""
        return self._given[1].worst > SUSPICIOUS or self.dissipates_too_little(self._given[1])

    def reversed_columns(self) -> Reversed | None:
        """The reversal that explains the recordings much better than the signs as given."""
        given, impossible = self._given[1], self.dissipates_too_little(self._given[1])
        joints = self.model.joints
        tried: list[tuple[int, float, float, Signs]] = []
        for position in _turned(joints):
            turned = [replace(each, position=each.position * np.array(position)[:, None]) for each in self.recordings]
            normal = self._given[0] if min(position) > 0 else self._normal(turned)
            for torque in product((1, -1), repeat=joints):
                signs = Signs(torque, position)
                found = normal.solved(np.array(torque, dtype=float), self.prior)
                if signs.reversed_columns and not self.dissipates_too_little(found):
                    tried.append((len(signs.reversed_columns), found.distance(self.prior), found.worst, signs))
        least = min((worst for _, _, worst, _ in tried), default=np.inf)
        tried = sorted((each for each in tried if each[2] <= AS_WELL * least), key=lambda each: each[:2])
        likelier = impossible and least < AS_WELL * given.worst and tried[0][1] < given.distance(self.prior)
        if not ((least < CLEAR * given.worst or likelier) and least < WELL):
            return None
        count, far, worst, signs = tried[0]
        other = [each[3] for each in tried[1:2] if each[0] == count and each[1] < far + EQUALLY_FAR]
        return Reversed((worst, given.worst), signs, impossible, *other)

    def swapped_columns(self) -> Swapped | None:
        """The exchange of two joints' columns that explains the recordings much better than the columns as given."""
        torque, given, tried = self._rows[1], self._given[1].worst, []
        for pair in combinations(range(self.model.joints), 2):
            order = [*range(self.model.joints)]
            order[pair[0]], order[pair[1]] = pair[1], pair[0]
            columns = self._filtered([replace(each, position=each.position[order]) for each in self.recordings], 0.0)[0]
            for Y, tau, said in (
                (self._rows[0], torque[order], "torques"),
                (columns, torque, "positions"),
                (columns, torque[order], "torques and positions"),
            ):
                found = self.solved(Normal.of(Y, tau))
                if not self.dissipates_too_little(found):
                    tried.append((found.worst, pair, said))
        worst, pair, said = min(tried, default=(np.inf, (0, 0), ""))
        return Swapped((worst, given), pair, said) if worst < min(CLEAR * given, WELL) else None

    def late_torque(self) -> Late | None:
        """The delay of one joint's torque, or of all torques, that explains the recordings better than no delay."""
        (Y, torque), (normal, given) = self._rows, self._given
        every = {late: self._filtered(self.recordings, late)[1] for late in DELAYS.tolist()}

        def delayed(joints: Mask) -> tuple[Solved, float]:
            tried = {
                late: self.solved(normal.driven_by(Y, np.where(joints[:, None], tau, torque)))
                for late, tau in every.items()
            }
            late = min(tried, key=lambda each: tried[each].misfit)
            return tried[late], late

        numbers = np.arange(len(torque))
        common, all_late = delayed(numbers >= 0)
        alone = [delayed(numbers == joint) for joint in numbers]
        joint = min(numbers.tolist(), key=lambda each: alone[each][0].misfit)
        found, late = alone[joint]
        if common.misfit - ONE_LATE < found.misfit:
            worst, late, chosen = int(np.argmax(common.relative / given.relative)), all_late, None
            residuals = (float(common.relative[worst]), float(given.relative[worst]))
        else:
            residuals, chosen = (float(found.relative[joint]), float(given.relative[joint])), joint
        # It is not always known whether a torque belongs to a sample or to the interval after it.
        is_late = abs(late) > 0.99 * max(LEAST_LATE, *(each.interval for each in self.recordings))
        return Late(residuals, chosen, late) if is_late and residuals[0] < LATE * residuals[1] else None

    def contradictory_torques(self) -> tuple[float, ...] | None:
        """Return torque factors relative to joint 1's (joints,) if they explain the recordings better than equal
        factors.

        The links' prior is weak and friction absorbs much of an error, so even a small improvement is evidence.
        """
        normal, given = self._given
        factors, best = np.ones(self.model.joints), given
        for grid in (FACTORS, *(STEPS,) * SWEEPS):
            for joint in range(1, factors.size):
                for factor in grid:
                    tried = factors * np.where(np.arange(factors.size) == joint, factor, 1.0)
                    found = normal.solved(tried, self.prior)
                    if found.misfit < best.misfit:
                        chosen, best = tried, found
                factors = chosen if best is not given else factors
        if given.misfit - best.misfit < GAIN * factors.size:
            return None
        return tuple(factors.tolist())

    def wrong_times(self) -> WrongTimes | None:
        """The time scale that explains the recordings much better than a scale of 1, given gravity and geometry."""
        given = self._given[1]
        if not np.any(self.model.base.chain.gravity):
            return None
        coarse = min((self._slower(factor), factor) for factor in TIMES.tolist())
        if not coarse[0] < given.worst:
            return None
        worst, factor = min(
            coarse, *((self._slower(coarse[1] * step), coarse[1] * step) for step in STEPS[::4].tolist())
        )
        return WrongTimes((worst, given.worst), factor) if worst < min(CLEAR * given.worst, WELL) else None

    def _slower(self, factor: float) -> float:
        """The worst joint's residual with the recorded times divided by `factor`."""
        try:
            changed = [replace(each, time=each.time / factor) for each in self.recordings]
            return replace(self, recordings=changed, cutoff=self.cutoff * factor)._given[1].worst
        except EstimationError:
            return np.inf

    def dissipates_too_little(self, found: Solved) -> bool:
        """Whether more friction terms are significantly negative than significantly positive, or all terms of one joint
        are significantly negative.
        """
        start, joints = self.model.base.count, self.model.joints
        over = (found.value / found.std)[start : start + 2 * joints].reshape(2, joints)
        negative = over < -SIGNIFICANT
        return bool(np.any(np.all(negative, axis=0))) or int(np.sum(negative)) > int(np.sum(over > SIGNIFICANT))


@dataclass(frozen=True)
class Normal:
    """Normal equations of each joint's torques.

    squares: products of the columns (joints, names, names). products: products of columns and torque (joints, names).
    torque: mean square of the torque (joints,).
    """

    squares: Array
    products: Array
    torque: Array
    rows: int

    @classmethod
    def of(cls, columns: Array, torque: Array) -> "Normal":
        """Form the equations of a regressor (joints, rows, names) and torques (joints, rows)."""
        rows = torque.shape[1]
        squares = np.stack([Y.T @ Y for Y in columns]) / rows
        return cls(squares, *_driven(columns, torque), rows)

    def driven_by(self, columns: Array, torque: Array) -> "Normal":
        """Return the equations for other torques; `columns` is the same regressor as in `of`."""
        return Normal(self.squares, *_driven(columns, torque), self.rows)

    def solved(self, factors: Array, prior: Prior) -> Solved:
        """Solve with each joint's torque multiplied by its factor (joints,)."""
        level = self.torque * factors**2
        left, products = level, self.products * factors[:, None]
        count = prior.value.size
        for _ in range(PASSES):
            weight = self.rows / left
            square, product_ = np.tensordot(weight, self.squares, 1), weight @ products
            square[range(count), range(count)] += prior.std**-2
            product_[:count] += prior.value / prior.std**2
            norm = np.sqrt(np.maximum(np.diag(square), 1e-300))
            # An inverse is 30 times faster than a pseudo-inverse, and a thousand combinations are tried.
            inverse = linalg.inv(square / np.outer(norm, norm) + RIDGE * np.eye(norm.size))
            value = inverse @ (product_ / norm) / norm
            explained = 2.0 * products @ value - np.einsum("i,jik,k->j", value, self.squares, value)
            left = np.maximum(level - explained, 1e-8 * level)
        return Solved(value, np.sqrt(np.maximum(np.diag(inverse), 1e-300)) / norm, np.sqrt(left / level))


def _driven(columns: Array, torque: Array) -> tuple[Array, Array]:
    products = np.stack([Y.T @ tau for Y, tau in zip(columns, torque, strict=True)]) / torque.shape[1]
    return products, np.maximum(np.mean(torque**2, axis=1), 1e-18)


def _turned(joints: int) -> Iterator[tuple[int, ...]]:
    """Yield the angle signs to try: unchanged, reversed for one joint, reversed for all joints."""
    yield (1,) * joints
    for joint in range(joints):
        yield tuple(-1 if each == joint else 1 for each in range(joints))
    if joints > 1:
        yield (-1,) * joints
