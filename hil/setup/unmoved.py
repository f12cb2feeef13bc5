"""Wait until the arm is at rest. Until torque is switched on, check that the arm is still in the pose in which it was
first read.

If the reported angles of an arm at rest change, they can no longer be trusted: a horn may have slipped, another servo
may be answering, or another program may have changed Homing Offset.
"""

import math
from collections.abc import Mapping

from hil.drivers.bus import ServoBus
from hil.drivers.joint import Joint
from hil.errors import ExperimentError

__all__ = ["MOST_RAD", "Lies", "has_stirred", "refuse_moved", "wait_for_rest", "where_it_lies"]

MOST_RAD = 0.05
"""Largest motion allowed before torque is switched on [rad]; the guard allows the same before the start."""

STIRRED_RAD = 0.004
"""Smallest motion that encoder noise cannot explain [rad]; an arm that moves this far is not at rest."""

_LONGEST_REST_S, _REST_EVERY_S, _REST_WITHIN_RAD = 15.0, 0.5, 0.004
"""Longest wait for an arm to come to rest [s], interval between checks [s], and smallest change between two checks that
counts as motion [rad].
"""

Lies = Mapping[Joint, int]
"""Present Position of each servo [ticks]."""


def where_it_lies(bus: ServoBus) -> Lies:
    """Read each servo's Present Position. Raises the same errors as `Servo.read`."""
    return {drive: servo.read("Present Position") for drive, servo in bus.drives.items()}


def wait_for_rest(bus: ServoBus, longest: float = _LONGEST_REST_S) -> str:
    """Wait at most `longest` [s] for an arm that is still swinging or falling after an earlier run to come to rest.

    Returns a sentence naming a joint that is still moving after that time; "" if all are at rest. Raises BusShared if
    another program switches torque on in the meantime.
    """
    clock = bus.port.clock
    former, end = bus.read_positions(), clock.now() + longest
    while True:
        bus.wait_switched_off(clock.now() + _REST_EVERY_S)
        latest = bus.read_positions()
        away = [abs(now - before) for now, before in zip(latest, former, strict=True)]
        if max(away) < _REST_WITHIN_RAD:
            return ""
        if clock.now() >= end:
            return (
                f"{bus.joints[away.index(max(away))]} is still moving after {longest:.0f} s without torque: "
                f"{max(away):.3f} rad in {_REST_EVERY_S:g} s. Bring the arm to rest, then start again."
            )
        former = latest


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
