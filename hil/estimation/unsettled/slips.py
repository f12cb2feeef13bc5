"""Rejection of recordings with a clear mistake in their columns: an estimate would take a minute but be useless."""

import math
from collections.abc import Sequence

import numpy as np

from hil.errors import CsvError
from hil.estimator.baselines.signs import (
    Signs,
    suspect_absolute,
    suspect_absolute_unzeroed,
    suspect_order,
    suspect_signs,
    suspect_swapped,
    suspect_unit,
    with_signs,
)
from hil.estimator.baselines.zero import turned_zeros
from hil.estimator.data.recording import Recording

CLEAR = 0.25
"""A mistake is clear only if correcting it multiplies the torque residual by less than this factor."""

NEARLY_ALL = 0.9  # fraction of the segments
STUCK_STEPS = 10.0  # motion in encoder steps below which a joint sticks
SAME_ANGLE = 0.01  # rad

WELL = 0.3
"""A mistake is clear only if correcting it leaves a torque residual of less than this fraction of the RMS torque."""


def refuse_slips(
    recordings: Sequence[Recording], source: str, zero: Sequence[float] | None = None, zero_is_set: bool = True
) -> None:
    """Raise CsvError if a sign is reversed, joints or torques are swapped, or an angle is measured from a fixed
    direction instead of from the previous link.

    zero: columns.zero, which the angles in the recordings already include; None if it is not known. zero_is_set:
    whether the user set it.
    """
    _refuse_absolute(recordings, source, zero, zero_is_set)
    order = suspect_order(recordings)
    if order is not None and _is_clear(*order):
        raise CsvError(
            f"{source}: the joints seem to be in the wrong order: with angles and torques of joints 1 and 2 exchanged, "
            f"{unexplained(*order)}. "
            "Joint 1 is the one at the base: name its columns first in [columns] of --config ARM.toml"
            f"{', and exchange the two values of zero as well' if zero_is_set and zero is not None else ''}."
        )
    for column, swapped in (
        ("torque", suspect_swapped(recordings)),
        ("position", suspect_order(recordings, torques=False)),
    ):
        if swapped is not None and _is_clear(*swapped):
            raise CsvError(
                f"{source}: the {column} columns of joints 1 and 2 seem to be swapped: with them exchanged, "
                f"{unexplained(*swapped)}. Exchange them in the file, or in [columns] of --config ARM.toml."
            )
    signs = suspect_signs(recordings, not zero_is_set)
    if signs is None or not _is_clear(signs.residual, signs.residual_given):
        _refuse_units(recordings, source, zero)
    if signs is None:
        return
    if _is_clear(signs.residual, signs.residual_given):
        raise CsvError(
            f"{source}: {reversal_said(signs.signs)}, {unexplained(signs.residual, signs.residual_given)}. "
            f"{_correction(recordings, signs.signs, zero if zero_is_set else None)}"
        )
    # Reversing all torques leaves the same residual, but no body has a negative inertia.
    inertias = [name for name in signs.impossible if name.startswith("inertia")]
    if inertias and signs.residual < WELL:
        verb = "are" if signs.signs.are_several else "is"
        raise CsvError(
            f"{source}: {signs.signs.said()} {verb} reversed: as given, {' and '.join(inertias)} would be negative. "
            f"{_correction(recordings, signs.signs, zero if zero_is_set else None)}"
        )


def _refuse_units(recordings: Sequence[Recording], source: str, zero: Sequence[float] | None) -> None:
    """Raise CsvError if the angles are in another unit than stated. zero: see `refuse_slips`."""
    found = suspect_unit(recordings, zero or ())
    if found is None or not _is_clear(found.residual, found.residual_given):
        return
    raise CsvError(
        f"{source}: the angles seem to be in another unit than stated, as if {found.true} had been read as "
        f"{found.stated}: with the angles in {found.true}, {unexplained(found.residual, found.residual_given)}. "
        f'Correct the unit in the headers of the columns, or set position_unit = "{found.true}" in [columns] of '
        "--config ARM.toml."
    )


def _correction(recordings: Sequence[Recording], signs: Signs, zero: Sequence[float] | None) -> str:
    """Say how to reverse columns. zero: columns.zero if the user set it; its entry for a reversed angle must change
    too.
    """
    if zero is None or min(signs.position) > 0:
        return "Correct this in the file."
    moved = turned_zeros(with_signs(recordings, signs))
    turned = np.array(zero) * signs.position + (0.0 if moved is None else moved)
    said = ", ".join(f"{(each + math.pi) % (2.0 * math.pi) - math.pi:.4f}" for each in turned.tolist())
    return f"Correct this in the file, and set in [columns] of --config ARM.toml: zero = [{said}]."


def refuse_stuck(recordings: Sequence[Recording], source: str, segment: float) -> None:
    """Raise CsvError if a joint hardly moves in nearly all segments of length `segment` [s].

    Its motion is then dominated by friction, and the fit would take minutes.
    """
    for joint in range(recordings[0].joints):
        steps = [
            float(np.ptp(part)) / float(each.position_step[joint])
            for each in recordings
            for part in np.array_split(each.filled()[joint], max(1, round(float(np.ptp(each.time)) / segment)))
        ]
        if float(np.quantile(steps, NEARLY_ALL)) < STUCK_STEPS:
            raise CsvError(
                f"{source}: joint {joint + 1} sticks: in {100 * NEARLY_ALL:.0f} % of the segments of {segment:g} s it "
                f"moves by less than {STUCK_STEPS:g} encoder steps, so friction hides everything else. Drive it "
                "harder, or record with a finer encoder; longer segments (columns.segment) help if it creeps."
            )


def _refuse_absolute(
    recordings: Sequence[Recording], source: str, zero: Sequence[float] | None, zero_is_set: bool
) -> None:
    """Raise CsvError if the angle of joint 2 is absolute; the message also gives the zero if that must change."""
    joints = recordings[0].joints
    free = suspect_absolute_unzeroed(recordings) if zero is None or not zero_is_set else None
    zero = zero or (0.0,) * joints
    # columns.zero applies to the difference of the angles, but both zeros were added to the absolute angles.
    found = free or suspect_absolute(recordings, (zero[0], zero[0] - zero[-1]))
    if found is None or not _is_clear(found.residual, found.residual_given):
        return
    second = (zero[-1] + found.turned - zero[0] + math.pi) % (2.0 * math.pi) - math.pi
    is_same = abs(second - zero[-1]) < SAME_ANGLE or free is not None
    other = "" if is_same else f" and zero = [{zero[0]:.4f}, {second:.4f}]"
    raise CsvError(
        f"{source}: the angle of joint 2 seems to be measured from a fixed direction, such as the horizontal, "
        f"instead of from link 1. With the difference between the two angles, "
        f"{unexplained(found.residual, found.residual_given)}. Set in [columns] of --config ARM.toml (in Python: "
        f'config="ARM.toml"): angles = "absolute"{other}'
    )


def reversal_said(signs: Signs, joints: Sequence[str] = ()) -> str:
    """Name the reversed signs; the caller appends the effect of a correction. joints: their names; default: numbers."""
    if signs.are_several:
        return f"{signs.said(joints)} are reversed: with these signs changed"
    return f"{signs.said(joints)} is reversed: with the sign changed"


def _is_clear(residual: float, given: float) -> bool:
    return residual < CLEAR * given and residual < WELL


def unexplained(residual: float, given: float) -> str:
    """State how much of the torque inverse dynamics leaves unexplained with a correction, and how much without it."""
    return f"inverse dynamics leaves {_percent(residual)} of the torque unexplained instead of {_percent(given)}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
