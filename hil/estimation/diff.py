"""Comparison of two identifications of one arm: which parameters changed significantly.

Every common parameter is tested on its own, z = difference / sqrt(std_a^2 + std_b^2), and Holm's step-down correction
keeps the probability of any false alarm in the whole table at `false_alarms` (S. Holm, Scandinavian Journal of
Statistics 6 (1979) 65). A change must also be larger than `least_share` of the parameter's scale: standard errors cover
noise only, and two runs of an arm with some unmodelled friction differ by a little more.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hil.arm_model import ArmModel
from hil.errors import ResultError
from hil.model_file import read_model

FALSE_ALARMS = 0.05
LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Change:
    """The change of one parameter: values, standard errors, difference in combined standard errors, and p-value.

    changed: whether it is significant after Holm's correction and larger than the minimum share of its scale.
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
        """Change in percent of the value before; None if that is 0."""
        return 100 * (self.after - self.before) / self.before if self.before else None


@dataclass(frozen=True)
class Difference:
    """The changes from one run to another.

    only_before, only_after: terms that only one of the two models has.
    """

    before: str
    after: str
    changes: tuple[Change, ...]
    only_before: tuple[str, ...]
    only_after: tuple[str, ...]

    @property
    def changed(self) -> tuple[Change, ...]:
        """The significant changes, most significant first."""
        return tuple(sorted((each for each in self.changes if each.changed), key=lambda change: -abs(change.z)))

    def to_json(self) -> dict[str, Any]:
        """The changes as plain values; the JSON writer turns infinities into null."""
        return asdict(self) | {"changed": [change.name for change in self.changed]}


def diff_runs(
    before: Path, after: Path, false_alarms: float = FALSE_ALARMS, least_share: float = LEAST_SHARE
) -> Difference:
    """Compare two run folders, result.json files or exported models of one arm. Raises ResultError."""
    models = read_model(before), read_model(after)
    counts = [len(model.joints) for model in models]
    if counts[0] != counts[1]:
        raise ResultError(f"{before} has {counts[0]} joints and {after} {counts[1]}: they are not the same arm.")
    return diff_models(*models, str(before), str(after), false_alarms, least_share)


def diff_models(
    before: ArmModel,
    after: ArmModel,
    name_before: str = "before",
    name_after: str = "after",
    false_alarms: float = FALSE_ALARMS,
    least_share: float = LEAST_SHARE,
) -> Difference:
    """Compare two models of one arm parameter by parameter, in the order of the first."""
    common = [name for name in before.values if name in after.values and not name.startswith("ripple_cycles")]
    z = {name: _z(before, after, name) for name in common}
    p = {name: math.erfc(abs(value) / math.sqrt(2)) for name, value in z.items()}
    significant = _holm(p, false_alarms)
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
    return Difference(
        name_before,
        name_after,
        tuple(changes),
        tuple(name for name in before.values if name not in after.values),
        tuple(name for name in after.values if name not in before.values),
    )


def _z(before: ArmModel, after: ArmModel, name: str) -> float:
    difference = after.values[name] - before.values[name]
    std = math.hypot(before.stds[name], after.stds[name])
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
    """Magnitude that a change is compared with: the parameter's own, or the joint's Coulomb friction for an offset."""
    values = [abs(model.values[name]) for model in (before, after)]
    kind, _, joint = name.rpartition("_")
    if kind == "offset":
        values += [abs(model.values.get(f"coulomb_{joint}", 0.0)) for model in (before, after)]
    return max(values)
