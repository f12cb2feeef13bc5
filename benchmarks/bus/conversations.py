"""Random conversations with fake servos of every X model, byte by byte, each answer compared with the manual.

    python benchmarks/bus/conversations.py [--conversations N] [--seed S] [--json]

The host is `codec`, the expectation `servo_rules`; neither knows the fake's code. A conversation has one to four servos
with random models, IDs, firmware, Return Delay Time and Status Return Level, and some dozen random instructions:
single, broadcast and group ones, registered writes, resets, Clear, backups, Secondary IDs, changes of ID and baud rate,
stuffing, and packets that are damaged, cut short, surrounded by noise or nonsense. In virtual time.
"""

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bus import codec
from benchmarks.bus.codec import BROADCAST, Status, packet
from benchmarks.bus.servo_rules import (
    ACCESS,
    BAUD,
    CRC,
    DATA_LENGTH,
    DATA_LIMIT,
    DATA_RANGE,
    FINE,
    INSTRUCTION,
    RESULT_FAIL,
    SERVO_ID,
    TABLES,
    TORQUE_ENABLE,
    Row,
    Rules,
)
from benchmarks.machine import machine
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
NUMBERS = {
    **{"XM430-W350": 1020, "XM430-W210": 1030, "XH430-W350": 1000, "XH430-W210": 1010, "XD430-T350": 1001},
    **{"XD430-T210": 1011, "XW430-T333": 1270, "XM540-W270": 1120, "XM540-W150": 1130, "XH540-W270": 1100},
    **{"XH540-W150": 1110, "XD540-T270": 1101, "XD540-T150": 1111, "XW540-T260": 1170, "XW540-T140": 1180},
    **{"XL330-M288": 1200, "XL330-M077": 1190, "XC330-M181": 1230, "XC330-M288": 1240, "XC330-T181": 1210},
    **{"XC330-T288": 1220, "XL430-W250": 1060, "XC430-W150": 1070, "XC430-W240": 1080},
}
DELAY, SHADOW, LEVEL, WATCHDOG = 9, 12, 68, 98
APART = (SERVO_ID, BAUD, DELAY, SHADOW, 20, 31, 32, 34, LEVEL, WATCHDOG, 116)
"""Registers with instructions of their own below, and limits whose other values would shut a servo down."""
UNDEFINED = (15, 72, 94, 150)
NOBODY = 251
QUIET_S, BOOT_S, PAUSE_S = 0.02, 0.4, 2e-3
GOALS, KEPT_IN_BACKUP = (100, 102, 104, 116), (SERVO_ID, BAUD, TORQUE_ENABLE, WATCHDOG)
SPECIAL = b"\xff\xff\xfd"


class Still:
    """Joints that nothing moves."""

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.position = self.velocity = self.current = [0.0] * joints

    def advance(self, until: float, current: object) -> None:
        """Nothing moves."""


@dataclass
class Servo:
    """One servo as the manual describes it.

    backup: what its backup holds; None without one. alert: whether it has a hardware error. indirect: its indirect
    data.
    """

    model: str
    firmware: int
    rules: Rules
    backup: dict[int, int] | None = None
    alert: bool = False
    indirect: bytearray = field(default_factory=lambda: bytearray(20))

    @property
    def id(self) -> int:
        return self.rules.held[SERVO_ID]

    @property
    def level(self) -> int:
        """Status Return Level."""
        return self.rules.held[LEVEL]

    @property
    def shadow(self) -> int | None:
        """Secondary ID."""
        own = self.rules.held[SHADOW]
        return own if own <= 252 else None

    @property
    def is_330(self) -> bool:
        return "330" in self.model

    @property
    def has_fast_reads(self) -> bool:
        return self.firmware >= (46 if self.is_330 else 45)

    @property
    def indirect_data(self) -> int:
        return 208 if self.is_330 and self.firmware >= 52 else 224


