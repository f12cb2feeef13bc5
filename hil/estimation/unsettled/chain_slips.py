"""Mistakes in the columns of a spatial arm's recording: refused before the fit if clear, otherwise left to the fit."""

import math
from collections.abc import Sequence

from hil.errors import CsvError
from hil.estimation.torque_constants import CONTRADICTORY, allowed_ratio
from hil.estimation.unsettled.slips import reversal_said, unexplained
from hil.estimator.chain.column_faults import ColumnCheck, Contradictory
from hil.estimator.chain.recordings import RecordedChain


def refuse_chain_slips(check: ColumnCheck | None, joints: Sequence[str], source: str) -> None:
    """Raise CsvError if signs are reversed or the times have a wrong scale. joints: their names."""
    if check is None or not check.suspicious:
        return
    signs = check.reversed_columns()
    if signs is not None:
        evidence = (
            "friction is positive instead of negative"
            if signs.impossible
            else unexplained(signs.residual, signs.residual_given)
        )
        raise CsvError(
            f"{source}: {reversal_said(signs.signs, joints)}, {evidence}. Change that in the file, or correct the "
            "axis in the description of the arm; `hil pose` shows each joint's direction."
        )
    times = check.wrong_times()
    if times is not None:
        raise CsvError(
            f"{source}: the times seem to be about {times.factor:.2g} times the true ones: with times divided by this "
            f"factor, {unexplained(times.residual, times.residual_given)}, given gravity and the geometry of the arm. "
            "Check the unit of time and the sample rate, and arm.gravity."
        )


def apart(check: ColumnCheck | None) -> Contradictory | None:
    """Torque columns whose factors are farther from 1 than the spread of torque constants allows."""
    found = None if check is None else check.contradictory_torques()
    return found if found is not None and max(abs(math.log(each)) for each in found.factors) > allowed_ratio() else None


def ratios_apart(found: RecordedChain) -> bool:
    """Whether the likelihood confirms that torques contradict each other."""
    known = zip(found.names, found.value, found.std, strict=True)
    return any(
        abs(math.log(max(value, 1e-6))) > math.hypot(allowed_ratio(), CONTRADICTORY * std / max(value, 1e-6))
        for name, value, std in known
        if name.startswith("torque_scale")
    )


def regression_said(found: Contradictory, joints: Sequence[str]) -> str:
    """A sentence on contradictory torques whose factors a regression does not estimate."""
    listed = " and ".join(
        f"{joint} {factor:.2g} times"
        for joint, factor in zip(joints, found.factors, strict=True)
        if abs(math.log(factor)) > allowed_ratio()
    )
    return (
        f"The torque columns contradict each other: relative to {joints[0]}, inverse dynamics is consistent with "
        f"{listed} the torque that the column states. Check the unit, the scale, the gear ratio and the torque "
        "constant behind these columns; do not use these numbers."
    )
