"""Handling of torque that is already on at the start: either refuse to start, or let the arm sink slowly."""

from collections.abc import Iterable, Mapping

from hil.drivers.clock import Clock
from hil.drivers.errors import TorqueHeld
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode
from hil.drivers.torque.off import has_torque, signals_held_back

FADE_S = 1.0
"""Time over which a held servo's output limit is reduced to zero [s]."""

SINKING_S = 4.0
"""Maximum time for which joints may sink, braked by their motors, before torque is cut [s]."""

_STEPS = 20
_STILL_TICKS = 2  # Present Velocity below which a joint counts as still


def is_held(servo: Servo) -> bool:
    """Return whether the servo's torque is on and holds or drives its joint. Raises the errors of `Servo.read`.

    A tripped Bus Watchdog has zeroed the goal, so that in current and PWM mode the joint moves freely. Torque Enable is
    read twice, because a reply does not identify its register.
    """
    if not (servo.read("Torque Enable") and servo.read("Torque Enable")):
        return False
    tripped = servo.read("Bus Watchdog") == WATCHDOG_TRIPPED
    return not (tripped and servo.read("Operating Mode") in (Mode.CURRENT, Mode.PWM))


def refuse_held(servos: Mapping[Joint, Servo]) -> None:
    """Raise TorqueHeld if any joint is held. Also raises the errors of `Servo.read`."""
    held = [joint for joint, servo in servos.items() if is_held(servo)]
    if held:
        raise TorqueHeld(
            f"{' and '.join(joint.title for joint in held)}: torque is on, so another program is driving or holding "
            "the arm, or has left torque on. Switching it off would let the arm fall, so nothing was written. Stop "
            "that program, or hold the arm by hand and take it over with --take-over (BusConfig.take_over), which lets "
            "it sink slowly."
        )


def switched_on(servos: Mapping[Joint, Servo]) -> str:
    """Describe the servos with torque on and their currents; "" if none. Raises the errors of `Servo.read`."""
    on = [servo for servo in servos.values() if servo.read("Torque Enable") and has_torque(servo)]
    return " and ".join(f"{servo.title}{_current(joint, servo)}" for joint, servo in servos.items() if servo in on)


def _current(joint: Joint, servo: Servo) -> str:
    if joint.servo.current_unit is None:
        return ""
    return f" (Present Current {servo.read('Present Current') * joint.servo.current_unit:.3f} A)"


def let_sink(servos: Mapping[Joint, Servo], clock: Clock) -> None:
    """Ramp the output of held servos down to zero, wait until the joints no longer sink, then cut torque and restore
    the goals that limited their output.

    With zero PWM and torque on, the motor's terminals are shorted, so it brakes. Raises the errors of `Servo.write`; if
    an exception ends the sinking early, a note added to it lists the goals that remain lowered, since restoring them
    with torque on would jerk the arm back up.
    """
    held = [servo for servo in servos.values() if is_held(servo)]
    names = [_what_drives(servo) for servo in held]
    goals = [(servo, name, servo.read(name)) for servo, name in zip(held, names, strict=True)]
    is_lowered = False
    try:
        for step in range(1, _STEPS + 1):
            clock.wait_until(clock.now() + FADE_S / _STEPS)
            for servo, name, begun in goals:
                is_lowered = True
                servo.write(name, round(begun * (1 - step / _STEPS)))
        until = clock.now() + SINKING_S
        while held and clock.now() < until:
            clock.wait_until(clock.now() + 0.1)
            if all(abs(servo.read("Present Velocity")) <= _STILL_TICKS for servo in held):
                break
    except BaseException as ended:
        if is_lowered:
            ended.add_note(_lowered(goals))
        raise
    with signals_held_back():
        for servo in held:
            servo.write("Torque Enable", 0)
        for servo, name, begun in goals:
            servo.write(name, begun)


def _lowered(goals: Iterable[tuple[Servo, str, int]]) -> str:
    listed = ", ".join(f"{name} of ID {servo.id}, which was {begun}" for servo, name, begun in goals)
    return (
        f"The arm was being lowered slowly and has been left with a reduced {listed}. Hold the arm by hand, switch "
        "its torque off and set this again with DYNAMIXEL Wizard 2.0, or start again with --take-over."
    )


def _what_drives(servo: Servo) -> str:
    """Return the name of the goal that limits the motor's output in the servo's present mode."""
    return "Goal Current" if servo.read("Operating Mode") == Mode.CURRENT else "Goal PWM"