class Conversation:
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
        """Send bytes; return everything that arrives until the line has been quiet."""
        self.bus.write(raw)
        return self.bus.read(10_000, wait + 10 * len(raw) / self.bus.baud)

    def pause(self, seconds: float) -> None:
        self.clock.wait_until(self.clock.now() + seconds)

    def differ(self, what: str, got: object) -> None:
        self.differences.append(f"{what}: {got}")

    def ask(self, what: str, raw: bytes, wanted: list[tuple[Servo, set[int]]], ids: Iterable[int] = ()) -> list[Status]:
        """Send a packet and compare the statuses with those wanted: sender, and the errors that the manual allows.

        ids: other IDs that the senders may give, where the manual does not say which.
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
        """A value for a register, mostly in range."""
        low, high = row.low or 0, row.high if row.high is not None else 1
        edges = (low, high, low - 1, high + 1, row.initial or 0)
        number = self.random.choice(edges) if self.random.random() < 0.5 else self.random.randint(low, high)
        return (number % (1 << 8 * row.size)).to_bytes(row.size, "little")

    def answers(self, servo: Servo, errors: set[int], least: int = 2) -> list[tuple[Servo, set[int]]]:
        """The servo's answer to an instruction that its Status Return Level lets it answer from `least` on."""
        return [(servo, errors)] if servo.level >= least else []

    def settle(self, servo: Servo, addresses: Iterable[int]) -> None:
        """Read registers back after a write whose outcome the manual leaves open, or to check it."""
        for address in addresses:
            if (row := servo.rules.rows.get(address)) is not None:
                self.look(servo, row)

    def look(self, servo: Servo, row: Row) -> None:
        """Read one register and compare it with what it must hold."""
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

    # Instructions to one servo

    def ping(self) -> None:
        servo_id = self.random.choice([*(servo.id for servo in self.servos), NOBODY])
        servo = self.named(servo_id)
        got = self.ask("ping", packet(servo_id, codec.PING), [(servo, {FINE})] if servo else [])
        for status in got:
            self.compare_ping(status)

    def found(self, servo: Servo) -> None:
        """Ping it: it must answer."""
        for status in self.ask("ping", packet(servo.id, codec.PING), [(servo, {FINE})]):
            self.compare_ping(status)

    def compare_ping(self, status: Status) -> None:
        servo = self.named(status.id)
        assert servo is not None
        wanted = NUMBERS[servo.model].to_bytes(2, "little") + bytes((servo.firmware,))
        if status.data != wanted:
            self.differ(f"ping of {servo.model}, expected {wanted.hex(' ')}", status.data.hex(" "))

    def ping_all(self) -> None:
        """All answer, here in the order of their IDs (the manual: "according to their arranged order")."""
        wanted = [(servo, {FINE}) for servo in sorted(self.servos, key=lambda servo: servo.id)]
        for status in self.ask("ping_all", packet(BROADCAST, codec.PING), wanted):
            self.compare_ping(status)

    def read(self) -> None:
        servo = self.any_servo()
        self.look(servo, self.row(servo, writable=False))

    def read_undefined(self) -> None:
        servo, address = self.any_servo(), self.random.choice(UNDEFINED)
        body = address.to_bytes(2, "little") + b"\1\0"
        self.ask(f"read_undefined {address}", packet(servo.id, codec.READ, body), self.answers(servo, {ACCESS}, 1))

    def read_span(self) -> None:
        """Neighbouring registers at once; bytes that no register defines may have any value, or be refused."""
        servo = self.any_servo()
        first, size = self.row(servo, writable=False).address, self.random.randint(1, 60)
        body = first.to_bytes(2, "little") + size.to_bytes(2, "little")
        got = self.ask(
            f"read_span {first} {size}", packet(servo.id, codec.READ, body), self.answers(servo, {FINE, ACCESS}, 1)
        )
        for row in servo.rules.rows.values() if got and got[0].error & 0x7F == FINE else ():
            begin = row.address - first
            if begin >= 0 and begin + row.size <= size:
                self.compare(servo, row, got[0].data[begin : begin + row.size], f"read_span {first} {size}")
        if got and got[0].error & 0x7F == FINE and len(got[0].data) != size:
            self.differ(f"read_span {first} {size}", got)

    def malformed(self) -> None:
        """Instructions with too few or too many parameters change nothing."""
        servo = self.any_servo()
        row = self.row(servo, writable=False)
        at = row.address.to_bytes(2, "little")
        instruction, body = self.random.choice(
            (
                *(
                    (codec.READ, at),
                    (codec.READ, at + b"\1"),
                    (codec.READ, at + b"\0\0"),
                    (codec.READ, at + b"\xff\xff"),
                ),
                *((codec.WRITE, b""), (codec.WRITE, at), (codec.WRITE, at[:1]), (codec.REG_WRITE, at)),
                *((codec.FACTORY_RESET, b""), (codec.FACTORY_RESET, b"\2\2"), (codec.BACKUP, b"\1CTR")),
                (codec.WRITE, b"\xf0\xff" + bytes(self.random.randint(1, 300))),
            )
        )
        least = 1 if instruction == codec.READ else 2
        raw = packet(servo.id, instruction, body)
        self.ask(f"malformed {instruction:#x} {body.hex(' ')}", raw, self.answers(servo, ERRORS, least))
        listed = bytes(each.id for each in self.servos)
        short = self.random.choice(
            (
                (codec.SYNC_READ, at),
                (codec.SYNC_WRITE, at + b"\4\0" + listed[:1] + b"\1"),
                (codec.BULK_WRITE, listed[:1] + at),
            )
        )
        self.ask("malformed group", packet(BROADCAST, *short), [])
        self.settle(servo, [row.address])

    def goal_position(self) -> None:
        """In position mode within its limits; the extended modes allow 256 turns either way."""
        servo = self.any_servo()
        held = servo.rules.held
        if held.get(WATCHDOG) or 48 not in held or 52 not in held or 11 not in held:
            return
        low, high = (held[52], held[48]) if held[11] == 3 else (-1_048_575, 1_048_575)
        goal = self.random.choice((low - 1, low, high, high + 1, self.random.randint(-2000, 6000)))
        may = {FINE} if low <= goal <= high else {DATA_RANGE, DATA_LIMIT}
        body = b"\x74\0" + goal.to_bytes(4, "little", signed=True)
        got = self.ask(
            f"goal_position {goal} of [{low}, {high}]", packet(servo.id, codec.WRITE, body), self.answers(servo, may)
        )
        if got and may == {FINE}:
            read = self.ask("read 116", packet(servo.id, codec.READ, b"\x74\0\4\0"), self.answers(servo, {FINE}, 1))
            if read and read[0].data != body[2:]:
                self.differ(f"goal_position {goal}", read)

    def watchdog(self) -> None:
        """It trips only with torque on and without packets, reads -1 then, refuses goals, and 0 ends that."""
        servo = self.any_servo()
        if servo.level < 2 or servo.alert:
            return
        on = self.random.random() < 0.7
        self._write(servo, TORQUE_ENABLE, bytes((on,)))
        units = self.random.randint(1, 10)
        self._write(servo, WATCHDOG, bytes((units,)))
        self.pause(0.02 * units + 0.03)
        got = self.ask("watchdog", packet(servo.id, codec.READ, b"\x62\0\1\0"), self.answers(servo, {FINE}, 1))
        if got and got[0].data[0] != (0xFF if on else units):
            self.differ(f"watchdog of {units} with torque {on}", got)
        if on:
            goal, size = self.random.choice(((100, 2), (104, 4), (116, 4)))
            self.ask(
                "watchdog goal",
                packet(servo.id, codec.WRITE, bytes((goal, 0)) + bytes(size)),
                self.answers(servo, ERRORS),
            )
            for address in (100, 102, 104, 108, 112):
                servo.rules.held.pop(address, None)
        servo.rules.held[WATCHDOG] = 0
        self.ask("watchdog end", packet(servo.id, codec.WRITE, bytes((WATCHDOG, 0, 0))), self.answers(servo, {FINE}))
        self.settle(servo, [WATCHDOG, TORQUE_ENABLE])

    def alarm(self) -> None:
        """A supply below Min Voltage Limit: every status has the alert; torque is off if Shutdown has that bit; only a
        reboot with the limit restored ends it.
        """
        servo = self.any_servo()
        held = servo.rules.held
        if held.get(TORQUE_ENABLE) or servo.level < 2 or servo.alert:
            return
        row = servo.rules.rows[34]
        assert row.high is not None
        before, shuts_down = held[34], servo.model.startswith("XL330")  # Shutdown: 53 there, otherwise 52
        servo.rules.write(34, row.high.to_bytes(2, "little"))
        raw = packet(servo.id, codec.WRITE, b"\x22\0" + row.high.to_bytes(2, "little"))
        self.kinds["alarm"] += 1
        self.send(raw)
        self.pause(0.05)
        servo.alert, held[70] = True, 1
        self.settle(servo, [70, 34])
        self.ask("alarm torque", packet(servo.id, codec.WRITE, b"\x40\0\1"), self.answers(servo, {FINE, *ERRORS}))
        held[TORQUE_ENABLE] = int(not shuts_down)
        self.settle(servo, [TORQUE_ENABLE])
        self._write(servo, TORQUE_ENABLE, b"\0")
        self._write(servo, 34, before.to_bytes(2, "little"))
        self.settle(servo, [70])
        servo.alert = False  # not in the status of the Reboot either: ROBOTIS' own clients would take it for a failure
        self.ask("reboot", packet(servo.id, codec.REBOOT), self.answers(servo, {FINE}))
        self._booted(servo)
        self.settle(servo, [70])

    def write(self) -> None:
        servo = self.any_servo()
        row = self.row(servo)
        data = self.value(row)
        self._write(servo, row.address, data)
        self.settle(servo, [row.address])

    def _write(self, servo: Servo, address: int, data: bytes) -> None:
        may = servo.rules.write(address, data)
        body = address.to_bytes(2, "little") + data
        self.ask(f"write {address} {data.hex(' ')}", packet(servo.id, codec.WRITE, body), self.answers(servo, may))

    def write_wrongly(self) -> None:
        """A read-only or undefined address, or too few bytes."""
        servo = self.any_servo()
        row = self.row(servo, writable=False)
        choice = self.random.randrange(3)
        if choice == 0:
            self._write(servo, self.random.choice(UNDEFINED), b"\0")
        elif choice == 1 and row.size > 1:
            self._write(servo, row.address, bytes(self.random.randint(1, row.size - 1)))
        elif row.low is None:
            self._write(servo, row.address, bytes(row.size))
        self.settle(servo, [row.address])

    def torque(self) -> None:
        servo = self.any_servo()
        self._write(servo, TORQUE_ENABLE, bytes((self.random.random() < 0.5,)))

    def reg_write(self) -> None:
        servo = self.any_servo()
        row = self.row(servo)
        data = self.value(row)
        may = servo.rules.reg_write(row.address, data)
        body = row.address.to_bytes(2, "little") + data
        got = self.ask(
            f"reg_write {row.address} {data.hex(' ')}",
            packet(servo.id, codec.REG_WRITE, body),
            self.answers(servo, may),
        )
        if FINE in may and len(may) > 1:
            if got and got[0].error & 0x7F == FINE:
                servo.rules.waiting = row.address, data
            elif not got:
                self._forget_waiting(servo)
        self.settle(servo, [row.address])
        self._registered(servo)

    def _forget_waiting(self, servo: Servo) -> None:
        """Empty the servo's registered instruction, since nothing was said of it."""
        may = servo.rules.action() | {FINE, INSTRUCTION}
        self.ask("action", packet(servo.id, codec.ACTION), self.answers(servo, may | set(range(1, 8))))
        servo.rules.waiting = None
        for address in list(servo.rules.held):
            if address not in (0, 6, SERVO_ID, BAUD, DELAY, SHADOW, LEVEL, WATCHDOG):
                del servo.rules.held[address]
        self.settle(servo, [TORQUE_ENABLE, 11])
        servo.rules.held.setdefault(TORQUE_ENABLE, 0)

    def _registered(self, servo: Servo) -> None:
        """Registered Instruction is 1 exactly while one waits."""
        got = self.ask("read 69", packet(servo.id, codec.READ, b"\x45\0\1\0"), self.answers(servo, {FINE}, 1))
        if got and got[0].data[0] != (servo.rules.waiting is not None):
            self.differ(f"Registered Instruction with {servo.rules.waiting}", got)

    def action(self) -> None:
        servo = self.any_servo()
        waiting = servo.rules.waiting
        may = {INSTRUCTION} if waiting is None else servo.rules.action() - {INSTRUCTION}
        self.ask(f"action {waiting}", packet(servo.id, codec.ACTION), self.answers(servo, may))
        self.settle(servo, [] if waiting is None else [waiting[0]])
        self._registered(servo)

    def action_all(self) -> None:
        """Nobody answers, all act."""
        waiting = [(servo, servo.rules.waiting) for servo in self.servos if servo.rules.waiting is not None]
        for servo, _ in waiting:
            servo.rules.action()
        self.ask("action_all", packet(BROADCAST, codec.ACTION), [])
        for servo, registered in waiting:
            assert registered is not None
            self.settle(servo, [registered[0]])
            self._registered(servo)

    def reboot(self) -> None:
        servo = self.any_servo()
        self.ask("reboot", packet(servo.id, codec.REBOOT), self.answers(servo, {FINE}))
        self._booted(servo)

    def _booted(self, servo: Servo) -> None:
        servo.rules.reboot()
        self._new_ram(servo)
        self.pause(BOOT_S)
        self.look(servo, self.row(servo, writable=False))

    @staticmethod
    def _new_ram(servo: Servo) -> None:
        servo.rules.held |= {70: 0, WATCHDOG: 0}
        servo.indirect[:] = bytes(20)

    def factory_reset(self) -> None:
        servo, option = self.any_servo(), self.random.choice((1, 2, 2, 0xFF, 7))
        clash = option == 0xFF and any(
            other.id == 1 or other.shadow == 1 for other in self.servos if other is not servo
        )
        if clash:
            return
        if option == 7:
            self.ask("factory_reset 7", packet(servo.id, codec.FACTORY_RESET, b"\7"), self.answers(servo, ERRORS))
            return
        before = servo.id
        wanted = self.answers(servo, {FINE})
        kept = {1: (SERVO_ID,), 2: (SERVO_ID, BAUD), 0xFF: ()}[option]
        servo.rules.factory_reset(kept)
        self._new_ram(servo)
        raw = packet(before, codec.FACTORY_RESET, bytes((option,)))
        self.ask(f"factory_reset {option}", raw, wanted, ids=(before,))
        self.pause(BOOT_S)
        self._follow(servo)

    def factory_reset_all(self) -> None:
        """The manual: "will NOT be activated" (from firmware 42)."""
        self.ask("factory_reset_all", packet(BROADCAST, codec.FACTORY_RESET, b"\xff"), [])
        self.settle(self.any_servo(), [TORQUE_ENABLE, SERVO_ID])

    def clear(self) -> None:
        servo, right = self.any_servo(), self.random.random() < 0.6
        body = b"\x01\x44\x58\x4c\x22" if right else self.random.choice((b"\x02\x44\x58\x4c\x22", b"\1", b"\1DXL#"))
        errors = {FINE} if right else {DATA_RANGE, DATA_LENGTH, INSTRUCTION, RESULT_FAIL}
        self.ask(f"clear {body.hex(' ')}", packet(servo.id, codec.CLEAR, body), self.answers(servo, errors))

    def back_up(self) -> None:
        """Backup and restore need torque off (x/backup_ready); older firmware does not know them."""
        servo, restore = self.any_servo(), self.random.random() < 0.5
        rules = servo.rules
        raw = packet(servo.id, codec.BACKUP, bytes((2 if restore else 1,)) + b"CTRL")
        if not servo.has_fast_reads:
            self.ask("back_up old", raw, self.answers(servo, {INSTRUCTION}))
            return
        if rules.torque or (restore and servo.backup is None):
            self.ask("back_up refused", raw, self.answers(servo, ERRORS))
            return
        self.ask(f"back_up restore={restore}", raw, self.answers(servo, {FINE}))
        if not restore:
            servo.backup = dict(rules.held)
            return
        assert servo.backup is not None
        for address, row in rules.rows.items():
            if row.low is not None and address not in KEPT_IN_BACKUP and address not in GOALS:
                rules.held.pop(address, None)
                if address in servo.backup:
                    rules.held[address] = servo.backup[address]
        for goal in GOALS:
            rules.held.pop(goal, None)
        servo.indirect[:] = bytes(20)
        self._learn_indirect(servo)
        self._settle_connection(servo)

    # What determines whether and how a servo answers

    def level(self) -> None:
        """Status Return Level; the write itself is answered according to the old or the new one."""
        servo, level = self.any_servo(), self.random.choice((0, 1, 2, 2, 2))
        before = servo.level
        raw = packet(servo.id, codec.WRITE, bytes((LEVEL, 0, level)))
        self.kinds["level"] += 1
        got = self.send(raw)
        answered = bool(got)
        if (before == 2) == (level == 2) and answered != (level == 2):
            self.differ(f"Status Return Level {before} to {level} of {servo.model}", got.hex(" "))
        servo.rules.held[LEVEL] = level

    def delay(self) -> None:
        """Return Delay Time: an answer begins after it, and soon after it."""
        servo = self.any_servo()
        if servo.rules.torque or servo.level == 0:
            return
        units = self.random.choice((0, 1, 10, 100, 250, 254))
        self._write(servo, DELAY, bytes((units,)))
        self.settle(servo, [DELAY])
        raw = packet(servo.id, codec.PING)
        self.pause(PAUSE_S)
        begins = self.clock.now() + 10 * len(raw) / self.bus.baud
        self.bus.write(raw)
        first = self.bus.read(1, QUIET_S)
        waited = self.clock.now() - begins
        byte = 10 / self.bus.baud
        if not first or not -1e-9 <= waited - 2e-6 * units <= 3 * byte + 1e-9:
            self.differ(f"Return Delay Time {units} of {servo.model}", f"{1e6 * waited:.1f} us")
        self.bus.read(1000, QUIET_S)

    def rename(self) -> None:
        servo = self.any_servo()
        taken = {each.id for each in self.servos} | {each.shadow for each in self.servos} | {NOBODY}
        new = self.random.choice([each for each in range(250) if each not in taken] + [253, 255])
        before = servo.id
        may = servo.rules.write(SERVO_ID, bytes((new,)))
        self.ask(
            f"rename {new}",
            packet(before, codec.WRITE, bytes((SERVO_ID, 0, new))),
            self.answers(servo, may),
            ids=(before,),
        )
        self.found(servo)

    def other_rate(self) -> None:
        """A new Baud Rate: it answers at the new one only, and comes back."""
        servo, index = self.any_servo(), self.random.choice((0, 1, 2, 4, 5, 6, 7, 8))
        before = servo.rules.held[BAUD]
        may = servo.rules.write(BAUD, bytes((index,)))
        self.ask(f"rate {index}", packet(servo.id, codec.WRITE, bytes((BAUD, 0, index))), self.answers(servo, may))
        if may == {FINE} and index != before:
            self.ask("ping elsewhere", packet(servo.id, codec.PING), [])
        self._follow(servo)

    def _follow(self, servo: Servo) -> None:
        """Look for the servo at the rate that it must have, and bring it back to the others'."""
        if BAUD_RATES[servo.rules.held[BAUD]] == 1_000_000:
            self.found(servo)
            return
        others, self.servos = self.servos, [servo]
        self.bus.baud = BAUD_RATES[servo.rules.held[BAUD]]
        self.found(servo)
        self.ask("ping_all", packet(BROADCAST, codec.PING), [(servo, {FINE})])
        self._write(servo, BAUD, b"\3")
        self.servos = others
        self.bus.baud = 1_000_000
        self.pause(PAUSE_S)

    def secondary(self) -> None:
        """A Secondary ID obeys writes to RAM, does not answer, and protects the EEPROM (x/shadow_id)."""
        servo = self.any_servo()
        if servo.rules.torque:
            return
        others = [other.id for other in self.servos if other is not servo]
        own = self.random.choice([*others, self.random.randrange(250), 255, 253])
        if self.named(own) is servo or own == NOBODY:
            return
        self._write(servo, SHADOW, bytes((own,)))
        if self.named(own) is None and own <= 252:
            self.ask("secondary ping", packet(own, codec.PING), [])
            row = self.row(servo)
            data = self.value(row)
            if not row.is_eeprom:
                servo.rules.write(row.address, data)
            body = row.address.to_bytes(2, "little") + data
            self.ask(f"secondary write {row.address}", packet(own, codec.WRITE, body), [])
            self.settle(servo, [row.address])
        self._write(servo, SHADOW, b"\xff") if not servo.rules.torque else self._end_secondary(servo)

    def _end_secondary(self, servo: Servo) -> None:
        self._write(servo, TORQUE_ENABLE, b"\0")
        self._write(servo, SHADOW, b"\xff")

    # Groups

    def ids(self) -> list[int]:
        listed = self.random.sample([servo.id for servo in self.servos], self.random.randint(1, len(self.servos)))
        if self.random.random() < 0.2:
            listed.insert(self.random.randrange(len(listed) + 1), NOBODY)
        return listed

    def until_silence(self, listed: list[int], *, fast: bool) -> list[Servo]:
        """Those who answer: a silent one silences the others (ROBOTIS, DynamixelSDK issue 364)."""
        found = []
        for servo_id in listed:
            servo = self.named(servo_id)
            if servo is None or servo.level == 0 or (fast and not servo.has_fast_reads):
                break
            found.append(servo)
        return found

    def group_read(self) -> None:
        fast, bulk, listed = self.random.random() < 0.5, self.random.random() < 0.5, self.ids()
        one = self.row(self.any_servo(), writable=False)
        rows = [one] * len(listed)
        if bulk:
            servos = [self.named(servo_id) for servo_id in listed]
            rows = [self.row(servo, writable=False) if servo else one for servo in servos]
        spans = [row.address.to_bytes(2, "little") + row.size.to_bytes(2, "little") for row in rows]
        if bulk:
            instruction = codec.FAST_BULK_READ if fast else codec.BULK_READ
            body = b"".join(bytes((each,)) + span for each, span in zip(listed, spans, strict=True))
        else:
            instruction, body = codec.FAST_SYNC_READ if fast else codec.SYNC_READ, spans[0] + bytes(listed)
        answering = self.until_silence(listed, fast=fast)
        what = f"{'fast_' if fast else ''}{'bulk' if bulk else 'sync'}_read {listed} {[row.address for row in rows]}"
        self.kinds[what.split(" ", maxsplit=1)[0]] += 1
        try:
            raw = self.send(packet(BROADCAST, instruction, body), 0.05)
            sizes = [row.size for row in rows]
            got = codec.fast_parts(raw, sizes, len(answering)) if fast else codec.statuses(raw)
        except codec.Wrong as wrong:
            self.differ(what, wrong)
            return
        if [status.id for status in got] != [servo.id for servo in answering]:
            self.differ(f"{what}, expected {[servo.id for servo in answering]}", got)
            return
        for status, servo, row in zip(got, answering, rows, strict=False):
            self._group_answer(what, status, servo, row)

    def _group_answer(self, what: str, status: Status, servo: Servo, row: Row) -> None:
        own = servo.rules.rows.get(row.address)
        if own is None:  # a model without current sensor
            if status.error & 0x7F not in (FINE, ACCESS):
                self.differ(f"{what} of {servo.model}", status)
        elif status.error & 0x7F or bool(status.error & ALERT) != servo.alert:
            self.differ(f"{what} of {servo.model}", status)
        else:
            self.compare(servo, own, status.data, what)

    def group_write(self) -> None:
        """Nobody answers; each takes or refuses its own."""
        bulk, listed = self.random.random() < 0.5, self.ids()
        one = self.row(self.any_servo())
        parts, written = [], []
        for servo_id in listed:
            servo = self.named(servo_id)
            row = self.row(servo) if bulk and servo else one
            data = self.value(row)
            span = row.address.to_bytes(2, "little") + len(data).to_bytes(2, "little")
            parts.append(bytes((servo_id,)) + (span if bulk else b"") + data)
            if servo is not None:
                own = servo.rules.rows.get(row.address)
                may = servo.rules.write(row.address, data)
                if own is not None and may == {FINE} and own != row:
                    servo.rules.held.pop(row.address, None)
                written.append((servo, row.address))
        front = b"" if bulk else one.address.to_bytes(2, "little") + one.size.to_bytes(2, "little")
        instruction = codec.BULK_WRITE if bulk else codec.SYNC_WRITE
        self.ask(f"{'bulk' if bulk else 'sync'}_write", packet(BROADCAST, instruction, front + b"".join(parts)), [])
        for servo, address in written:
            self.settle(servo, [address])

    def write_all(self) -> None:
        """A broadcast Write: nobody answers, all obey."""
        row = self.row(self.any_servo())
        data = self.value(row)
        self.ask(
            f"write_all {row.address}",
            packet(BROADCAST, codec.WRITE, row.address.to_bytes(2, "little") + data),
            [],
        )
        for servo in self.servos:
            servo.rules.write(row.address, data)
            self.settle(servo, [row.address])

    def read_all(self) -> None:
        """A broadcast Read is not answered."""
        self.ask("read_all", packet(BROADCAST, codec.READ, b"\x84\0\4\0"), [])

    # Bytes that look like a header, and packets that are none

    def stuffing(self) -> None:
        """Indirect data, plain memory by default, with 0xFF 0xFF 0xFD in it, both ways."""
        servo = self.any_servo()
        size = self.random.randint(3, 20)
        data = bytearray(self.random.randbytes(size))
        for _ in range(self.random.randint(1, 3)):
            at = self.random.randint(0, size - 3)
            data[at : at + 3] = SPECIAL
        if self.random.random() < 0.5 and size > 3:
            data[-1] = 0xFD
        begin = servo.indirect_data.to_bytes(2, "little")
        wanted = self.answers(servo, {FINE})
        self.ask(f"stuffing {data.hex(' ')}", packet(servo.id, codec.WRITE, begin + data), wanted)
        servo.indirect[:size] = data
        self._compare_indirect(servo)

    def _compare_indirect(self, servo: Servo) -> None:
        body = servo.indirect_data.to_bytes(2, "little") + b"\x14\0"
        got = self.ask("stuffing read", packet(servo.id, codec.READ, body), self.answers(servo, {FINE}, 1))
        if got and got[0].data != servo.indirect:
            self.differ(f"indirect data of {servo.model} v{servo.firmware}, {servo.indirect.hex(' ')}", got)

    def _learn_indirect(self, servo: Servo) -> None:
        body = servo.indirect_data.to_bytes(2, "little") + b"\x14\0"
        got = self.ask("stuffing read", packet(servo.id, codec.READ, body), self.answers(servo, {FINE}, 1))
        if got:
            servo.indirect[:] = got[0].data

    def damaged(self) -> None:
        """A wrong CRC is answered with the CRC error and changes nothing."""
        servo = self.any_servo()
        row = self.row(servo)
        body = row.address.to_bytes(2, "little") + self.value(row)
        flipped = 1 << self.random.randrange(16)
        raw = packet(servo.id, codec.WRITE, body, damage=flipped)
        self.ask("damaged", raw, self.answers(servo, {CRC}))
        self.ask("damaged_all", packet(BROADCAST, codec.WRITE, body, damage=flipped), [])
        self.settle(servo, [row.address])

    def cut_short(self) -> None:
        """Part of a packet, a pause of more than 1.5 ms, then a whole one, which is answered."""
        servo = self.any_servo()
        row = self.row(servo)
        raw = packet(servo.id, codec.WRITE, row.address.to_bytes(2, "little") + self.value(row))
        if got := self.send(raw[: self.random.randint(1, len(raw) - 1)]):
            self.differ("part of a packet was answered", got.hex(" "))
        self.settle(servo, [row.address])

    def noise(self) -> None:
        """Bytes before a packet that are no header."""
        servo = self.any_servo()
        clutter = bytes(self.random.choice((0x00, 0x12, 0xFD, 0xFF, 0xFE)) for _ in range(self.random.randint(1, 9)))
        if SPECIAL in clutter + b"\xff\xff"[:1]:
            return
        self.pause(PAUSE_S)
        self.ask("noise", clutter + packet(servo.id, codec.PING), [(servo, {FINE})])

    def nonsense(self) -> None:
        """Undefined instructions and IDs, and a status on the line."""
        servo = self.any_servo()
        undefined = self.random.choice((0x00, 0x07, 0x0F, 0x21, 0x77, 0x99))
        self.ask(f"undefined {undefined:#x}", packet(servo.id, undefined), self.answers(servo, {INSTRUCTION}))
        self.ask("undefined_all", packet(BROADCAST, undefined), [])
        self.ask("id_253", packet(self.random.choice((253, 255)), codec.PING), [])
        self.pause(PAUSE_S)
        self.ask("another's status", packet(servo.id, codec.STATUS, b"\0\1\2"), [])

    def _settle_connection(self, servo: Servo) -> None:
        """After a restore, ID and rate are as before; delay and level are those of the backup, or not."""
        servo.rules.held[SHADOW] = servo.rules.held.get(SHADOW, 255)
        servo.rules.held.pop(LEVEL, None)
        got = self.send(packet(servo.id, codec.READ, bytes((LEVEL, 0, 1, 0))))
        servo.rules.held[LEVEL] = codec.statuses(got)[0].data[0] if got else 0


