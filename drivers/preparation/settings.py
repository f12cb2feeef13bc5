"""Servo settings: the registers that an experiment changes, and those that the servo itself changes as a consequence.

Operating Mode and Current Limit are in EEPROM: they survive a power cycle. If they were not restored, another program
that only sets Torque Enable would drive the motor in the wrong mode at full current. A change of Operating Mode resets
goals and gains (ROBOTIS e-Manual, Operating Mode). Goal Position is left out: a servo sets it to its present position
when torque is switched on, and an old value must never move an arm.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress

from hil.drivers.control_table import Register
from hil.drivers.errors import DriverError, InconsistentReplies, ServoRefused, TorqueDoubted, WrongReply, WrongSetting
from hil.drivers.packet import StatusError
from hil.drivers.servo import Servo

STATUS_LEVEL = "Status Return Level"
SECONDARY_ID = "Secondary(Shadow) ID"

PROTECTIVE = (
    "Shutdown",
    "Temperature Limit",
    "Max Voltage Limit",
    "Min Voltage Limit",
    "Velocity Limit",
    "Max Position Limit",
    "Min Position Limit",
    "PWM Slope",
    SECONDARY_ID,
)
"""EEPROM registers that determine when a servo protects itself and which IDs it obeys. An experiment does not set them,
but restores them if another program has changed them.

Other writable EEPROM registers are not restored:
- PWM Limit, Drive Mode, Homing Offset, Return Delay Time: the user may have wanted the change, and undoing it unasked
  would change what angles and goals mean. The change is reported, together with the former value.
