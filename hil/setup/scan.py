"""Which servos are on a port: every baud rate, every ID, and how each servo is.

One broadcast ping per baud rate: servos answer it in the order of their IDs, so all 253 are asked at once.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from serial.tools import list_ports

from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import DriverError, PortNotOpened
from hil.drivers.packet import BROADCAST_ID, MAX_ID, Framer, Instruction, encode
from hil.drivers.port import Port
from hil.drivers.servo import Servo, describe_error
from hil.drivers.servo_model import BAUD_RATES, VOLTAGE_UNIT

_SLOT_S = 3e-3
"""How long one ID may take to answer a broadcast ping; dynamixel-sdk allows the same."""

_PATIENCE_S = _SLOT_S * (MAX_ID + 1)
_STATUS_BYTES = 14


class Found(NamedTuple):
    """One servo that answered. model None: a number that no control table has. `trouble`: nothing where all is well.

    voltage: V. temperature: degrees C. Both None where they could not be read.
    """

    baud: int
    id: int
    model_number: int
    model: str | None
    firmware: int
    voltage: float | None
    temperature: float | None
    trouble: str


class Heard(NamedTuple):
    """One baud rate: who answered, and what is wrong there as a whole."""

    baud: int
    servos: tuple[Found, ...]
    trouble: str


class Asking(NamedTuple):
    """A scan in progress: the baud it is at, the time left [s], and the servo that has just answered, if it was one.

    servo: ID, and model or model number.
    """

    baud: int
    left_s: float
    servo: tuple[int, str] | None = None


Watch = Callable[[Asking], None]


def serial_ports() -> list[tuple[str, str]]:
    """Device and description of every serial port of this machine that has hardware behind it."""
    return [(port.device, port.description) for port in list_ports.comports() if port.hwid != "n/a"]


def scan(port: Port, bauds: Sequence[int] = BAUD_RATES, watch: Watch = lambda _: None) -> Iterator[Heard]:
    """Scan at each baud rate in turn; raises PortLost. watch: called while it waits, and with each servo that answers.

    Rates that the adapter cannot do are given with their trouble said. Over TCP, where the other end sets the baud,
    the first alone is tried.
    """
    if not port.has_baud:
        bauds = bauds[:1]
    for place, baud in enumerate(bauds):
        behind_s = sum(_listening_s(port, later) for later in bauds[place + 1 :])
        try:
            port.set_baud(baud)
        except PortNotOpened as error:
            yield Heard(baud, (), str(error))
            continue
        yield listen(port, watch=_with_more(behind_s, watch))


def _with_more(behind_s: float, watch: Watch) -> Watch:
    """The same watcher, told of the time beyond this baud too."""
    return lambda asking: watch(asking._replace(left_s=asking.left_s + behind_s))


def _listening_s(port: Port, baud: int) -> float:
    """How long one baud is listened to [s], as long as nobody answers."""
    return _PATIENCE_S + port.latency + _STATUS_BYTES * 10 / baud


def listen(port: Port, patience: float = _PATIENCE_S, watch: Watch = lambda _: None) -> Heard:
    """Who answers a broadcast ping at the port's present baud within `patience` [s]; raises PortLost.

    watch: called while it waits, and with each servo that answers.
    """
    framer = Framer()
    answers = {}
    port.discard_input()
    port.write(encode(BROADCAST_ID, Instruction.PING))
    deadline = port.clock.now() + patience + port.latency + port.wire_time(_STATUS_BYTES)
    while (remaining := deadline - port.clock.now()) > 0:
        watch(Asking(port.baud, remaining))
        for packet in framer.feed(port.read(_STATUS_BYTES, min(remaining, 0.05))):
            if packet.is_status and len(packet.data) == 3:
                answers[packet.id] = packet.data
                deadline += port.wire_time(_STATUS_BYTES)
                number = packet.data[0] | packet.data[1] << 8
                model = model_names().get(number, f"model number {number}")
                watch(Asking(port.baud, deadline - port.clock.now(), (packet.id, model)))
    servos = tuple(_describe(port, servo_id, data) for servo_id, data in sorted(answers.items()))
    damaged = framer.bad_crc or framer.noise_bytes + framer.pending > _STATUS_BYTES
    return Heard(port.baud, servos, "corrupted replies: two servos with the same ID, or a bad cable" if damaged else "")


def _describe(port: Port, servo_id: int, data: bytes) -> Found:
    number, firmware = data[0] | data[1] << 8, data[2]
    model = model_names().get(number)
    if model is None:
        return Found(port.baud, servo_id, number, None, firmware, None, None, "no control table for this model")
    servo = Servo(port, servo_id, load_control_table(model))
    try:
        voltage = VOLTAGE_UNIT * servo.read("Present Input Voltage")
        temperature = float(servo.read("Present Temperature"))
        error = servo.hardware_error()
    except (DriverError, KeyError) as problem:
        return Found(port.baud, servo_id, number, model, firmware, None, None, f"cannot be read: {problem}")
    trouble = f"hardware error: {describe_error(error)}; reboot it" if error else ""
    return Found(port.baud, servo_id, number, model, firmware, round(voltage, 1), temperature, trouble)
