"""Attacks on the servos, their motors and the program itself rather than on bytes."""

import os
import resource
import signal
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from benchmarks.fault_campaign.attack import ON_MOTORS, Attack, Kind
from benchmarks.fault_campaign.witness import Witness
from hil.drivers.packet import Instruction, encode
from hil.fakes.servo.backup import RESET_ALL, factory_reset
from hil.fakes.servo.servo import EmulatedServo

if TYPE_CHECKING:
    from benchmarks.fault_campaign.middle import Middle

Undo = Callable[[], None]

_ELSEWHERE_ID = 200
_SLOWEST_REPLY = 254  # Return Delay Time
_ROOM_BYTES = 1 << 12  # a file may grow to this once the disk is full
_WRAP_S = 32.768
_SHORT_BOOT_S = 5e-3
_POSITION_MODE = 3
_OF_THE_MOMENT = ("Torque Enable", "Hardware Error Status", "Registered Instruction")


class Killed(BaseException):
    """The program was killed: anything that it still writes to this port is discarded."""


def prepare(attack: Attack, port: "Middle") -> None:
    """Prepare the plant for attacks that must be set up before the program starts."""
    if attack.kind in ON_MOTORS:
        witness = port.bus.plant
        assert isinstance(witness, Witness)
        for joint, servo in enumerate(port.bus._servos):
            if attack.concerns(servo.id):
                witness.disturb(joint, attack)
    elif attack.kind == Kind.CLOCK_WRAP:
        for servo in port.bus._servos:
            if attack.concerns(servo.id):
                servo.present._booted_at -= _WRAP_S - attack.start % _WRAP_S


def happen(attack: Attack, port: "Middle") -> list[Undo]:
    """Execute an attack that happens once; return functions that undo its changes."""
    match attack.kind:
        case Kind.SIGINT | Kind.SIGTERM | Kind.SIGHUP:
            os.kill(os.getpid(), signal.Signals[attack.kind])
        case Kind.KILLED:
            port.dead = True
            raise Killed
        case Kind.STALL | Kind.SUSPENDED:
            port.stand_still(attack.amount)
        case Kind.DISK_FULL:
            return [_fill_disk()]
        case Kind.CLOCK_SET:
            return [_set_clock(attack.amount)]
        case Kind.SHADOWED:
            return _shadow(attack, port.bus._servos)
        case Kind.IDS_SWAPPED if len(port.bus._servos) == 2:
            first, second = port.bus._servos
            ids = first.id, second.id
            for servo in (first, second):  # with torque on, a servo would refuse the new ID
                servo.write(64, b"\x00")
            return [_change(first, "ID", ids[1]), _change(second, "ID", ids[0])]
        case _:
            return [
                undo
                for servo in port.bus._servos
                if attack.concerns(servo.id) and (undo := _touch(attack, servo, port.clock.now())) is not None
            ]
    return []


def overwrite_goals(attack: Attack, port: "Middle") -> None:
    """Write a different goal, as a second master would if it sent its own command after each of the program's."""
    for servo in port.bus._servos:
        if attack.concerns(servo.id) and servo.torque_enabled:
            address, goal = _write_goal(attack, servo)
            if attack.kind == Kind.RIVAL:  # the program hears it as well
                said = encode(servo.id, Instruction.WRITE, address.to_bytes(2, "little") + goal)
                wire = port.bus._wire
                wire.put(said, max(port.bus.advanced_to, wire.reply_by))  # in turn, not at the same time


def _write_goal(attack: Attack, servo: EmulatedServo) -> tuple[int, bytes]:
    address, limit = (102, "Current Limit") if servo.operating_mode == 0 else (100, "PWM Limit")
    goal = round(attack.amount * servo.value(limit)) if limit in servo.memory else 0
    data = goal.to_bytes(2, "little", signed=True)
    servo.write(address, data)
    return address, data


def _touch(attack: Attack, servo: EmulatedServo, now: float) -> Undo | None:
    match attack.kind:
        case Kind.TORQUE_TAKEN:
            servo.write(64, b"\x00")
        case Kind.WATCHDOG_TRIPPED if servo.torque_enabled:
            servo.trip_watchdog()
        case Kind.STRANGE_GOAL:
            return _leave_goal(attack, servo)
        case Kind.MODE_TAKEN if servo.torque_enabled:
            for address, value in ((64, 0), (11, _POSITION_MODE), (64, 1)):
                servo.write(address, bytes((value,)))
            return partial(_let_go, servo)
        case Kind.TURNED_ROUND:
            undo = _change(servo, "Drive Mode", servo.value("Drive Mode") ^ 1)
            servo.reboot(now, _SHORT_BOOT_S)  # with torque on, Drive Mode could not be written
            return undo
        case Kind.FACTORY_RESET:
            return _reset(servo, now)
        case Kind.CLOCK_RATE:
            servo.present._clock_rate *= 1.0 + attack.amount
        case _:
            return _reconfigure(attack, servo)
    return None


