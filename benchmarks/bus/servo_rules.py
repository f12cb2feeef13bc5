"""What a servo answers and stores according to ROBOTIS' manual alone: the oracle of `benchmarks/bus/random_calls.py`.

Written from the e-Manual's control tables and protocol page, without the fake's code, so that a difference between the
two is settled by the manual. Where the manual is silent or vague, the oracle allows several answers, or forgets what a
register holds until it is read again.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

RESULT_FAIL, INSTRUCTION, CRC, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = range(1, 8)
FINE = 0

TORQUE_ENABLE, OPERATING_MODE, SERVO_ID, BAUD = 64, 11, 7, 8
EEPROM_END = 64


@dataclass(frozen=True)
class Row:
    """One row of a control table.

    low, high: range of a writable register (signed if low is negative); None for a read-only one. initial: value after
    a factory reset (EEPROM) or at power-up (RAM); None where the table has none. moves: whether the servo itself
    changes it. limit: address of the register that limits it.
    """

    address: int
    size: int
    low: int | None = None
    high: int | None = None
    initial: int | None = None
    moves: bool = False
    limit: int | None = None

    @property
    def is_eeprom(self) -> bool:
        return self.address < EEPROM_END

    @property
    def span(self) -> range:
        return range(self.address, self.address + self.size)


_COMMON = (
    Row(0, 2),
    Row(2, 4),
    Row(6, 1),
    Row(SERVO_ID, 1, 0, 252, 1),
    Row(BAUD, 1, 0, 7, 1),
    Row(9, 1, 0, 254, 250),
    Row(OPERATING_MODE, 1, 0, 16, 3),
    Row(12, 1, 0, 255, 255),
    Row(20, 4, -1_044_479, 1_044_479, 0),
    Row(24, 4, 0, 1023, 10),
    Row(48, 4, 0, 4095, 4095),
    Row(52, 4, 0, 4095, 0),
    Row(TORQUE_ENABLE, 1, 0, 1, 0),
    Row(65, 1, 0, 1, 0),
    Row(68, 1, 0, 2, 2),
    Row(69, 1, moves=True),
    Row(70, 1),
    Row(76, 2, 0, 16383),
    Row(78, 2, 0, 16383),
    Row(80, 2, 0, 16383),
    Row(82, 2, 0, 16383),
    Row(84, 2, 0, 16383),
    Row(88, 2, 0, 16383, 0),
    Row(90, 2, 0, 16383, 0),
    Row(100, 2, -885, 885, limit=36),
    Row(108, 4, 0, 32767, 0),
    Row(112, 4, 0, 32767, 0),
    Row(116, 4, -1_048_575, 1_048_575, moves=True),
    *(Row(address, size, moves=True) for address, size in ((120, 2), (122, 1), (123, 1), (124, 2))),
    *(Row(address, size, moves=True) for address, size in ((126, 2), (128, 4), (132, 4), (136, 4), (140, 4))),
    Row(144, 2, moves=True),
    Row(146, 1, moves=True),
)

XM430_W350 = (
    *_COMMON,
    Row(31, 1, 0, 100, 80),
    Row(32, 2, 95, 160, 160),
    Row(34, 2, 95, 160, 95),
    Row(36, 2, 0, 885, 885),
    Row(38, 2, 0, 1193, 1193),
    Row(44, 4, 0, 1023, 200),
    Row(102, 2, -1193, 1193, limit=38),
    Row(104, 4, -1023, 1023, limit=44),
)

XL330_M288 = (
    *_COMMON,
    Row(31, 1, 0, 100, 70),
    Row(32, 2, 31, 70, 70),
    Row(34, 2, 31, 70, 35),
    Row(36, 2, 0, 885, 885),
    Row(38, 2, 0, 1750, 1750),
    Row(44, 4, 0, 2047, 445),
    Row(102, 2, -1750, 1750, limit=38),
    Row(104, 4, -2047, 2047, limit=44),
)

MODES = {0, 1, 3, 4, 5, 16}
FORGOTTEN_WITH_MODE = (76, 78, 80, 82, 84, 88, 90, 100, 102, 104, 108, 112, 116)
"""Registers that a change of Operating Mode may set to values of the new mode."""


class Rules:
    """What one servo holds according to its manual, derived from the instructions it received.

    table: its control table. values: what its registers hold now, by address.
    """

    def __init__(self, table: Iterable[Row], values: Mapping[int, int]) -> None:
        self.rows = {row.address: row for row in table}
        self.held = {address: value for address, value in values.items() if not self.rows[address].moves}
        self.waiting: tuple[int, bytes] | None = None

    @property
    def torque(self) -> bool:
        return bool(self.held.get(TORQUE_ENABLE))

    def write(self, address: int, data: bytes) -> set[int]:
        """Write; return the errors that the servo may answer with, and remember what its registers then hold."""
        row = self.rows.get(address)
        if row is not None and len(data) > row.size:
            return self._write_several(address, data)
        wrong = self._wrong(address, data)
        if row is None or wrong:
            return wrong
        value = int.from_bytes(data, "little", signed=(row.low or 0) < 0)
        if address == OPERATING_MODE:
            self._switch_mode(value)
        if address in (36, 38, 44):
            self._forget((100, 102, 104))
        if address == TORQUE_ENABLE:
            self._forget((100, 102, 104, 116))
        limit = None if row.limit is None else self.held.get(row.limit)
        if row.moves or (row.limit is not None and (limit is None or abs(value) > limit)):
            # DynamixelSDK issue 173 reports that a goal beyond its limit is taken, issue 588 that it is refused.
            self._forget([address])
            return {FINE, DATA_LIMIT, DATA_RANGE}
        self.held[address] = value
        return {FINE}

    def _switch_mode(self, mode: int) -> None:
        """Switching resets gains to those of the mode, the profile to 0, goals to their limits."""
        before = self.held.get(OPERATING_MODE)
        self._forget(FORGOTTEN_WITH_MODE)
        if before is not None and before != mode:  # the manual does not say whether the same mode counts
            self.held |= {108: 0, 112: 0}
            self.held |= {goal: self.held[limit] for goal, limit in ((100, 36), (102, 38)) if limit in self.held}

    def _wrong(self, address: int, data: bytes) -> set[int]:
        """Every reason to refuse a write of one register; the manual does not say which of several is answered."""
        row = self.rows.get(address)
        if row is None:
            inside = any(address in other.span for other in self.rows.values())
            return {ACCESS, DATA_LENGTH} if inside else {ACCESS}
        if row.low is None or row.high is None:
            return {ACCESS} | ({DATA_LENGTH} if len(data) < row.size else set())
        reasons = set()
        if len(data) < row.size:
            reasons.add(DATA_LENGTH)
        else:
            value = int.from_bytes(data, "little", signed=row.low < 0)
            if not row.low <= value <= row.high or (address == OPERATING_MODE and value not in MODES):
                # A goal's range is given by its limit, so either error describes it.
                reasons |= {DATA_RANGE} if row.limit is None and not row.moves else {DATA_RANGE, DATA_LIMIT}
        if row.is_eeprom and self.torque:
            reasons.add(ACCESS)
        return reasons

    def _write_several(self, address: int, data: bytes) -> set[int]:
        """Write neighbouring registers at once; if one is refused, nothing is known about the others."""
        end, at, reasons = address + len(data), address, set()
        while at < end:
            row = self.rows.get(at)
            size = 1 if row is None else row.size
            errors = self.write(at, data[at - address : at - address + size])
            reasons |= errors - {FINE}
            at += size
        if not reasons:
            return {FINE}
        self._forget(row.address for row in self.rows.values() if row.address < end and row.span.stop > address)
        return reasons | ({FINE} if reasons <= {DATA_LIMIT, DATA_RANGE} else set())

    def reg_write(self, address: int, data: bytes) -> set[int]:
        """Register a write for `action`."""
        before = dict(self.held)
        errors = self.write(address, data)
        self.held = before
        if errors == {FINE}:
            self.waiting = address, data
        elif FINE in errors:  # the caller knows which
            self._forget([address])
        return errors

    def action(self) -> set[int]:
        """Carry out the registered write."""
        if self.waiting is None:
            return {INSTRUCTION}
        (address, data), self.waiting = self.waiting, None
        return self.write(address, data) | {FINE, INSTRUCTION}  # the latter if it was repeated after a late answer

    def reboot(self) -> None:
        """Reset RAM to its power-up values; EEPROM is kept."""
        self.waiting = None
        for row in self.rows.values():
            if not row.is_eeprom:
                self.held.pop(row.address, None)
                if row.initial is not None:
                    self.held[row.address] = row.initial

    def factory_reset(self, kept: Iterable[int]) -> None:
        """Reset EEPROM to its factory values except for the registers `kept`; the servo reboots."""
        for row in self.rows.values():
            if row.is_eeprom and row.initial is not None and row.address not in kept:
                self.held[row.address] = row.initial
        self.reboot()

    def expected(self, address: int) -> int | None:
        """Value of a register; None if the manual does not specify it."""
        return self.held.get(address)

    def learn(self, address: int, value: int) -> None:
        """Adopt the value read from a register that the manual does not specify."""
        if not self.rows[address].moves:
            self.held[address] = value

    def _forget(self, addresses: Iterable[int]) -> None:
        for address in addresses:
            self.held.pop(address, None)