ALERT = 0x80
ERRORS = set(range(1, 8))
KINDS: tuple[tuple[int, Callable[[Conversation], None]], ...] = (
    (3, Conversation.ping),
    (2, Conversation.ping_all),
    (4, Conversation.read),
    (1, Conversation.read_undefined),
    (2, Conversation.read_span),
    (1, Conversation.malformed),
    (2, Conversation.goal_position),
    (1, Conversation.watchdog),
    (1, Conversation.alarm),
    (8, Conversation.write),
    (3, Conversation.write_wrongly),
    (4, Conversation.torque),
    (4, Conversation.reg_write),
    (3, Conversation.action),
    (1, Conversation.action_all),
    (1, Conversation.reboot),
    (1, Conversation.factory_reset),
    (1, Conversation.factory_reset_all),
    (1, Conversation.clear),
    (2, Conversation.back_up),
    (2, Conversation.level),
    (1, Conversation.delay),
    (1, Conversation.rename),
    (1, Conversation.other_rate),
    (2, Conversation.secondary),
    (5, Conversation.group_read),
    (4, Conversation.group_write),
    (1, Conversation.write_all),
    (1, Conversation.read_all),
    (2, Conversation.stuffing),
    (2, Conversation.damaged),
    (1, Conversation.cut_short),
    (1, Conversation.noise),
    (1, Conversation.nonsense),
)


