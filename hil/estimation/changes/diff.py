"""Comparison of two identifications of one arm: which parameters changed significantly.

Every common parameter is tested individually, and each joint's friction also as a whole
(hil.estimation.changes.friction_change). Holm's step-down correction keeps the probability of any false alarm in the
whole table at `FALSE_ALARMS` (S. Holm, Scandinavian Journal of Statistics 6 (1979) 65). A change must also be larger
than the fraction `least_share` of the parameter's magnitude, since standard errors cover noise only.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from os import PathLike
from pathlib import Path
from statistics import NormalDist
from typing import Any

from hil.arm_model import ArmModel
from hil.drivers.servo_model import with_article
from hil.errors import ResultError
from hil.estimation.changes.friction_change import FrictionChange, friction_changes
from hil.model_file import read_model, read_result
from hil.results.parts import Covariance

FALSE_ALARMS = 0.05
LEAST_SHARE = 0.01
_POWER_Z = 1.645
"""Number of standard errors by which a change must exceed the threshold to be detected with a probability of 95 %."""


@dataclass(frozen=True)
class Change:
    """The change of one parameter: values, standard errors, difference in units of the combined standard error, and
    p-value.

    changed: whether it is significant after Holm's correction and larger than a minimum fraction of the parameter's
    magnitude.
    """

    name: str
    before: float
    before_std: float
    after: float
    after_std: float
    z: float
    p: float
    changed: bool

    @property
    def percent(self) -> float | None:
        """Change in percent of the earlier value; None if that is 0."""
        return 100 * (self.after - self.before) / self.before if self.before else None


@dataclass(frozen=True)
class Difference:
    """The changes from one run to another.

    only_before, only_after: terms that only one of the two models has. detectable: for each friction term, the smallest
    change that two such runs would reveal with a probability of 95 % if no other term changed [% of its earlier value].
    """

    before: str
    after: str
    changes: tuple[Change, ...]
    only_before: tuple[str, ...]
    only_after: tuple[str, ...]
    detectable: Mapping[str, float] = field(default_factory=dict)
    trust: tuple[str | None, str | None] = (None, None)
    other_joints: tuple[str, ...] = ()
    """Warnings: one sentence per joint that the runs describe differently, and one if a run is compared with itself."""

    @property
    def changed(self) -> tuple[Change, ...]:
        """The significant changes, most significant first."""
        return tuple(sorted((each for each in self.changes if each.changed), key=lambda change: -abs(change.z)))

    @property
    def doubts(self) -> tuple[str, ...]:
        """Warnings: those in `other_joints`, and a sentence about each model that should not be trusted without
        reservation.
        """
        untrusted = tuple(
            f'The report of {name} says "trust this model: {trust}" and explains why. The values may be biased '
            "by more than their standard errors, so a change may come from the model instead of the arm."
            for name, trust in zip((self.before, self.after), self.trust, strict=True)
            if trust not in (None, "yes")
        )
        return (*self.other_joints, *untrusted)

    def to_json(self) -> dict[str, Any]:
        """The changes as plain values; the JSON writer turns infinities into null."""
        return asdict(self) | {"changed": [change.name for change in self.changed]}


def diff_runs(before: str | PathLike[str], after: str | PathLike[str]) -> Difference:
    """Compare two run folders, result.json files or exported models of one arm. Raises ResultError."""
    before, after = Path(before), Path(after)
    models = read_model(before), read_model(after)
    counts = [len(model.joints) for model in models]
    if counts[0] != counts[1]:
        raise ResultError(f"{before} has {counts[0]} joints and {after} has {counts[1]}: they are not the same arm.")
    rows = friction_changes(models, (_covariance(before), _covariance(after)))
    difference = diff_models(*models, str(before), str(after), friction=rows)
    same = (f"{before} is compared with itself.",) if before.resolve() == after.resolve() else ()
    trust = (_trust(before), _trust(after))
    return replace(difference, trust=trust, other_joints=(*same, *difference.other_joints))


def _other_joints(before: ArmModel, after: ArmModel) -> tuple[str, ...]:
    return tuple(
        f"Joint {number} was {old.name!r} with {with_article(old.servo)} and is {new.name!r} with "
        f"{with_article(new.servo)}: if these are different arms, the changes are differences between the arms."
        for number, (old, new) in enumerate(zip(before.joints, after.joints, strict=True), 1)
        if (old.name, old.servo) != (new.name, new.servo)
    )


def _trust(path: Path) -> str | None:
    """The verdict of a run; None for a model that was exported without one."""
    try:
        verdict = read_result(path).verdict
    except ResultError:
        return None
    return None if verdict is None else verdict.trust


def _covariance(path: Path) -> Covariance | None:
    """Covariance of a run's result; None for a model that was exported without one."""
    try:
        return read_result(path).covariance
    except ResultError:
        return None


