"""Scan a port for servos at every baud rate and ID, and report the state of each servo.

One broadcast ping per baud rate reaches all IDs at once: servos answer it in the order of their IDs.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from serial.tools import list_ports

from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import DriverError, PortLost, PortNotOpened
from hil.drivers.packet import BROADCAST_ID, MAX_ID, Framer, Instruction, encode
from hil.drivers.port import Port
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import Servo, describe_error
from hil.drivers.servo_model import BAUD_RATES, VOLTAGE_UNIT

_SLOT_S = 3e-3
"""Time slot per ID for the reply to a broadcast ping [s], the same as in dynamixel-sdk."""

_PATIENCE_S = _SLOT_S * (MAX_ID + 1)
_STATUS_BYTES = 14

_DIFFERENT = ("Present Position", "Realtime Tick")
"""Registers that hardly ever have the same value on two servos. If two servos have the same ID, equal replies look like
one reply, but different replies corrupt each other.
"""


TORQUE_ON = "torque on"
"""What is said of a servo whose torque is on, among other troubles."""


class Found(NamedTuple):
    """One servo that answered.

    model: None if no control table has this model number. voltage [V], temperature [degrees C]: None if they could
    not be read. trouble: description of problems; empty if there are none. left: sentences about what a killed run left
    on the servo; restore: the command that restores it (`session.leftovers.scan_with_leftovers`).
    """

    baud: int
    id: int
    model_number: int
    model: str | None
    firmware: int
    voltage: float | None
    temperature: float | None
    trouble: str
    left: str = ""
    restore: str = ""

    def with_trouble(self, *more: str) -> "Found":
        return self._replace(trouble="; ".join(filter(None, [self.trouble, *more])))


class Heard(NamedTuple):
    """The replies at one baud rate.

    baud: over TCP, the baud rate that the servos report or, if no servo answered, that of the port. trouble:
    description of a problem on the whole bus; empty if there is none.
    """

    baud: int
    servos: tuple[Found, ...]
    trouble: str


class Asking(NamedTuple):
    """A scan in progress: current baud rate, remaining time [s], and the servo that has just answered, if any.

    baud: None over TCP, where the other end sets it. servo: ID and model name, or "model number N".
    """

    baud: int | None
    left_s: float
    servo: tuple[int, str] | None = None


Watch = Callable[[Asking], None]


def serial_ports() -> list[tuple[str, str]]:
    """Device and description of every serial port on this machine to which hardware is connected."""
    return [(port.device, port.description) for port in list_ports.comports() if port.hwid != "n/a"]


def scan(port: Port, bauds: Sequence[int] = BAUD_RATES, watch: Watch = lambda _: None) -> Iterator[Heard]:
    """Scan at each baud rate in turn. Raises PortLost.

    Baud rates that the adapter does not support are reported as trouble. Over TCP, where the remote end sets the baud
    rate, servos are asked once, and each reports which baud rate it is set to. watch: called while waiting, and with
    each servo that answers. Nothing is written to a servo.
    """
    if not port.has_baud:
        heard = listen(port, watch=watch)
        yield _looked_at(port, heard._replace(baud=_set_to(port, heard.servos)))
        return
    for place, baud in enumerate(bauds):
        behind_s = sum(_listening_s(port, later) for later in bauds[place + 1 :])
        try:
            port.set_baud(baud)
        except PortNotOpened as error:
            yield Heard(baud, (), str(error))
            continue
        yield _looked_at(port, listen(port, watch=_with_more(behind_s, watch)))


def _set_to(port: Port, servos: Sequence[Found]) -> int:
    """Return the baud rate that these servos are set to, and adopt it for `port`, whose wire times depend on it."""
    if servos:
        port.set_baud(servos[0].baud)
    return port.baud


def _with_more(behind_s: float, watch: Watch) -> Watch:
    return lambda asking: watch(asking._replace(left_s=asking.left_s + behind_s))


def _listening_s(port: Port, baud: int) -> float:
    """Listening time at one baud rate [s] if no servo answers."""
    return _PATIENCE_S + port.latency + _STATUS_BYTES * 10 / baud


def listen(port: Port, patience: float = _PATIENCE_S, watch: Watch = lambda _: None) -> Heard:
    """Collect the replies to a broadcast ping within `patience` [s] at the port's current baud rate. Raises PortLost.

    watch: called while waiting, and with each servo that answers.
    """
    framer = Framer()
    answers = {}
    baud = port.baud if port.has_baud else None
    port.discard_input()
    port.write(encode(BROADCAST_ID, Instruction.PING))
    deadline = port.clock.now() + patience + port.latency + port.wire_time(_STATUS_BYTES)
    while (remaining := deadline - port.clock.now()) > 0:
        watch(Asking(baud, remaining))
        for packet in framer.feed(port.read(_STATUS_BYTES, min(remaining, 0.05))):
            if packet.is_status and len(packet.data) == 3:
                answers[packet.id] = packet.data
                deadline += port.wire_time(_STATUS_BYTES)
                number = packet.data[0] | packet.data[1] << 8
                model = model_names().get(number, f"model number {number}")
                watch(Asking(baud, deadline - port.clock.now(), (packet.id, model)))
    servos = tuple(_describe(port, servo_id, data) for servo_id, data in sorted(answers.items()))
    damaged = framer.bad_crc or framer.noise_bytes + framer.pending > _STATUS_BYTES
    return Heard(port.baud, servos, "corrupted replies: two servos with the same ID, or a bad cable" if damaged else "")


def _describe(port: Port, servo_id: int, data: bytes) -> Found:
    number, firmware = data[0] | data[1] << 8, data[2]
    model = model_names().get(number)
    if model is None:
        return Found(port.baud, servo_id, number, None, firmware, None, None, "no control table for this model")
    servo = Servo(port, servo_id, load_control_table(model))
    baud = port.baud
    try:
        if not port.has_baud:
            baud = BAUD_RATES[servo.read("Baud Rate")]
        voltage = VOLTAGE_UNIT * servo.read("Present Input Voltage")
        temperature = float(servo.read("Present Temperature"))
        error = servo.hardware_error()
        for register in _DIFFERENT:
            if register in servo.table:
                servo.read(register)
    except (DriverError, KeyError, IndexError) as problem:
        return Found(baud, servo_id, number, model, firmware, None, None, f"cannot be read: {problem}")
    trouble = f"hardware error: {describe_error(error)}; reboot it" if error else ""
    return Found(baud, servo_id, number, model, firmware, round(voltage, 1), temperature, trouble)


def _looked_at(port: Port, heard: Heard) -> Heard:
    """Add to each servo's trouble whether its torque is on and whether its watchdog has tripped. Raises PortLost."""
    return heard._replace(servos=tuple(_with_state(port, found) for found in heard.servos))


def _with_state(port: Port, found: Found) -> Found:
    if found.model is None or found.voltage is None:
        return found
    servo = Servo(port, found.id, load_control_table(found.model))
    try:
        troubles = list(_torque_troubles(servo))
    except PortLost:
        raise
    except DriverError as problem:
        troubles = [f"cannot be read: {problem}"]
    return found.with_trouble(*troubles)


def _torque_troubles(servo: Servo) -> Iterator[str]:
    if servo.read("Torque Enable"):
        yield TORQUE_ON
    if "Bus Watchdog" in servo.table and servo.read("Bus Watchdog") == WATCHDOG_TRIPPED:
        yield "watchdog tripped"
