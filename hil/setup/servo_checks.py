"""Check one servo: identity, settings left behind by a killed run, registers and pose. Torque stays off."""

from collections.abc import Callable, Iterator

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.control_table import model_names
from hil.drivers.errors import DriverError, NoReply, PortLost
from hil.drivers.joint import Joint
from hil.drivers.packet import MAX_ID, HardwareError
from hil.drivers.preparation.prepare import shuts_down
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED, arms_itself
from hil.drivers.preparation.unsuitable import APPLY_HOMING, ignored_homing, unsuitable_drive_mode
from hil.drivers.servo import Servo, describe_error
from hil.drivers.servo_model import BAUD_RATES, FULL_PWM_TICKS, RETURN_DELAY_UNIT, VOLTAGE_UNIT, Mode, with_article
from hil.rest_pose_hint import rest_pose_hint, within_limits
from hil.setup.finding import Finding, Level
from hil.setup.servo_settings import POWER_CYCLE
from hil.setup.session.killed_run import HalfLetDown, half_let_down, left_behind, recover_patiently
from hil.setup.session.leftovers import not_restored, taking_over
from hil.setup.session.settings_file import DamagedSettings

_WARM_BELOW_LIMIT_C = 15
_LONG_RETURN_DELAY_US = 20


def check_servo(config: Config, joint_config: JointConfig, joint: Joint, servo: Servo) -> Iterator[Finding]:
    """Check one servo; stop early if it does not answer or is of another model.

    Nothing is written except settings that an earlier program changed and did not restore.
    """
    where = str(joint)
    try:
        number = servo.ping()
    except NoReply:
        where_to_look = config.path if config.is_fake else config.port.url
        fix = f"Check supply and cable. `hil scan {where_to_look}` shows whether it has another ID or baud rate."
        yield Finding(Level.STOP, where, "answers", f"nothing at {config.port.baud} baud", fix)
        return
    except PortLost as error:
        yield Finding(Level.STOP, where, "port", "lost", str(error))
        return
    except DriverError as error:
        yield Finding(Level.STOP, where, "answers", "damaged", str(error))
        return
    if number != servo.table.number:
        found = model_names().get(number, f"model number {number}")
        yield Finding(Level.STOP, where, "model", f"a {found}", "Correct `model` or `id` in the configuration.")
        return
    yield Finding(Level.OK, where, "model", servo.table.model)
    yield from _left_behind(config, joint, servo)
    for look in (*_LOOKS, _pose):
        try:
            level, what, found, fix = look(config, joint_config, joint, servo)
        except PortLost as error:
            yield Finding(Level.STOP, where, "port", "lost", str(error))
            return
        except DriverError as error:
            fix = (
                f"{error} The servo answers pings: if it never answers reads, its Status Return Level is 0; "
                "power-cycle it to reset that level to 2."
            )
            yield Finding(Level.STOP, where, "registers", "cannot be read", fix)
            return
        yield Finding(level, where, what, found, fix)


def _left_behind(config: Config, joint: Joint, servo: Servo) -> Iterator[Finding]:
    """Restore settings that a killed run could not restore."""
    what = "settings from an earlier run"
    try:
        restored = recover_patiently(servo, config.url)
    except KeyboardInterrupt as stopped:
        stopped.add_note(not_restored(servo.port))
        raise
    except DamagedSettings as error:
        yield Finding(Level.STOP, str(joint), what, "cannot be read", str(error))
        return
    except DriverError as error:
        step = taking_over(config) if isinstance(error, HalfLetDown) else ""
        yield Finding(Level.STOP, str(joint), what, "cannot be restored", str(error), step)
        return
    if written := ", ".join(restored.written):
        yield Finding(Level.OK, str(joint), what, f"that run ended before restoring them; restored now: {written}")
    if restored.was_on:
        yield Finding(Level.OK, str(joint), "torque of an earlier run", "was still on; switched off now")
    if restored.others:
        yield Finding(
            Level.WARNING,
            str(joint),
            what,
            "not all of them are restored",
            restored.others[0].upper() + restored.others[1:],
        )


_Seen = tuple[Level, str, str, str]
_Look = Callable[[Config, JointConfig, Joint, Servo], _Seen]


def _graded(fine: bool, what: str, found: str, fix: str, otherwise: Level = Level.STOP) -> _Seen:
    return (Level.OK, what, found, "") if fine else (otherwise, what, found, fix)


