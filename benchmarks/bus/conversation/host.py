"""The host: it uses the wire and compares every answer with what the manual allows."""

from collections import Counter
from collections.abc import Iterable
from random import Random

from benchmarks.bus import codec
from benchmarks.bus.codec import Status, packet
from benchmarks.bus.conversation.servos import (
    ALERT,
    APART,
    DELAY,
    NUMBERS,
    QUIET_S,
    WATCHDOG,
    Servo,
    Still,
)
from benchmarks.bus.servo_rules import (
    BAUD,
    FINE,
    SERVO_ID,
    TABLES,
    Row,
    Rules,
)
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo


class Host:
    """A host and its servos. `differences` lists every answer that the manual does not allow."""

    def __init__(self, seed: int, models: Iterable[str] = ()) -> None:
        self.random = Random(seed)
        chosen = tuple(models) or self.random.choices(list(TABLES), k=self.random.randint(1, 4))
        ids = self.random.sample(range(250), len(chosen))
        self.differences: list[str] = []
        self.kinds: Counter[str] = Counter()
        self.servos: list[Servo] = []
        emulated = []
        for servo_id, model in zip(ids, chosen, strict=True):
            firmware = self.random.choice((42, 44, 45, 46, 48, 51, 52, 55))
            delay = self.random.choice((0, 0, 1, 50, 250, 254))
            rules = Rules(TABLES[model], {})
            rules.held |= {row.address: row.initial for row in TABLES[model] if row.initial is not None}
            rules.held |= {
                0: NUMBERS[model],
                6: firmware,
                SERVO_ID: servo_id,
                BAUD: 3,
                DELAY: delay,
                70: 0,
                WATCHDOG: 0,
            }
            self.servos.append(Servo(model, firmware, rules))
            known = load_model(model, firmware)
            emulated.append(EmulatedServo(known, servo_id, firmware=firmware, return_delay_us=2 * delay))
        self.clock = VirtualClock()
        self.bus = FakeBus(emulated, Still(len(emulated)), self.clock)

    # The wire

    def send(self, raw: bytes, wait: float = QUIET_S) -> bytes:
        """Send bytes; return everything that arrives before the line falls silent."""
        self.bus.write(raw)
        return self.bus.read(10_000, wait + 10 * len(raw) / self.bus.baud)

    def pause(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now() + seconds)

    def differ(self, what: str, got: object) -> None:
        self.differences.append(f"{what}: {got}")

    def ask(self, what: str, raw: bytes, wanted: list[tuple[Servo, set[int]]], ids: Iterable[int] = ()) -> list[Status]:
        """Send a packet; compare the status packets with `wanted`: the senders, each with its allowed errors.

        ids: other IDs with which the senders may answer if the manual does not specify the ID.
        """
        self.kinds[what.split(" ", maxsplit=1)[0]] += 1
        told = "; ".join(f"{servo.model} v{servo.firmware} ID {servo.id}" for servo, _ in wanted) or "nobody"
        try:
            got = codec.statuses(self.send(raw))
        except codec.Wrong as wrong:
            self.differ(f"{what} [{told}]", wrong)
            return []
        right = len(got) == len(wanted) and all(
            (status.id == servo.id or status.id in ids)
            and status.error & 0x7F in errors
            and bool(status.error & ALERT) == servo.alert
            for status, (servo, errors) in zip(got, wanted, strict=True)
        )
        if not right:
            self.differ(f"{what}, allowed {[errors for _, errors in wanted]} [{told}]", got)
        return got if right else []

    # Who answers

    def named(self, servo_id: int) -> Servo | None:
        return next((servo for servo in self.servos if servo.id == servo_id), None)

    def any_servo(self) -> Servo:
        return self.random.choice(self.servos)

    def row(self, servo: Servo, *, writable: bool = True) -> Row:
        rows = [row for row in servo.rules.rows.values() if row.address not in APART]
        return self.random.choice([row for row in rows if row.low is not None or not writable])

    def value(self, row: Row) -> bytes:
        """A value for a register, usually within its range."""
        low, high = row.low or 0, row.high if row.high is not None else 1
        edges = (low, high, low - 1, high + 1, row.initial or 0)
        number = self.random.choice(edges) if self.random.random() < 0.5 else self.random.randint(low, high)
        return (number % (1 << 8 * row.size)).to_bytes(row.size, "little")

    def answers(self, servo: Servo, errors: set[int], least: int = 2) -> list[tuple[Servo, set[int]]]:
        """The expected answer, if the servo's Status Return Level is at least `least`; otherwise, no answer."""
        return [(servo, errors)] if servo.level >= least else []

    def settle(self, servo: Servo, addresses: Iterable[int]) -> None:
        """Read registers back, to check a write or to learn its outcome where the manual does not specify it."""
        for address in addresses:
            if (row := servo.rules.rows.get(address)) is not None:
                self.look(servo, row)

    def look(self, servo: Servo, row: Row) -> None:
        """Read one register and compare its value with the expected one."""
        body = row.address.to_bytes(2, "little") + row.size.to_bytes(2, "little")
        got = self.ask(f"read {row.address}", packet(servo.id, codec.READ, body), self.answers(servo, {FINE}, 1))
        if got:
            self.compare(servo, row, got[0].data, "read")

    def compare(self, servo: Servo, row: Row, data: bytes, how: str) -> None:
        wanted = servo.rules.expected(row.address)
        value = int.from_bytes(data, "little", signed=(row.low or 0) < 0)
        if len(data) != row.size or wanted not in (None, value):
            self.differ(f"{how} {row.address} of {servo.model} v{servo.firmware}, expected {wanted}", data.hex(" "))
        servo.rules.learn(row.address, value)
