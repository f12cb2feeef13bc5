"""Check that, until torque is switched on, the arm stays in the pose in which it was first read.

If its reported angles change, they are no longer correct: a horn has slipped, another servo answers, or another program
has changed Homing Offset.
"""

import math
from collections.abc import Mapping

from hil.drivers.bus import ServoBus
from hil.drivers.joint import Joint
from hil.errors import ExperimentError

__all__ = ["MOST_RAD", "Lies", "has_stirred", "refuse_moved", "where_it_lies"]

MOST_RAD = 0.05
"""Largest motion allowed before torque is switched on [rad]; the guard allows the same before the start."""

STIRRED_RAD = 0.004
"""Smallest motion that encoder noise cannot explain [rad]; an arm that moves this far is not at rest."""

Lies = Mapping[Joint, int]
"""Present Position of each servo [ticks]."""


def where_it_lies(bus: ServoBus) -> Lies:
    """Read each servo's Present Position. Raises the same errors as `Servo.read`."""
    return {drive: servo.read("Present Position") for drive, servo in bus.drives.items()}


def has_stirred(before: Lies, now: Lies) -> bool:
    """Whether the arm was moving between two readings."""
    return any(abs(_turned(drive, before, now)) > STIRRED_RAD for drive in now)


def refuse_moved(before: Lies, now: Lies, bus: ServoBus) -> None:
    """Raise ExperimentError if a joint has moved by more than MOST_RAD between two readings.

    Such a joint is read again, because the first reply may belong to an earlier request: the two readings then differ
    by more than an arm can turn in between. Raises the same errors as `Servo.read`.
    """
    for drive in now:
        turned = _turned(drive, before, now)
        if abs(turned) > MOST_RAD:
            again = _turned(drive, before, {drive: bus.drives[drive].read("Present Position")})
            if abs(again) <= MOST_RAD < abs(turned - again):
                raise ExperimentError(
                    f"{drive.title} reported an angle that differed from the first one by {turned:+.3f} rad, and by "
                    f"{again:+.3f} rad when read again: its replies come one request late, or it was moved and moved "
                    "back. Unplug the adapter, plug it in and start again; if this recurs, replace the adapter or its "
                    "cable."
                )
            raise ExperimentError(
                f"{drive.title} has turned by {turned:+.3f} rad since this command first read its angle, before "
                f"torque was switched on; at most {MOST_RAD} is allowed. Let the arm come to rest, then start "
                "again. Check whether a hand or a cable is pushing or holding it, whether its horn slips, whether its "
                "encoder has failed, and whether another program is changing its settings."
            )


def _turned(drive: Joint, before: Lies, now: Lies) -> float:
    """Angle between two readings [rad], within half a turn, because a servo that was switched off loses whole turns."""
    return math.remainder((now[drive] - before.get(drive, now[drive])) * drive.position_unit, math.tau)
