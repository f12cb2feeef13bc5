"""Mistakes in the columns of a spatial arm's recording: clear ones raise CsvError; the fit tolerates the others."""

import math
from collections.abc import Sequence

from hil.config.chain import mount_angles
from hil.errors import CsvError
from hil.estimation.torque_constants import RATIO, contradictions
from hil.estimation.unsettled.slips import reversal_said, unexplained
from hil.estimator.chain.column_faults import AS_WELL, ColumnCheck
from hil.estimator.chain.mount import Agreement
from hil.results.parts import Quantity

ROUGHLY = 0.05  # assumed relative standard error of a ratio of torques obtained by regression


def refuse_chain_slips(
    check: ColumnCheck | None, joints: Sequence[str], source: str, mounted: Agreement | None = None
) -> None:
    """Raise CsvError if signs are reversed, columns are swapped or times are scaled.

    joints: their names. mounted: another direction of gravity that explains the recordings; columns that explain them
    less well are not to blame, and others are named together with the mount.
    """
    if check is None or not check.suspicious:
        return
    worst = math.inf if mounted is None else AS_WELL * mounted.worst
    signs, swapped = check.reversed_columns(), check.swapped_columns()
    signs = None if signs is None or signs.residuals[0] > worst else signs
    swapped = None if swapped is None or swapped.residuals[0] > worst else swapped
    if swapped is not None and (signs is None or swapped.residuals[0] < signs.residuals[0]):
        names = [joints[joint] if joints else f"joint {joint + 1}" for joint in swapped.joints]
        raise CsvError(
            f"{source}: the {swapped.columns} of {names[0]} and {names[1]} seem to be swapped: with them exchanged, "
            f"{unexplained(*swapped.residuals)}. Exchange them in the file, or in [columns] of --config ARM.toml."
            f"{_or_mounted(mounted)}"
        )
    if signs is not None:
        gain = "friction is positive instead of negative" if signs.impossible else unexplained(*signs.residuals)
        instead = f" (or, just as likely, {signs.instead.said(joints)})" if signs.instead else ""
        raise CsvError(
            f"{source}: {reversal_said(signs.signs, joints)}, {gain}{instead}. Fix this in the file, or correct the "
            f"axis in the description of the arm; `hil pose` shows each joint's direction.{_or_mounted(mounted)}"
        )
    times = check.wrong_times()
    if times is not None and times.residuals[0] <= worst:
        raise CsvError(
            f"{source}: the times seem to be about {times.factor:.2g} times the true ones: with times divided by this "
            f"factor, {unexplained(*times.residuals)}. Check the unit of time, the sample rate and arm.gravity."
        )


def _or_mounted(mounted: Agreement | None) -> str:
    if mounted is None:
        return ""
    base = mount_angles(mounted.gravity)
    return f" If the columns are right, the arm is mounted differently: set base = {base} under [arm]."


def late_torque(check: ColumnCheck | None, joints: Sequence[str], fitted: bool) -> tuple[str, ...]:
    """A sentence about a torque logged late or early. fitted: whether the fit contains a delay common to all joints."""
    late = None if check is None else check.late_torque()
    if late is None or (late.joint is None and fitted):
        return ()
    whose = "All torques seem" if late.joint is None else f"The torque of {joints[late.joint]} seems"
    direction = "late" if late.seconds > 0.0 else "early"
    return (
        f"{whose} to be logged about {1e3 * abs(late.seconds):.0f} ms too {direction}: with this corrected, "
        f"{unexplained(*late.residuals)}. Shift the column in the file; a filter can also cause such a delay.",
    )


def torques_apart(check: ColumnCheck | None, joints: Sequence[str]) -> tuple[str, ...]:
    """Sentences about torque columns whose scales differ by more than the spread of torque constants can explain."""
    factors = None if check is None else check.contradictory_torques()
    known = {f"{RATIO}_{number}": Quantity(each, ROUGHLY * each, "1") for number, each in enumerate(factors or (), 1)}
    return contradictions(joints, known, {}, "column")
