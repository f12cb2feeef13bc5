"""Instructions to one servo, and the same instructions broadcast to all servos."""

from benchmarks.bus import codec
from benchmarks.bus.codec import BROADCAST, Status, packet
from benchmarks.bus.conversation.host import Host
from benchmarks.bus.conversation.servos import (
    BAUD_RATES,
    BOOT_S,
    DELAY,
    ERRORS,
    GOALS,
    KEPT_IN_BACKUP,
    LEVEL,
    NOBODY,
    NUMBERS,
    PAUSE_S,
    SHADOW,
    UNDEFINED,
    WATCHDOG,
    Servo,
)
from benchmarks.bus.servo_rules import (
    ACCESS,
    BAUD,
    DATA_LENGTH,
    DATA_LIMIT,
    DATA_RANGE,
    FINE,
    INSTRUCTION,
    RESULT_FAIL,
    SERVO_ID,
    TORQUE_ENABLE,
)


class SingleInstructions(Host):
    """A host that sends these instructions, both valid and invalid."""

    def ping(self) -> None:
        servo_id = self.random.choice([*(servo.id for servo in self.servos), NOBODY])
        servo = self.named(servo_id)
        got = self.ask("ping", packet(servo_id, codec.PING), [(servo, {FINE})] if servo else [])
        for status in got:
            self.compare_ping(status)

    def found(self, servo: Servo) -> None:
        """Ping a servo, which must answer."""
        for status in self.ask("ping", packet(servo.id, codec.PING), [(servo, {FINE})]):
            self.compare_ping(status)

    def compare_ping(self, status: Status) -> None:
        servo = self.named(status.id)
        assert servo is not None
        wanted = NUMBERS[servo.model].to_bytes(2, "little") + bytes((servo.firmware,))
        if status.data != wanted:
            self.differ(f"ping of {servo.model}, expected {wanted.hex(' ')}", status.data.hex(" "))

    def ping_all(self) -> None:
        """Ping all servos, which must answer in the order of their IDs ("according to their arranged order")."""
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
        """Read adjacent registers at once; undefined bytes may have any value, or cause the read to be refused."""
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
        """Send instructions with too few or too many parameters, which must change nothing."""
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
        """Write Goal Position. Position mode allows values within its limits; other modes allow +-256 turns."""
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
        """Check that Bus Watchdog trips if packets cease, but only with torque on, and blocks goals until cleared."""
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
        """Set Min Voltage Limit above the supply voltage. Until the limit has been restored and the servo rebooted,
        every status must carry the alert, and torque must be off if Shutdown contains the bit for this error.
        """
        servo = self.any_servo()
        held = servo.rules.held
        if held.get(TORQUE_ENABLE) or servo.level < 2 or servo.alert or 34 not in held:
            return
        row = servo.rules.rows[34]
        assert row.high is not None
        before, shuts_down = held[34], servo.model.startswith("XL330")  # Shutdown is 53 on the XL330, otherwise 52
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
        servo.alert = False  # the answer to Reboot carries no alert: ROBOTIS' own clients would take it for a failure
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
        """Write to a read-only or undefined address, or write too few bytes."""
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
        """Clear the servo's registered instruction, since a silent servo may or may not have accepted it."""
        may = servo.rules.action() | {FINE, INSTRUCTION}
        self.ask("action", packet(servo.id, codec.ACTION), self.answers(servo, may | set(range(1, 8))))
        servo.rules.waiting = None
        for address in list(servo.rules.held):
            if address not in (0, 6, SERVO_ID, BAUD, DELAY, SHADOW, LEVEL, WATCHDOG):
                del servo.rules.held[address]
        self.settle(servo, [TORQUE_ENABLE, 11])
        servo.rules.held.setdefault(TORQUE_ENABLE, 0)

    def _registered(self, servo: Servo) -> None:
        """Check that Registered Instruction is 1 if an instruction is waiting, and 0 otherwise."""
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
        """Broadcast Action: no servo answers; all act."""
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
        """Broadcast Factory Reset, which has no effect (the manual: "will NOT be activated", from firmware 42)."""
        self.ask("factory_reset_all", packet(BROADCAST, codec.FACTORY_RESET, b"\xff"), [])
        self.settle(self.any_servo(), [TORQUE_ENABLE, SERVO_ID])

    def clear(self) -> None:
        servo, right = self.any_servo(), self.random.random() < 0.6
        body = b"\x01\x44\x58\x4c\x22" if right else self.random.choice((b"\x02\x44\x58\x4c\x22", b"\1", b"\1DXL#"))
        errors = {FINE} if right else {DATA_RANGE, DATA_LENGTH, INSTRUCTION, RESULT_FAIL}
        self.ask(f"clear {body.hex(' ')}", packet(servo.id, codec.CLEAR, body), self.answers(servo, errors))

    def back_up(self) -> None:
        """Back up or restore; both need torque off (x/backup_ready), and older firmware does not support them."""
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

    def _settle_connection(self, servo: Servo) -> None:
        """Read the level after a restore, which keeps ID and baud rate but may change Status Return Level and delay."""
        servo.rules.held[SHADOW] = servo.rules.held.get(SHADOW, 255)
        servo.rules.held.pop(LEVEL, None)
        got = self.send(packet(servo.id, codec.READ, bytes((LEVEL, 0, 1, 0))))
        servo.rules.held[LEVEL] = codec.statuses(got)[0].data[0] if got else 0

    def _follow(self, servo: Servo) -> None:
        """Ping the servo at the baud rate that it should now have, and return it to the rate of the others."""
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