def _firmware(_config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    firmware, needed = servo.read("Firmware Version"), joint.servo.watchdog_firmware
    fix = f"The Bus Watchdog needs firmware {needed} or newer: update the servo with DYNAMIXEL Wizard 2.0."
    return _graded(firmware >= needed, "firmware", str(firmware), fix)


def _status_level(_config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    level = servo.read("Status Return Level")
    fix = "Below 2, writes are not confirmed. Power-cycle the servo to reset it to 2."
    return _graded(level == 2, "status return level", str(level), fix)


def _hardware_error(_config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    error = servo.hardware_error()
    stays = "Its torque stays off until it is rebooted: find" if shuts_down(servo, error) else "Find"
    fix = f"{stays} the cause, then power-cycle it."
    return _graded(error == HardwareError(0), "hardware error", describe_error(error), fix)


def _torque(config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    torque = servo.read("Torque Enable")
    fix = "Another program is driving it: stop that program first, or power-cycle the servo."
    kept = left_behind(config.url, joint) if torque else None
    if kept is not None and half_let_down(kept, servo):
        fix = f"An earlier hil run left it on. Hold the arm by hand, then type: {taking_over(config)}"
    elif torque and servo.read("Bus Watchdog") == WATCHDOG_TRIPPED:
        fix = f"A program left it on when it ended, and the servo's watchdog has tripped. {POWER_CYCLE}"
    return _graded(torque == 0, "torque", "on" if torque else "off", fix)


def _drive_mode(config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    drive_mode = servo.read("Drive Mode")
    fix = (
        "0 is needed: bit 0 reverses the servo (use `direction = -1` instead), and bit 3 lets any goal switch torque "
        "on. Set it with DYNAMIXEL Wizard 2.0."
    )
    if drive_mode & 1:
        fix += (
            f" After that, `direction` and zero_ticks are no longer valid: determine them with {_finds_zeros(config)}."
        )
    return _graded(unsuitable_drive_mode(servo) is None, "drive mode", str(drive_mode), fix)


def _homing(config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    offset = ignored_homing(servo)
    found = f"{offset} ticks, ignored in this Operating Mode" if offset else "no hidden offset"
    return _graded(not offset, "homing offset", found, f"{APPLY_HOMING}, with {_finds_zeros(config)}.")


def _finds_zeros(config: Config) -> str:
    return "hil pose --guide" if config.is_chain else "hil init"


def _secondary_id(config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    secondary = servo.read("Secondary(Shadow) ID")
    others = {servo_id for each in config.joints for servo_id in each.ids} - {joint.id}
    none = secondary > MAX_ID
    fix = (
        f"It also obeys commands to that ID, except EEPROM writes. Type: hil setup {_port(config)} --id {joint.id} "
        "--secondary-id 255"
    )
    level = Level.STOP if secondary in others else Level.WARNING
    return _graded(none, "secondary ID", "none" if none else str(secondary), fix, level)


def _startup(_config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    armed = arms_itself(servo)
    fix = (
        "Startup Configuration switches its torque on at every power-up or reboot, even in the middle of a run. Set "
        "that register to 0 with DYNAMIXEL Wizard 2.0."
    )
    return _graded(not armed, "at power-up", "torque switches on by itself" if armed else "torque stays off", fix)


def _mode(_config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    mode = servo.read("Operating Mode")
    found = f"{mode}, as needed" if mode == joint.mode else f"{mode}; the experiment sets {joint.mode:d}"
    return Level.OK, "operating mode", found, ""


def _return_delay(config: Config, joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    delay_us = round(RETURN_DELAY_UNIT * 1e6) * servo.read("Return Delay Time")
    fix = f"It delays every reply. Type: hil setup {_port(config)} --id {joint_config.id} --return-delay-us 0"
    fine = delay_us <= _LONG_RETURN_DELAY_US
    return _graded(fine, "return delay", f"{delay_us} us", fix, Level.WARNING)


def _baud(config: Config, joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    value = servo.read("Baud Rate")
    found = str(BAUD_RATES[value]) if value < len(BAUD_RATES) else f"unknown value {value}"
    fix = (
        f"This baud rate is slow. Type: hil setup {_port(config)} --id {joint_config.id} --new-baud 1000000; then set "
        f"port.baud = 1000000"
    )
    return _graded(config.port.baud >= 1_000_000, "baud", found, fix, Level.WARNING)


def _share(joint_config: JointConfig) -> float:
    """Part of the joint's goal limit that one of its servos provides [A or V]."""
    return joint_config.goal_limit / len(joint_config.ids)


def _drive_limit(_config: Config, joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    if joint.mode is Mode.PWM:
        volts = VOLTAGE_UNIT * servo.read("Present Input Voltage") * servo.read("PWM Limit") / FULL_PWM_TICKS
        fix = f"Lower voltage_limit in the configuration, or raise the servo's PWM Limit (at most {FULL_PWM_TICKS})."
        return _graded(_share(joint_config) <= volts, "voltage limit", f"{volts:.1f} V at this supply", fix)
    amperes = servo.read("Current Limit") * abs(joint.drive_unit(0.0))
    fix = (
        f"The configuration's current_limit is {joint_config.goal_limit:g} A: lower it, or raise the servo's Current "
        "Limit with DYNAMIXEL Wizard 2.0."
    )
    return _graded(_share(joint_config) <= amperes, "current limit", f"{amperes:.3f} A", fix)


def _pwm_limit(_config: Config, joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    pwm = servo.read("PWM Limit")
    volts = VOLTAGE_UNIT * servo.read("Present Input Voltage") * pwm / FULL_PWM_TICKS
    share = _share(joint_config)
    needed = share * joint.servo.resistance if joint.mode is Mode.CURRENT else share
    found = f"{pwm} of {FULL_PWM_TICKS}, {volts:.1f} V at this supply"
    fix = (
        f"It limits the voltage in every mode. current_limit = {joint_config.goal_limit:g} needs {needed:.1f} V at "
        "rest and more at speed: raise PWM Limit with DYNAMIXEL Wizard 2.0, or lower current_limit."
    )
    if volts < needed:
        return Level.STOP, "PWM limit", found, fix
    return _graded(pwm >= FULL_PWM_TICKS, "PWM limit", found, fix, Level.WARNING)


def _shutdown(_config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    mask = HardwareError(servo.read("Shutdown"))
    wanted = HardwareError.OVERHEATING | HardwareError.OVERLOAD
    fix = (
        "It should shut down on overheating and overload: set Shutdown to its factory value with DYNAMIXEL Wizard 2.0."
    )
    return _graded(wanted in mask, "shuts down on", describe_error(mask), fix, Level.WARNING)


def _voltage(config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    voltage, low, high = (
        VOLTAGE_UNIT * servo.read(name) for name in ("Present Input Voltage", "Min Voltage Limit", "Max Voltage Limit")
    )
    found = f"{voltage:.1f} V ({low:.1f} to {high:.1f})"
    if voltage < config.safety.min_voltage:
        fix = (
            f"Switch the supply on: {with_article(joint.servo.name)} needs {config.safety.min_voltage:g} V "
            "(safety.min_voltage)."
        )
        return Level.STOP, "voltage", found, fix
    return _graded(low <= voltage <= high, "voltage", found, "Fix the supply: the servo shuts down outside its limits.")


def _temperature(_config: Config, _joint_config: JointConfig, _joint: Joint, servo: Servo) -> _Seen:
    heat, limit = servo.read("Present Temperature"), servo.read("Temperature Limit")
    found = f"{heat} C (limit {limit})"
    if heat >= limit:
        return Level.STOP, "temperature", found, "Let it cool down."
    fix = "Near its limit: let it cool down, or lower experiment.peak_torque."
    return _graded(heat < limit - _WARM_BELOW_LIMIT_C, "temperature", found, fix, Level.WARNING)


def _pose(config: Config, _joint_config: JointConfig, joint: Joint, servo: Servo) -> _Seen:
    ticks = servo.read("Present Position")
    index = [joint.id in each.ids for each in config.joints].index(True)
    if joint.id != config.joints[index].id:
        found = f"read from servo ID {config.joints[index].id}; this servo's direction shows only when the joint moves"
        return Level.OK, "pose", found, ""
    angle = within_limits(joint.within_turn(ticks).angle(ticks), config.joints[index].position_limit)
    rest = config.arm.rest_pose[index]
    zero = joint.zero_ticks + round((angle - rest) / joint.position_unit)
    fix = f"arm.rest_pose is {rest:.3f} rad; arm.rest_tolerance allows +-{config.rest_tolerance:g}. " + rest_pose_hint(
        angle, rest, config.rest_tolerance, zero
    )
    return _graded(abs(angle - rest) <= config.rest_tolerance, "pose", f"{angle:+.3f} rad", fix)


_LOOKS: tuple[_Look, ...] = (
    _firmware,
    _status_level,
    _hardware_error,
    _torque,
    _drive_mode,
    _homing,
    _secondary_id,
    _mode,
    _baud,
    _return_delay,
    _startup,
    _drive_limit,
    _pwm_limit,
    _shutdown,
    _voltage,
    _temperature,
)


def _port(config: Config) -> str:
    return str(config.path) if config.is_fake else config.port.url