- ID, Baud Rate, Protocol Type: after a change, the servo no longer answers; the guard reports this.
- Startup Configuration: the SDK's tables lack it; the next start refuses a servo that switches its torque on by itself.
- Moving Threshold, External Port Mode: they affect neither the motion nor the replies that this program uses.
"""

EEPROM = ("Current Limit", "Operating Mode", *PROTECTIVE)
"""EEPROM registers to restore, in this order: a change of Operating Mode sets Goal Current to Current Limit. Most
servos held that value before, so usually no goal has to be written.
"""

# Not restored: LED, which has no effect; Torque Enable, which is set to 0; Goal Position (see above).
_GAINS = (
    "Velocity I Gain",
    "Velocity P Gain",
    "Position D Gain",
    "Position I Gain",
    "Position P Gain",
    "Feedforward 2nd Gain",
    "Feedforward 1st Gain",
    "Profile Acceleration",
    "Profile Velocity",
)
_GOALS = ("Goal PWM", "Goal Current", "Goal Velocity")

RAM = (STATUS_LEVEL, *_GAINS, *_GOALS)
"""Registers in RAM to restore. Status Return Level comes first, so that the other writes are confirmed; goals come
last, once the mode and the limits that they belong to have been restored.
"""

LIMIT_OF_GOAL = {
    "Goal PWM": "PWM Limit",
    "Goal Current": "Current Limit",
    "Goal Velocity": "Velocity Limit",
    "Profile Velocity": "Velocity Limit",
}
"""The EEPROM limit of each goal: a servo refuses larger goals."""

STARTUP_CONFIGURATION = Register("Startup Configuration", 60, 1)
"""A register missing from the SDK's tables. After power-up or reboot, bit 0 switches torque on and bit 1 restores
RAM registers.
"""

TORQUE_ON_AT_STARTUP = 0x01
WATCHDOG_TRIPPED = 0xFF


def read_settings(servo: Servo) -> dict[str, int]:
    """Return the registers that an experiment may change, by name [ticks]. Raises the errors of `Servo.read`.

    All are read twice, the second time in reverse order, because a reply does not identify its register: a reply to an
    earlier request could be stored, and later restored, as the value of another register.
    """
    names = [name for name in (*EEPROM, *RAM) if name in servo.table]
    settings = {name: servo.read(name) for name in names}
    for name in reversed(names):
        if (again := servo.read(name)) != settings[name]:
            raise WrongReply(
                f"{servo.title}: {name} reads {settings[name]}, then {again}: its replies are late or repeated and "
                "belong to earlier requests, or another program is changing its settings. Check the adapter, and close "
                "other programs that use this port."
            )
    watchdog = servo.read("Bus Watchdog")
    # A tripped watchdog can only be cleared, which switches it off.
    settings["Bus Watchdog"] = 0 if watchdog == WATCHDOG_TRIPPED else watchdog
    return settings


def attainable(servo: Servo, settings: Mapping[str, int]) -> dict[str, int]:
    """Return the settings with goals clamped to the limits, since another program may have lowered the limits.

    A limit that is itself in `settings` is restored before its goal; otherwise, the servo's present limit applies.
    Raises the errors of `Servo.read`.
    """
    cut = dict(settings)
    for goal, limit in LIMIT_OF_GOAL.items():
        if goal in settings and goal in servo.table and limit in servo.table:
            most = settings[limit] if limit in settings else servo.read_despite_error(limit)
            cut[goal] = max(-most, min(settings[goal], most))
    return cut


def cut_goals(servo: Servo, settings: Mapping[str, int]) -> dict[str, int]:
    """Return the goals that the limits keep from being restored, each clamped. Raises the errors of `Servo.read`."""
    return {name: value for name, value in attainable(servo, settings).items() if value != settings[name]}


def put_back(servo: Servo, settings: Mapping[str, int]) -> dict[str, tuple[int, int]]:
    """Restore the registers that differ from `settings`; return their old and new values by name.

    Goals are restored as far as the servo's limits allow (`attainable`), and only if torque is still off and the mode
    and the limits have been restored: in current mode, the former goal of a position-controlled servo would mean full
    torque. The Bus Watchdog is not cleared before the mode and limits have been restored, since it may be the only
    thing that stops the motor. Each register is read back.

    Raises WrongSetting if torque is on, and TorqueDoubted if EEPROM is locked although torque reads back as off. Raises
    the errors of `Servo.write` only after all other registers have been tried; the error's `in_doubt` and message then
    name the registers that failed.
    """
    _refuse_torque(servo)
    settings = attainable(servo, settings)
    written: dict[str, tuple[int, int]] = {}
    failures: dict[str, DriverError] = {}
    _restore(servo, settings, (STATUS_LEVEL, *EEPROM), written, failures)
    if any(isinstance(each, ServoRefused) and each.code == StatusError.ACCESS for each in failures.values()):
        raise _doubted(servo, failures)
    _restore(servo, settings, _GAINS, written, failures)
    goals = (*_GOALS, "Bus Watchdog")
    if reasons := [failures[name] for name in ("Operating Mode", "Current Limit") if name in failures]:
        failures |= dict.fromkeys(_differing(servo, settings, goals), reasons[0])
    else:
        _refuse_torque(servo)
        _restore(servo, {"Bus Watchdog": 0}, ("Bus Watchdog",), written, failures)  # tripped, it locks the goals
        _restore(servo, settings, goals, written, failures)
    if failures:
        failed = next(iter(failures.values()))
        if len(failures) < len(RAM):  # otherwise the servo is probably not connected
            failed.in_doubt = tuple(failures)
            failed.args = (f"{failed} Only {', '.join(failures)} may differ; all other settings are as before.",)
        raise failed
    return written


def _differing(servo: Servo, settings: Mapping[str, int], names: Iterable[str]) -> list[str]:
    """Return the registers among `names` that differ from `settings` or cannot be read."""
    differing = []
    for name in names:
        if name in settings and name in servo.table:
            with suppress(DriverError):
                if servo.read_despite_error(name) == settings[name]:
                    continue
            differing.append(name)
    return differing


def _refuse_torque(servo: Servo) -> None:
    if servo.read_despite_error("Torque Enable") and servo.read_surely("Torque Enable"):
        raise WrongSetting(f"{servo.title}: its settings cannot be restored while its torque is on.")


def _doubted(servo: Servo, failures: Mapping[str, DriverError]) -> TorqueDoubted:
    """Arm the Bus Watchdog of a servo that locks its EEPROM, so that the servo stops once the bus is silent. A watchdog
    that has already tripped is left as it is. Return the error to raise.
    """
    with suppress(DriverError):
        if servo.read_despite_error("Bus Watchdog") != WATCHDOG_TRIPPED:
            servo.write_despite_error("Bus Watchdog", 1)
    return TorqueDoubted(
        f"{servo.title}: its Torque Enable reads 0, but it refuses to change {' and '.join(failures)}, as servos do "
        "only with torque on."
    )


def _restore(
    servo: Servo,
    settings: Mapping[str, int],
    names: Iterable[str],
    written: dict[str, tuple[int, int]],
    failures: dict[str, DriverError],
) -> None:
    """Write the registers among `names` that differ; add old and new values to `written`, and errors to `failures`."""
    for name in names:
        if name not in settings or name not in servo.table or name in failures:
            continue
        try:
            present: int | None = servo.read_despite_error(name)
            if present != settings[name] and name in EEPROM:
                present = _surely(servo, name)
            if present != settings[name]:
                servo.write_despite_error(name, settings[name])
                if present is not None:
                    written[name] = present, settings[name]
        except DriverError as error:
            failures[name] = error


def _surely(servo: Servo, name: str) -> int | None:
    """Read a register twice and return its value. If the readings disagree, return None for a register that this
    program writes, and raise InconsistentReplies for one that only another program can have changed.
    """
    try:
        return servo.read_surely(name)
    except InconsistentReplies:
        if name in PROTECTIVE:
            raise
        return None


def unlike(servo: Servo, settings: Mapping[str, int]) -> tuple[str, int, int] | None:
    """Find a register that determines how a servo moves (EEPROM, a goal or the Bus Watchdog) and differs from
    `settings`.

    Return its name, its value, and its value in `settings`; None if there is no such register. Registers are read in
    the reverse order of `put_back`, so that replies that lag behind their requests cannot match both times. Raises the
    errors of `Servo.read`.
    """
    wanted = attainable(servo, settings)
    for name in reversed((*EEPROM, *LIMIT_OF_GOAL, "Bus Watchdog")):
        if name not in wanted or name not in servo.table or servo.read_despite_error(name) == wanted[name]:
            continue
        if (now := servo.read_surely(name)) != wanted[name]:
            return name, now, wanted[name]
    return None


def arms_itself(servo: Servo) -> bool:
    """Return whether the servo itself switches torque on at power-up or reboot. Raises the errors of `Servo.read`."""
    with suppress(DriverError):
        return bool(servo.read_entry(STARTUP_CONFIGURATION) & TORQUE_ON_AT_STARTUP)
    return False  # older firmware has no such register
