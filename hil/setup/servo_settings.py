"""Configure one servo: ID, baud rate, return delay. Every EEPROM write must be confirmed first, and is read back
afterwards.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import NoReply, ServoRefused, WrongModel, WrongReply, WrongSetting
from hil.drivers.port import Port
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import Servo
from hil.drivers.servo_model import BAUD_RATES

Confirm = Callable[[str], bool]

RETURN_DELAY_UNIT_US = 2
_ATTEMPTS = 3
POWER_CYCLE = (
    "Power-cycle the servo. Its Operating Mode and limits stay as that program set them: check them with DYNAMIXEL "
    "Wizard 2.0."
)
"""What to do if a terminated program left torque on and the servo's former settings are not on file."""

_PING_ONLY = load_control_table("XM430-W350")
# Model Number, ID and similar registers have the same addresses in every X-series table.


class Change(NamedTuple):
    """A register change: old and requested values in `unit`, and whether it was written (and read back) or declined."""

    register: str
    before: int
    after: int
    written: bool
    unit: str = ""


def open_servo(port: Port, servo_id: int) -> Servo:
    """Open the servo with this ID, whatever its model. Raises NoReply, WrongModel, and WrongSetting if torque is on."""
    number = Servo(port, servo_id, _PING_ONLY, f"The servo with ID {servo_id}").ping()
    model = model_names().get(number)
    if model is None:
        raise WrongModel(
            f"The servo with ID {servo_id} has model number {number}, for which there is no control table."
        )
    servo = Servo(port, servo_id, load_control_table(model))
    if servo.read("Torque Enable"):
        fix = "Stop the program that is driving it, then try again."
        if servo.read("Bus Watchdog") == WATCHDOG_TRIPPED:
            fix = f"A program left it on when it ended, and the servo's watchdog has tripped. {POWER_CYCLE}"
        raise WrongSetting(f"{servo.title} has torque on, which locks its EEPROM. {fix}")
    return servo


def set_up(
    servo: Servo,
    confirm: Confirm,
    *,
    new_id: int | None = None,
    new_baud: int | None = None,
    return_delay_us: int | None = None,
    secondary_id: int | None = None,
) -> list[Change]:
    """Change the settings whose requested and current values differ, each after `confirm` has agreed.

    The port is left at the baud rate at which the servo was last heard. A status packet lost while the
    ID or the baud rate changes is not a failure: the servo is searched for at both the old and the new value.

    Raises ServoRefused if a register does not read back as written, WrongSetting if the new ID is taken, and the
    errors of `Servo.read`.
    """
    changes: list[Change] = []
    try:
        if return_delay_us is not None:
            changes.append(_set_return_delay(servo, confirm, return_delay_us))
        if secondary_id is not None:
            changes.append(_set_secondary_id(servo, confirm, secondary_id))
        if new_id is not None:
            change, servo = _set_id(servo, confirm, new_id)
            changes.append(change)
        if new_baud is not None:
            changes.append(_set_baud(servo, confirm, new_baud))
    except BaseException as ended:
        if done := [f"{each.register} from {each.before} to {each.after}" for each in changes if each.written]:
            ended.add_note(f"Already changed: {', '.join(done)}.")
        raise
    return changes


def _set_return_delay(servo: Servo, confirm: Confirm, delay_us: int) -> Change:
    name = "Return Delay Time"
    before = servo.read(name) * RETURN_DELAY_UNIT_US
    written = before != delay_us and confirm(f"{servo.title}: change {name} from {before} us to {delay_us} us?")
    if written:
        servo.write(name, delay_us // RETURN_DELAY_UNIT_US)
    return Change(name, before, delay_us, written, "us")


def _set_secondary_id(servo: Servo, confirm: Confirm, secondary: int) -> Change:
    name = "Secondary(Shadow) ID"
    before = servo.read(name)
    written = before != secondary and confirm(f"{servo.title}: change its {name} from {before} to {secondary}?")
    if written:
        servo.write(name, secondary)
    return Change(name, before, secondary, written)


def _set_id(servo: Servo, confirm: Confirm, new_id: int) -> tuple[Change, Servo]:
    if new_id == servo.id:
        return Change("ID", new_id, new_id, False), servo
    renamed = Servo(servo.port, new_id, servo.table)
    if _answers(renamed):
        raise WrongSetting(
            f"ID {new_id} is taken: another servo answers there. Replies of two servos with the same ID would collide."
        )
    if not confirm(f"{servo.title}: change its ID from {servo.id} to {new_id}?"):
        return Change("ID", servo.id, new_id, False), servo
    for _ in range(_ATTEMPTS):
        _write_blind(servo, "ID", new_id)
        if _answers(renamed):
            _verify(renamed, "ID", new_id)
            return Change("ID", servo.id, new_id, True), renamed
        if not _answers(servo):
            raise NoReply(
                f"{servo.title} was sent its new ID {new_id} but answers neither at that ID nor at ID {servo.id} "
                f"({servo.port.baud} baud on {servo.port.url}). Check its supply and its cable, then run `hil scan` "
                "to find it."
            )
    raise NoReply(
        f"{servo.title} still has its old ID {servo.id}: {_ATTEMPTS} attempts to change it to {new_id} failed."
    )


def _set_baud(servo: Servo, confirm: Confirm, baud: int) -> Change:
    name, port, former = "Baud Rate", servo.port, servo.port.baud
    before, after = servo.read(name), BAUD_RATES.index(baud)
    question = (
        f"{servo.title}: change its baud rate from {former} to {baud}? All servos on a bus must use the same one."
    )
    if before == after:
        return Change(name, baud, baud, False, "baud")
    # First check that the adapter supports this rate: otherwise the servo would become unreachable.
    port.set_baud(baud)
    try:
        taken = _answers(servo)
    finally:
        port.set_baud(former)
    if taken:
        raise WrongSetting(
            f"At {baud} baud another servo answers to ID {servo.id}. Two servos with the same ID reply at once: give "
            "one of them another ID first."
        )
    if not confirm(question):
        return Change(name, former, baud, False, "baud")
    for _ in range(_ATTEMPTS):
        _write_blind(servo, name, after)
        port.set_baud(baud)
        if _answers(servo):
            _verify(servo, name, after)
            return Change(name, former, baud, True, "baud")
        port.set_baud(former)
        if not _answers(servo):
            raise NoReply(
                f"{servo.title} was set from {former} to {baud} baud but answers at neither, on {port.url}. "
                "Check its supply and its cable, then run `hil scan` to find it."
            )
    raise NoReply(f"{servo.title} is still at {former} baud: {_ATTEMPTS} attempts to change it to {baud} failed.")


def _write_blind(servo: Servo, register: str, value: int) -> None:
    """Write a register whose status reply may be lost; the caller checks the outcome."""
    with suppress(NoReply, WrongReply):
        servo.write_only(register, value, attempts=1)


def _answers(servo: Servo) -> bool:
    try:
        servo.ping()
    except (NoReply, WrongReply):
        return False
    return True


def _verify(servo: Servo, register: str, value: int) -> None:
    actual = servo.read(register)
    if actual != value:
        raise ServoRefused(f"{servo.title}: {register} was written as {value} but reads back as {actual}.")
