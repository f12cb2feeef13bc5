"""Instructions to several servos, changes to how servos answer, and bytes that are not packets."""

from benchmarks.bus import codec
from benchmarks.bus.codec import BROADCAST, Status, packet
from benchmarks.bus.conversation.servos import (
    ALERT,
    DELAY,
    LEVEL,
    NOBODY,
    PAUSE_S,
    QUIET_S,
    SHADOW,
    SPECIAL,
    Servo,
)
from benchmarks.bus.conversation.single import SingleInstructions
from benchmarks.bus.servo_rules import (
    ACCESS,
    BAUD,
    CRC,
    FINE,
    INSTRUCTION,
    SERVO_ID,
    TORQUE_ENABLE,
    Row,
)


class Conversation(SingleInstructions):
    """A host that sends every kind of instruction."""

    # What determines whether and how a servo answers

    def level(self) -> None:
        """Change Status Return Level. Either the old or the new level may determine whether the write is answered."""
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
        """Change Return Delay Time, and check that the next answer begins directly after this delay."""
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
        """Change Baud Rate, check that the servo answers only at the new rate, and change it back."""
        servo, index = self.any_servo(), self.random.choice((0, 1, 2, 4, 5, 6, 7, 8))
        before = servo.rules.held[BAUD]
        may = servo.rules.write(BAUD, bytes((index,)))
        self.ask(f"rate {index}", packet(servo.id, codec.WRITE, bytes((BAUD, 0, index))), self.answers(servo, may))
        if may == {FINE} and index != before:
            self.ask("ping elsewhere", packet(servo.id, codec.PING), [])
        self._follow(servo)

    def secondary(self) -> None:
        """Write to a Secondary ID: the servo must obey if the register is in RAM but not if it is in EEPROM. In neither
        case may it answer (manual: x/shadow_id).
        """
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
        """Return the servos that answer; a silent servo silences those after it (ROBOTIS, DynamixelSDK issue 364)."""
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
        """Send a group write: no servo answers; each accepts or refuses its own value."""
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
        """Send a broadcast Write: no servo answers; all obey."""
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
        """Send a broadcast Read, which no servo answers."""
        self.ask("read_all", packet(BROADCAST, codec.READ, b"\x84\0\4\0"), [])

    # Bytes that look like a header, and bytes that are not packets

    def stuffing(self) -> None:
        """Write 0xFF 0xFF 0xFD to indirect data, which is plain memory by default, and read it back."""
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

    def damaged(self) -> None:
        """Send a packet with a wrong CRC; the servo answers with the CRC error and changes nothing."""
        servo = self.any_servo()
        row = self.row(servo)
        body = row.address.to_bytes(2, "little") + self.value(row)
        flipped = 1 << self.random.randrange(16)
        raw = packet(servo.id, codec.WRITE, body, damage=flipped)
        self.ask("damaged", raw, self.answers(servo, {CRC}))
        self.ask("damaged_all", packet(BROADCAST, codec.WRITE, body, damage=flipped), [])
        self.settle(servo, [row.address])

    def cut_short(self) -> None:
        """Send part of a packet, pause for more than 1.5 ms, then send a whole packet, which must be answered."""
        servo = self.any_servo()
        row = self.row(servo)
        raw = packet(servo.id, codec.WRITE, row.address.to_bytes(2, "little") + self.value(row))
        if got := self.send(raw[: self.random.randint(1, len(raw) - 1)]):
            self.differ("part of a packet was answered", got.hex(" "))
        self.settle(servo, [row.address])

    def noise(self) -> None:
        """Send bytes that are not a header, followed by a packet."""
        servo = self.any_servo()
        clutter = bytes(self.random.choice((0x00, 0x12, 0xFD, 0xFF, 0xFE)) for _ in range(self.random.randint(1, 9)))
        if SPECIAL in clutter + b"\xff\xff"[:1]:
            return
        self.pause(PAUSE_S)
        self.ask("noise", clutter + packet(servo.id, codec.PING), [(servo, {FINE})])

    def nonsense(self) -> None:
        """Send undefined instructions, a ping to an undefined ID, and a status packet."""
        servo = self.any_servo()
        undefined = self.random.choice((0x00, 0x07, 0x0F, 0x21, 0x77, 0x99))
        self.ask(f"undefined {undefined:#x}", packet(servo.id, undefined), self.answers(servo, {INSTRUCTION}))
        self.ask("undefined_all", packet(BROADCAST, undefined), [])
        self.ask("id_253", packet(self.random.choice((253, 255)), codec.PING), [])
        self.pause(PAUSE_S)
        self.ask("another's status", packet(servo.id, codec.STATUS, b"\0\1\2"), [])
