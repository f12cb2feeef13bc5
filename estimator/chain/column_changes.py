"""Search for the one mistake in a spatial arm's columns that explains why its motion and its description disagree.

Each simple mistake is undone in turn: two exchanged columns, one joint's direction, encoder zero or gear ratio, or the
unit of the angles. Filtered inverse dynamics shows how well torques and description agree afterwards. Only samples in
which a joint moves are compared, since dry friction can balance any torque of a joint that stands still. A change is
named only if it explains the recordings far better than no change and than every other change, including another
mount and a wrong torque constant.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, permutations
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.baselines.signs import ANGLE_UNITS
from hil.estimator.chain.column_faults import FACTORS, TIMES, ColumnCheck, Normal, Solved
from hil.estimator.chain.description_faults import ZEROS
from hil.estimator.chain.fit.regression import filtered_torques
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.geometry import directions_of_gravity
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.mount import CLOSER, LESS
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError

SLIDES = 0.95  # smoothed sign of velocity above which a joint moves
SAMPLES, FLOOR = 20.0, 0.03
"""Number of independent torque samples of each joint that the cost assumes, and the relative torque residual below
which smaller residuals are no longer evidence.
"""
BETTER = 5.0  # difference in the cost that decides between a change and none, and between two changes
WELL, NEAR = 0.12, 0.1
"""Largest relative torque residual with a change, and largest squared distance per base parameter between the result
and the description, in units of the description's uncertainty.
"""
RATIOS = (0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 0.8, 1.25, 1.5, 2.0, 3.0, 4.0)  # of an angle to the true one
FINE = (1.12, 1.06, 1.03, 1.015)  # factors by which to refine the best ratio, in turn
ROUND = 0.02  # relative difference up to which a ratio of small whole numbers is preferred

Columns = Literal["position", "torque", "both"]


@dataclass(frozen=True)
class ColumnChange:
    """A change to the columns of a recording."""

    kind: Literal["exchange", "direction", "zero", "unit", "ratio"]
    joints: tuple[int, ...] = ()
    """The joints, counted from 0; for "unit", none."""
    columns: Columns = "position"
    turned: float = 0.0
    """For "zero", the angle to add [rad]."""
    factor: float = 1.0
    """For "ratio" and "unit", the factor by which to multiply the columns."""
    units: tuple[str, str] = ("", "")
    """For "unit", the unit that was assumed and the one to assume."""

    def on_position(self, position: Array, zero: Array) -> Array:
        """Change angles (joints, samples) [rad] that include `zero` (joints,) [rad]."""
        if self.columns == "torque":
            return position
        order, factor, turned = self._terms(len(position))
        raw = position - zero[:, None]
        return np.asarray(factor[:, None] * raw[order] + (zero + turned)[:, None])

    def on_torque(self, torque: Array, gains: Array) -> Array:
        """Change torques (joints, ...) [N m]. gains: torque per unit of each joint's column (joints,)."""
        if self.columns == "position":
            return torque
        order, factor, _ = self._terms(len(torque))
        return np.asarray((factor * gains / gains[order])[:, None] * torque[order])

    def _terms(self, joints: int) -> tuple[list[int], Array, Array]:
        """Return the order of the columns, their factors and the angles to add."""
        order, factor, turned = [*range(joints)], np.ones(joints), np.zeros(joints)
        if self.kind == "exchange":
            one, other = self.joints
            order[one], order[other] = other, one
        elif self.kind == "unit":
            factor[:] = self.factor
        else:
            factor[[*self.joints]] = -1.0 if self.kind == "direction" else self.factor
            turned[[*self.joints]] = self.turned
        return order, factor, turned


@dataclass(frozen=True)
class Suspected:
    """The one change with which recordings and description agree.

    residuals: relative RMS of the worst joint's torque residual with the change and without it.
    """

    change: ColumnChange
    residuals: tuple[float, float]


@dataclass(frozen=True)
class _Tried:
    """An explanation. distance: squared distance between the result and the description, as for `NEAR`."""

    cost: float
    distance: float
    solved: Solved
    change: ColumnChange | None
    """None for no change, or for one that is not a change to columns of angles or to the order of columns."""


