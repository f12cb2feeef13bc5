"""Mistakes in the columns of a spatial arm's recording: refused before the fit if clear, otherwise left to the fit."""

from collections.abc import Sequence

from hil.errors import CsvError
from hil.estimation.torque_constants import RATIO, contradictions
from hil.estimation.unsettled.slips import reversal_said, unexplained
from hil.estimator.chain.column_faults import ColumnCheck
from hil.results.parts import Quantity

ROUGHLY = 0.05  # assumed relative standard error of a ratio of torques that a regression gives


def refuse_chain_slips(check: ColumnCheck | None, joints: Sequence[str], source: str) -> None:
    """Raise CsvError if signs are reversed or the times have a wrong scale. joints: their names."""
    if check is None or not check.suspicious:
        return
    signs = check.reversed_columns()
    if signs is not None:
        gain = "friction is positive instead of negative" if signs.impossible else unexplained(*signs.residuals)
        raise CsvError(
            f"{source}: {reversal_said(signs.signs, joints)}, {gain}. Change that in the file, or correct the axis in "
            "the description of the arm; `hil pose` shows each joint's direction."
        )
    times = check.wrong_times()
    if times is not None:
        raise CsvError(
            f"{source}: the times seem to be about {times.factor:.2g} times the true ones: with times divided by this "
            f"factor, {unexplained(*times.residuals)}. Check the unit of time and the sample rate, and arm.gravity."
        )


def torques_apart(check: ColumnCheck | None, joints: Sequence[str]) -> tuple[str, ...]:
    """Sentences on torque columns whose factors differ by more than the spread of torque constants allows."""
    factors = None if check is None else check.contradictory_torques()
    known = {f"{RATIO}_{number}": Quantity(each, ROUGHLY * each, "1") for number, each in enumerate(factors or (), 1)}
    return contradictions(joints, known, {}, "column")