def converse(seed: int, models: Iterable[str] = (), most: int = 30) -> Conversation:
    """One conversation of up to `most` instructions, ended by the first difference."""
    talk = Conversation(seed, models)
    weights, kinds = [weight for weight, _ in KINDS], [kind for _, kind in KINDS]
    for _ in range(talk.random.randint(10, most)):
        talk.random.choices(kinds, weights)[0](talk)
        if talk.differences:
            break
    return talk


def main() -> None:
    """Converse, and print what differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conversations", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    chosen = parser.parse_args()
    kinds: Counter[str] = Counter()
    models: Counter[str] = Counter()
    wrong = 0
    for seed in range(chosen.seed, chosen.seed + chosen.conversations):
        talk = converse(seed)
        kinds += talk.kinds
        models.update(servo.model for servo in talk.servos)
        wrong += bool(talk.differences)
        for difference in talk.differences:
            print(f"seed {seed}: {difference}", file=sys.stderr if chosen.json else sys.stdout)
    if chosen.json:
        figures = {
            "conversations": chosen.conversations,
            "differ": wrong,
            "packets": dict(kinds),
            "models": dict(models),
        }
        print(json.dumps(figures | {"models": dict(models), "machine": machine()}))
    else:
        print(f"{wrong} of {chosen.conversations} conversations differ; {sum(kinds.values())} packets: {dict(kinds)}")
        print(f"models: {dict(models)}")
    raise SystemExit(bool(wrong))


if __name__ == "__main__":
    main()
