"""Register values that rule out an experiment: checked at set-up, by `hil check`, and at the start of a run."""

from hil.drivers.servo import Servo

_TIME_BASED_PROFILE = 0x04
"""Bit of Drive Mode that only affects motion profiles, which current and PWM mode do not use."""

_POSITION_MODE = 3
_MOST_HOMING_TICKS = 1024
"""Largest Homing Offset [ticks] that Position Control Mode applies; it ignores larger ones (e-Manual, Homing Offset).
"""

APPLY_HOMING = (
    f"Position Control Mode ignores an offset beyond +-{_MOST_HOMING_TICKS} ticks, but current and PWM mode apply it, "
    "so the joint's angle would change when a run begins. With DYNAMIXEL Wizard 2.0, set Operating Mode to 4 (Extended "
    "Position), which applies it too, or clear Homing Offset; then determine zero_ticks again"
)
"""Text that explains an `ignored_homing` and how to correct it; the caller appends further words or the full stop."""


def unsuitable_drive_mode(servo: Servo) -> int | None:
    """Return Drive Mode if it reverses the servo or lets a goal switch torque on, otherwise None."""
    mode = servo.read("Drive Mode")
    return mode if mode & ~_TIME_BASED_PROFILE else None


def ignored_homing(servo: Servo) -> int:
    """Return Homing Offset [ticks] if the current Operating Mode ignores it, otherwise 0."""
    if servo.read("Operating Mode") != _POSITION_MODE:
        return 0
    offset = servo.read("Homing Offset")
    return offset if abs(offset) > _MOST_HOMING_TICKS else 0
