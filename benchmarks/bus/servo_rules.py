"""What a servo answers and stores according to ROBOTIS' manual alone: the oracle of `random_calls` and `conversations`.

The oracle was written from the e-Manual's control tables and protocol page, without use of the fake's code, so that any
difference between oracle and fake has to be settled by the manual. Where the manual is silent or vague, the oracle
allows several answers, or treats the value of a register as unknown until it is read again.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

RESULT_FAIL, INSTRUCTION, CRC, DATA_RANGE, DATA_LENGTH, DATA_LIMIT, ACCESS = range(1, 8)
FINE = 0

TORQUE_ENABLE, OPERATING_MODE, SERVO_ID, BAUD = 64, 11, 7, 8
POSITION_MODE, LED = 3, 65
EEPROM_END = 64


@dataclass(frozen=True)
class Row:
    """One row of a control table.

    low, high: range of a writable register (signed if low is negative); None if it is read-only. initial: value after a
    factory reset (EEPROM) or at power-up (RAM); None if the table has none. moves: whether the servo changes the value
    by itself. limit: address of the register that limits the value.
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
    Row(98, 1, 0, 127, 0),
    Row(100, 2, -885, 885, limit=36),
    Row(108, 4, 0, 32767, 0),
    Row(112, 4, 0, 32767, 0),
    Row(116, 4, -1_048_575, 1_048_575, moves=True),
    *(Row(address, size, moves=True) for address, size in ((120, 2), (122, 1), (123, 1), (124, 2))),
    *(Row(address, size, moves=True) for address, size in ((126, 2), (128, 4), (132, 4), (136, 4), (140, 4))),
    Row(144, 2, moves=True),
    Row(146, 1, moves=True),
)


def _table(
    velocity: int,
    current: int | None,
    gains: tuple[int, int, int, int, int] = (1920, 100, 0, 0, 800),
    *,
    celsius: int = 80,
    volts: tuple[int, int, int] = (95, 95, 160),
    fastest: int = 1023,
    threshold: int = 10,
) -> tuple[Row, ...]:
    """One model's table.

    velocity, current: factory values of Velocity Limit and Current Limit. gains: Velocity I and P, Position D, I and P.
    volts: lowest value that a voltage limit may have, and factory values of Min and Max Voltage Limit. threshold:
    Moving Threshold.
    """
    differ = {24: threshold} | dict(zip((76, 78, 80, 82, 84), gains, strict=True))
    differ |= {SERVO_ID: 1, BAUD: 1}
    low, factory_low, high = volts
    rows = [
        replace(
            row, initial=differ.get(row.address, row.initial), high=6 if is_330 and row.address == BAUD else row.high
        )
        for is_330 in (fastest > 1023,)
        for row in _COMMON
    ]
    rows += [Row(31, 1, 0, 100, celsius), Row(32, 2, low, high, high), Row(34, 2, low, high, factory_low)]
    rows += [Row(36, 2, 0, 885, 885), Row(44, 4, 0, fastest, velocity), Row(104, 4, -fastest, fastest, limit=44)]
    if current is not None:
        rows += [Row(38, 2, 0, current, current), Row(102, 2, -current, current, limit=38)]
    return tuple(rows)


def _x330(
    velocity: int, current: int, gains: tuple[int, int, int, int, int], volts: tuple[int, int, int]
) -> tuple[Row, ...]:
    return _table(velocity, current, gains, celsius=70, volts=volts, fastest=2047)


_BY_900 = (1920, 100, 0, 0, 900)
_V5, _V12, _V24 = (31, 35, 70), (55, 55, 140), (60, 60, 160)

TABLES = {
    "XM430-W350": _table(200, 1193),
    "XM430-W210": _table(330, 1193),
    "XH430-W350": _table(130, 648, _BY_900),
    "XH430-W210": _table(210, 648, _BY_900),
    "XD430-T350": _table(130, 648, _BY_900),
    "XD430-T210": _table(210, 648, _BY_900),
    "XW430-T333": _table(139, 2047, _BY_900),
    "XM540-W270": _table(128, 2047),
    "XM540-W150": _table(230, 2047),
    "XH540-W270": _table(167, 2047),
    "XH540-W150": _table(300, 2047),
    "XD540-T270": _table(167, 2047),
    "XD540-T150": _table(300, 2047),
    "XW540-T260": _table(167, 2047),
    "XW540-T140": _table(304, 2047),
    "XL330-M288": _x330(445, 1750, (1600, 180, 0, 0, 400), _V5),
    "XL330-M077": _x330(1620, 1750, (400, 40, 0, 400, 400), _V5),
    "XC330-M181": _x330(545, 2352, (1400, 100, 500, 0, 1200), _V5),
    "XC330-M288": _x330(350, 2352, (1600, 50, 500, 0, 1100), _V5),
    "XC330-T181": _x330(510, 910, (1200, 40, 0, 0, 900), _V12),
    "XC330-T288": _x330(320, 910, (1200, 40, 0, 0, 900), _V12),
    "XL430-W250": _table(265, None, (1000, 100, 4000, 0, 640), celsius=72, volts=(60, 60, 140)),
    "XC430-W150": _table(460, None, (1920, 100, 0, 0, 460), volts=_V24, threshold=20),
    "XC430-W240": _table(306, None, (1920, 100, 0, 0, 700), volts=_V24),
}
"""Control table of every X model for 5 to 12 V with one motor, according to the manual's pages x/<model>."""