def diff_models(
    before: ArmModel,
    after: ArmModel,
    name_before: str = "before",
    name_after: str = "after",
    least_share: float = LEAST_SHARE,
    friction: Sequence[FrictionChange] = (),
) -> Difference:
    """Compare two models of one arm, parameter by parameter, in the order of the first model."""
    periods = ("ripple_cycles", "cogging_cycles")
    common = [name for name in before.values if name in after.values and not name.startswith(periods)]
    z = {name: _z(before, after, name) for name in common}
    p = {name: math.erfc(abs(value) / math.sqrt(2)) for name, value in z.items()} | {
        row.name: row.p for row in friction
    }
    significant = _holm(p, FALSE_ALARMS)
    changes = [
        Change(
            name,
            *(before.values[name], before.stds[name], after.values[name], after.stds[name]),
            z[name],
            p[name],
            name in significant
            and abs(after.values[name] - before.values[name]) > least_share * _scale(before, after, name),
        )
        for name in common
    ]
    changes += [
        Change(
            row.name,
            *(row.before, row.std / math.sqrt(2), row.after, row.std / math.sqrt(2)),
            row.z,
            row.p,
            row.name in significant
            and abs(row.after - row.before) > least_share * max(abs(row.before), abs(row.after)),
        )
        for row in friction
    ]
    return Difference(
        name_before,
        name_after,
        tuple(changes),
        tuple(name for name in before.values if name not in after.values),
        tuple(name for name in after.values if name not in before.values),
        _detectable(before, friction, FALSE_ALARMS / max(len(p), 1)),
        other_joints=_other_joints(before, after),
    )


def _detectable(before: ArmModel, friction: Sequence[FrictionChange], level: float) -> dict[str, float]:
    """Smallest detectable change of each friction term [%] if its p-value must be below `level`."""
    found = {}
    for row in friction:
        threshold = NormalDist().inv_cdf(1 - level / (len(row.stds) + 1) / 2)
        for name, std in row.stds.items():
            if before.values.get(name):
                found[name] = 100 * (threshold + _POWER_Z) * std / abs(before.values[name])
    return found


def _z(before: ArmModel, after: ArmModel, name: str) -> float:
    return _deviation((before.values[name], after.values[name]), (before.stds[name], after.stds[name]))


def _deviation(value: tuple[float, float], stds: tuple[float, float]) -> float:
    difference = value[1] - value[0]
    std = math.hypot(*stds)
    if not math.isfinite(std):
        return 0.0
    if std == 0.0:
        return 0.0 if difference == 0.0 else math.copysign(math.inf, difference)
    return difference / std


def _holm(p: dict[str, float], level: float) -> set[str]:
    """Names of the parameters whose change is significant by Holm's procedure at the family-wise level `level`."""
    rejected: set[str] = set()
    for rank, name in enumerate(sorted(p, key=lambda each: p[each])):
        if p[name] > level / (len(p) - rank):
            break
        rejected.add(name)
    return rejected


def _scale(before: ArmModel, after: ArmModel, name: str) -> float:
    """Scale of a change: the magnitude of the parameter or, for an offset, of the joint's Coulomb friction."""
    values = [abs(model.values[name]) for model in (before, after)]
    kind, _, joint = name.rpartition("_")
    if kind == "offset":
        values += [abs(model.values.get(f"coulomb_{joint}", 0.0)) for model in (before, after)]
    return max(values)