def _leave_goal(attack: Attack, servo: EmulatedServo) -> Undo | None:
    """Write a goal once. If torque is already off, the program may have ended with this servo, so it is not blamed if
    the goal remains.
    """
    is_off, name = not servo.torque_enabled, "Goal Current" if servo.operating_mode == 0 else "Goal PWM"
    before = servo.value(name) if name in servo.memory else 0
    _write_goal(attack, servo)
    return _change(servo, name, servo.value(name), before) if is_off and name in servo.memory else None


def _let_go(servo: EmulatedServo) -> None:
    """Switch off the torque of a servo that another program still holds, as that program would when it ends.

    Position mode is also the mode before the run, so it does not have to be undone.
    """
    if servo.operating_mode == _POSITION_MODE:
        servo.write(64, b"\x00")


def _reconfigure(attack: Attack, servo: EmulatedServo) -> Undo | None:
    """Change one register."""
    limit = "Current Limit" if "Current Limit" in servo.memory else "PWM Limit"
    match attack.kind:
        case Kind.WATCHDOG_OFF:
            _change(servo, "Bus Watchdog", 0)
        case Kind.WATCHDOG_LONG:
            return _change(servo, "Bus Watchdog", 127, 0)
        case Kind.ANSWERS_LESS:
            return _change(servo, "Status Return Level", round(attack.amount))
        case Kind.LOWERED_LIMIT:
            return _change(servo, limit, round(attack.amount * servo.value(limit)))
        case Kind.RAISED_LIMIT if limit == "Current Limit":
            # One tick less than the largest limit, because undoing the attack must not change a largest limit that the
            # user has set.
            return _change(servo, limit, min(2 * servo.value(limit), servo.model.registers[limit].maximum - 1))
        case Kind.THROTTLED if servo.operating_mode == 0 and "Goal PWM" in servo.memory:
            return _change(servo, "Goal PWM", round(attack.amount * servo.value("PWM Limit")))
        case Kind.HOMING_MOVED:
            return _change(servo, "Homing Offset", servo.value("Homing Offset") + round(attack.amount))
        case Kind.SLOW_REPLIES:
            return _change(servo, "Return Delay Time", _SLOWEST_REPLY)
        case Kind.NEW_ID:
            return _change(servo, "ID", _ELSEWHERE_ID)
        case Kind.NEW_BAUD:
            return _change(servo, "Baud Rate", 1)
    return None


def _change(servo: EmulatedServo, register: str, value: int, before: int | None = None) -> Undo:
    """Write a register as another program would; the program under test is not blamed if this value remains.

    before: value that undoing restores; by default, the present one.
    """
    before = servo.value(register) if before is None else before
    servo.memory.set(register, value)
    servo._derive()

    def undo() -> None:
        if servo.value(register) == value:
            servo.memory.set(register, before)
            servo._derive()

    return undo


def _reset(servo: EmulatedServo, now: float) -> Undo:
    """Factory-reset a servo including its ID and baud rate, as if a user had done so in another program."""
    before = {name: servo.memory.value(name) for name in servo.memory.registers}
    factory_reset(servo.memory, bytes((RESET_ALL,)))
    servo.reboot(now, _SHORT_BOOT_S)

    def undo() -> None:
        for name, value in before.items():
            if name not in _OF_THE_MOMENT:
                servo.memory.set(name, value)
        servo._derive()

    return undo


def _shadow(attack: Attack, servos: Sequence[EmulatedServo]) -> list[Undo]:
    """Make a servo also execute the instructions that are addressed to its neighbour."""
    return [
        _change(servo, "Secondary(Shadow) ID", servos[number - 1].id)
        for number, servo in enumerate(servos)
        if len(servos) > 1 and attack.concerns(servo.id) and "Secondary(Shadow) ID" in servo.memory
    ]


def _set_clock(seconds: float) -> Undo:
    """Change the computer's clock; the monotonic clock is not affected."""
    right = time.time

    def undo() -> None:
        time.time = right

    time.time = lambda: right() + seconds
    return undo


def _fill_disk() -> Undo:
    """Make writes fail as on a full disk, but only in this process, by limiting the size of files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (_ROOM_BYTES, hard))
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