@dataclass(frozen=True)
class ColumnSearch:
    """Recordings whose columns may be wrong.

    links: described link parameters (joints, 10) [SI]. zero: `columns.zero`, which the angles include (joints,) [rad].
    gains: torque per unit of each torque column (joints,). unit: unit of the angles, if it is one of `ANGLE_UNITS`.
    """

    check: ColumnCheck
    links: Array
    zero: Array
    gains: Array
    unit: str = ""

    def suspected(self) -> Suspected | None:
        """Return the change that alone makes torques, motion and description agree; None if there is none."""
        given = self._given
        if given.distance < LESS:
            return None
        tried = [*self._changed(), *self._otherwise()]
        tried = [each for each in tried if not self.check.dissipates_too_little(each.solved)]
        best = min(tried, key=lambda each: each.cost, default=given)
        if best.change is None or given.cost - best.cost < BETTER or not self._is_good(best, given):
            return None
        if best.change.kind == "ratio":
            best = self._refined(best, best.change)
        rivals = [each for each in tried if not _is_same(each.change, best.change)]
        if best.change is None or not all(_is_worse(each, best) for each in rivals):
            return None
        return Suspected(best.change, (best.solved.worst, given.solved.worst))

    @cached_property
    def _rows(self) -> tuple[Array, Array]:
        return _moving(self.check.recordings, self.check.model, self.check)

    @cached_property
    def _given(self) -> _Tried:
        return self._tried(Normal.of(*self._rows), None)

    def _is_good(self, best: _Tried, given: _Tried) -> bool:
        """Whether a change leaves little of the torque unexplained, and agrees with the description as it should."""
        near = best.distance < NEAR * self.check.prior.value.size
        return near and best.solved.worst < WELL and _is_nearer(best, given)

    def _tried(self, normal: Normal, change: ColumnChange | None, prior: Prior | None = None) -> _Tried:
        prior = prior or self.check.prior
        solved = normal.solved(np.ones(len(normal.torque)), prior)
        residual, distance = np.log(np.hypot(solved.relative, FLOOR)).sum(), solved.distance(prior)
        return _Tried(float(SAMPLES * residual + 0.5 * distance), distance, solved, change)

    def _with(self, change: ColumnChange) -> _Tried:
        """Evaluate a change; raises EstimationError for angles that no joint has."""
        changed = [
            replace(
                each,
                position=change.on_position(each.position, self.zero),
                torque=change.on_torque(each.torque, self.gains),
            )
            for each in self.check.recordings
        ]
        return self._tried(Normal.of(*_moving(changed, self.check.model, self.check)), change)

    def _changed(self) -> Iterator[_Tried]:
        for change in _changes(self.check.model.joints, self.unit):
            with suppress(EstimationError):
                yield self._with(change)

    def _otherwise(self) -> Iterator[_Tried]:
        """Evaluate explanations other than changes: another mount, wrong times, and one wrong torque constant."""
        gravity = self.check.model.base.chain.gravity
        for direction in directions_of_gravity(gravity):
            base = BaseParameters.of(replace(self.check.model.base.chain, gravity=direction))
            rows = _moving(self.check.recordings, ChainModel(base), self.check)
            yield self._tried(Normal.of(*rows), None, Prior.of(base, self.links))
        for slower in TIMES.tolist():
            with suppress(EstimationError):
                yield self._slower(slower)
        columns, torque = self._rows
        normal = Normal.of(columns, torque)
        for joint in range(len(torque)):
            for factor in FACTORS.tolist():
                scaled = np.where(np.arange(len(torque)) == joint, factor, 1.0)
                yield self._tried(normal.driven_by(columns, scaled[:, None] * torque), None)

    def _slower(self, factor: float) -> _Tried:
        """Evaluate times divided by `factor`; raises EstimationError if they cannot be filtered."""
        changed = [replace(each, time=each.time / factor) for each in self.check.recordings]
        check = replace(self.check, recordings=changed, cutoff=self.check.cutoff * factor)
        return self._tried(Normal.of(*_moving(changed, check.model, check)), None)

    def _refined(self, best: _Tried, change: ColumnChange) -> _Tried:
        """Refine a ratio, and round it to a ratio of small whole numbers if it is close to one."""
        ratio, at = change.factor, best
        for step in FINE:
            for tried in (ratio * step, ratio / step):
                other = self._with(replace(change, factor=tried))
                at = min(at, other, key=lambda each: each.cost)
            ratio = at.change.factor if at.change else ratio
        simple = min((p / q for p in range(1, 11) for q in range(1, 11)), key=lambda each: abs(np.log(each / ratio)))
        if abs(simple / ratio - 1.0) < ROUND:
            return self._with(replace(change, factor=simple))
        return at


def _moving(recordings: Sequence[Recording], model: ChainModel, check: ColumnCheck) -> tuple[Array, Array]:
    """Return the rows of filtered inverse dynamics, with zeros where a joint stands still."""
    Y, torque = filtered_torques(recordings, model, check.cutoff, check.delay)
    joints, start = range(model.joints), model.base.count + model.joints
    slides = np.stack([np.abs(Y[joint, :, start + joint]) > SLIDES for joint in joints])
    return np.where(slides[:, :, None], Y, 0.0), np.where(slides, torque, 0.0)


def _changes(joints: int, unit: str) -> Iterator[ColumnChange]:
    every: tuple[Columns, ...] = ("position", "torque", "both")
    for columns in every:
        for pair in combinations(range(joints), 2):
            yield ColumnChange("exchange", pair, columns)
        for joint in range(joints):
            yield ColumnChange("direction", (joint,), columns)
        if joints > 1:
            yield ColumnChange("direction", tuple(range(joints)), columns)
    for joint in range(joints):
        for turned in ZEROS.tolist():
            yield ColumnChange("zero", (joint,), turned=turned)
        for ratio in RATIOS:
            yield ColumnChange("ratio", (joint,), factor=ratio)
    for stated, true in permutations(ANGLE_UNITS, 2):
        if stated == unit:
            yield ColumnChange("unit", factor=ANGLE_UNITS[true] / ANGLE_UNITS[stated], units=(stated, true))


def _is_same(one: ColumnChange | None, other: ColumnChange | None) -> bool:
    """Whether two changes are equal, apart from the value of a ratio."""
    if one is None or other is None:
        return False
    return one == other or (one.kind == "ratio" and replace(one, factor=other.factor) == other)


def _is_nearer(one: _Tried, other: _Tried) -> bool:
    """Whether one explanation agrees with the description so much better that the description decides."""
    return other.distance - one.distance >= LESS and other.distance >= CLOSER * one.distance


def _is_worse(rival: _Tried, best: _Tried) -> bool:
    return rival.cost - best.cost >= BETTER or (rival.cost > best.cost and _is_nearer(best, rival))
