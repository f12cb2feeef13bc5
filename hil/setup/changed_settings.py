"""Settings that another program changed during a run: they explain motion that looks like a fault of the servo."""

from collections.abc import Mapping
from contextlib import suppress

from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.errors import Cause

__all__ = ["EXPLAINED", "Settings", "changed_settings", "settings_now"]

_REGISTERS = ("Operating Mode", "Drive Mode", "Homing Offset")

EXPLAINED = frozenset(
    {
        Cause.POSITION,
        Cause.VELOCITY,
        Cause.JUMP,
        Cause.NOT_FOLLOWING,
        Cause.OUT_OF_VOLTAGE,
        Cause.GOALS_CHANGED,
        Cause.FROZEN,
        Cause.UNEXPECTED,
        Cause.UNLIKE_BEFORE,
        Cause.WRONG_SIGN,
        Cause.EARLY_MOTION,
    }
)
"""Causes of a stop that such a change can explain."""

Settings = Mapping[tuple[Joint, str], int]


def settings_now(bus: ServoBus) -> Settings:
    """Read the settings that determine how servos move and what they report; servos that do not answer are left out."""
    found = {}
    for joint, servo in bus.drives.items():
        with suppress(DriverError):
            for register in _REGISTERS:
                if register in servo.table:
                    found[joint, register] = servo.read(register, attempts=1)
    return found


def changed_settings(before: Settings, after: Settings) -> str:
    """One sentence about the settings that differ; "" if there are none."""
    changed = [
        f"{joint}: {register} is {after[joint, register]} and was {value}"
        for (joint, register), value in before.items()
        if after.get((joint, register), value) != value
    ]
    if not changed:
        return ""
    return f"Another program changed the settings of a servo during the run ({'; '.join(changed)})."
