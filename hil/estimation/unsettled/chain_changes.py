"""Name the one mistake in the columns of a spatial arm's recording, and what to set."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.config.csv_columns import Columns
from hil.description.arm import ArmDescription
from hil.estimation.torque_constants import capitalised
from hil.estimation.unsettled.slips import unexplained
from hil.estimator.chain.column_changes import ColumnChange, ColumnSearch, Suspected
from hil.estimator.chain.column_faults import ColumnCheck
from hil.recordings.guess import listed, quoted

HALF = 0.5  # largest ratio of the torque residuals at which an estimate would be useless


@dataclass(frozen=True)
class ChangedColumns:
    """The mistake. what: the columns and what is wrong with them. remedy: what to set or to change, in the
    imperative. is_useless: whether an estimate from the columns as given would be useless.
    """

    what: str
    remedy: str
    residuals: tuple[float, float]
    is_useless: bool

    @property
    def refusal(self) -> str:
        """A sentence on why there is no estimate, and one on what to do."""
        return f"{self.what}: with this corrected, {unexplained(*self.residuals)}. {capitalised(self.remedy)}."

    def said(self, description: str) -> tuple[str, ...]:
        """Sentences for the verdict. description: name of the file that describes the arm."""
        return (
            f"The recording contradicts {description}: {self.what}; with this corrected, the two agree. "
            f"{capitalised(self.remedy)}, and estimate again; the recording remains usable.",
        )


def changed_columns(check: ColumnCheck | None, arm: ArmDescription, columns: Columns) -> ChangedColumns | None:
    """Return the one mistake in the columns without which recordings and description would agree, if there is one."""
    joints = len(arm.joints)
    if check is None:
        return None
    zero, gains = np.array(columns.zero or [0.0] * joints), np.array(columns.gains or [1.0] * joints)
    found = ColumnSearch(check, arm.parameters, zero, gains, columns.position_unit or "").suspected()
    return None if found is None else _said(found, [joint.name for joint in arm.joints], columns)


def _said(found: Suspected, names: Sequence[str], columns: Columns) -> ChangedColumns:
    change, (after, before) = found.change, found.residuals
    what, remedy = {
        "exchange": _exchange,
        "direction": _direction,
        "zero": _zero,
        "ratio": _ratio,
        "unit": _unit,
    }[change.kind](change, names, columns)
    is_useless = change.kind not in ("zero", "ratio") or after < HALF * before
    return ChangedColumns(what, remedy, found.residuals, is_useless)


def _exchange(change: ColumnChange, names: Sequence[str], columns: Columns) -> tuple[str, str]:
    first, second = change.joints
    keys = []
    for key in _keys(change, columns):
        order = list(getattr(columns, key))
        order[first], order[second] = order[second], order[first]
        keys.append(listed(key, order))
    kinds = {"position": "positions", "torque": "torques", "both": "torques and positions"}[change.columns]
    return (
        f"the {kinds} of {names[first]} and {names[second]} seem to be swapped",
        f"set {' and '.join(keys)} in [columns] of --config ARM.toml",
    )


def _direction(change: ColumnChange, names: Sequence[str], columns: Columns) -> tuple[str, str]:
    reversed_ = [getattr(columns, key)[joint] for key in _keys(change, columns) for joint in change.joints]
    kinds = {"position": "position", "torque": "torque", "both": "torque and the position"}[change.columns]
    several, of_all = len(reversed_) > 1, len(change.joints) > 1
    joints = "all joints" if of_all else names[change.joints[0]]
    instead = f", or reverse the axis of {joints} in the description of the arm" if change.columns == "both" else ""
    return (
        f"the sign{'s' if several else ''} of the {kinds} of {joints} {'are' if several else 'is'} reversed",
        f"multiply {', '.join(map(quoted, reversed_))} by -1 in the file{instead}",
    )


def _zero(change: ColumnChange, names: Sequence[str], columns: Columns) -> tuple[str, str]:
    (joint,) = change.joints
    zero = list(columns.zero or [0.0] * len(names))
    zero[joint] = _wrapped(zero[joint] + change.turned)
    return (
        f"the zero of {names[joint]} seems to be off by {abs(math.degrees(change.turned)):.0f} degrees",
        f"set zero = [{', '.join(f'{each:.6g}' for each in zero)}] in [columns] of --config ARM.toml",
    )


def _ratio(change: ColumnChange, names: Sequence[str], columns: Columns) -> tuple[str, str]:
    (joint,) = change.joints
    assert columns.position is not None  # filled in when the file was read
    factor = f"{1.0 / change.factor:.4g}"
    return (
        f"the angles of {names[joint]} seem to be {factor} times the true ones, as if by a gear ratio",
        f"divide {quoted(columns.position[joint])} by {factor} in the file",
    )


def _unit(change: ColumnChange, names: Sequence[str], columns: Columns) -> tuple[str, str]:
    stated, true = change.units
    return (
        f"the angles were read as {stated} but seem to be in {true}",
        f'correct the unit in the headers of the columns, or set position_unit = "{true}" in [columns] of '
        "--config ARM.toml",
    )


def _keys(change: ColumnChange, columns: Columns) -> list[str]:
    """Return the keys of the columns that change."""
    assert columns.drive is not None  # filled in when the file was read
    return [key for key in (columns.drive, "position") if change.columns in ("both", _kind(key))]


def _kind(key: str) -> str:
    return "position" if key == "position" else "torque"


def _wrapped(angle: float) -> float:
    """Return the angle in (-pi, pi] [rad]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)