for _name in [name for name in TABLES if name.startswith("XW")]:  # watertight: without an LED
    TABLES[_name] = tuple(row for row in TABLES[_name] if row.address != LED)

XM430_W350, XL330_M288 = TABLES["XM430-W350"], TABLES["XL330-M288"]

MODES = {0, 1, 3, 4, 5, 16}
WITHOUT_CURRENT = {1, 3, 4, 16}
"""Operating modes of all models, and of those without a current sensor."""

GAINS = (76, 78, 80, 82, 84, 88, 90)
FORGOTTEN_WITH_MODE = (*GAINS, 100, 102, 104, 108, 112, 116)
"""Registers that a change of Operating Mode may set to values of the new mode."""


class Rules:
    """The register values of one servo according to its manual, derived from the instructions that it received.

    table: the servo's control table. values: the present contents of its registers, by address.
    """

    def __init__(self, table: Iterable[Row], values: Mapping[int, int]) -> None:
        self.rows = {row.address: row for row in table}
        self.modes = MODES if 102 in self.rows else WITHOUT_CURRENT
        self.held = {address: value for address, value in values.items() if not self.rows[address].moves}
        self.waiting: tuple[int, bytes] | None = None

    @property
    def torque(self) -> bool:
        return bool(self.held.get(TORQUE_ENABLE))

    def write(self, address: int, data: bytes) -> set[int]:
        """Record a write; return the errors that the servo may answer with. `held` then contains the new values."""
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
            # DynamixelSDK issue 173 reports that a goal beyond its limit is accepted, issue 588 that it is refused.
            self._forget([address])
            return {FINE, DATA_LIMIT, DATA_RANGE}
        self.held[address] = value
        return {FINE}

    def _switch_mode(self, mode: int) -> None:
        """Change the mode, which resets gains to those of the mode, the profile to 0, and goals to their limits."""
        before = self.held.get(OPERATING_MODE)
        self._forget(FORGOTTEN_WITH_MODE)
        if before is not None and before != mode:  # the manual does not say what writing the same mode does
            self.held |= {108: 0, 112: 0}
            self.held |= {goal: self.held[limit] for goal, limit in ((100, 36), (102, 38)) if limit in self.held}

    def _wrong(self, address: int, data: bytes) -> set[int]:
        """All errors that apply to a write to one register; the manual does not say which one the servo returns."""
        row = self.rows.get(address)
        if row is None:
            inside = any(address in other.span and other.low is not None for other in self.rows.values())
            return {ACCESS, DATA_LENGTH} if inside else {ACCESS}
        if row.low is None or row.high is None:
            return {ACCESS}
        reasons = set()
        if len(data) < row.size:
            reasons.add(DATA_LENGTH)
        else:
            value = int.from_bytes(data, "little", signed=row.low < 0)
            if not row.low <= value <= row.high or (address == OPERATING_MODE and value not in self.modes):
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
        elif FINE in errors:  # only the caller knows whether the servo accepted the write
            self._forget([address])
        return errors

    def action(self) -> set[int]:
        """Carry out the registered write."""
        if self.waiting is None:
            return {INSTRUCTION}
        (address, data), self.waiting = self.waiting, None
        # Instruction error: if Action was repeated after a late answer, nothing is registered any more.
        return self.write(address, data) | {FINE, INSTRUCTION}

    def reboot(self) -> None:
        """Reset RAM to its power-up values; EEPROM is kept."""
        self.waiting = None
        for row in self.rows.values():
            if not row.is_eeprom:
                self.held.pop(row.address, None)
                if row.initial is not None:
                    self.held[row.address] = row.initial
        if self.held.get(OPERATING_MODE) != POSITION_MODE:
            self._forget(GAINS)  # the gains in the table are those of the factory mode

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
