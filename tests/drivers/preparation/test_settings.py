"""Which settings of a servo are stored, and when none are."""

from contextlib import suppress
from typing import Any

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.errors import WrongReply
from hil.drivers.preparation.settings import EEPROM, PROTECTIVE, RAM, put_back, read_settings
from hil.drivers.servo import Servo as RealServo

XM430 = load_control_table("XM430-W350")


class Servo:
    """Each register holds a different number; from the n-th read on, replies are one request behind."""

    table, title = XM430, "The servo"

    def __init__(self, behind: range = range(0)) -> None:
        self._behind = behind
        self._asked: list[str] = ["Torque Enable"]

    def read(self, register: str) -> int:
        self._asked.append(register)
        answered = self._asked[-2 if len(self._asked) - 2 in self._behind else -1]
        return 0xFF if answered == "Bus Watchdog" else XM430[answered].address


def test_every_register_is_stored_and_a_tripped_watchdog_as_one_that_is_off() -> None:
    servo: Any = Servo()
    known = {name: XM430[name].address for name in (*EEPROM, *RAM) if name in XM430}
    assert read_settings(servo) == known | {"Bus Watchdog": 0}


@pytest.mark.parametrize("behind", [range(100), range(1, 100), range(13, 100), range(1), range(5, 6), range(2, 20)])
def test_nothing_is_stored_if_replies_belong_to_earlier_requests(behind: range) -> None:
    """Each would be restored as the value of another register."""
    servo: Any = Servo(behind)
    with pytest.raises(WrongReply, match="its replies are late or repeated and belong to earlier requests"):
        read_settings(servo)


class _Restored(Servo):
    """A servo with torque off that records what is written to it."""

    def __init__(self, behind: range) -> None:
        super().__init__(behind)
        self.written: list[str] = []

    id = XM430["ID"].address

    def read_despite_error(self, register: str) -> int:
        return 0 if register == "Torque Enable" else self.read(register)

    read_surely = RealServo.read_surely

    def write_despite_error(self, register: str, _value: int) -> None:
        self.written.append(register)


@pytest.mark.parametrize("behind", [range(100), range(1, 100), range(5, 100)])
def test_late_replies_are_not_taken_for_changes_by_another_program(behind: range) -> None:
    """EEPROM that nobody has changed is not written."""
    servo: Any = _Restored(behind)
    settings = {name: XM430[name].address for name in (*EEPROM, *RAM) if name in XM430}
    with suppress(WrongReply):
        put_back(servo, settings)
    assert not set(servo.written) & set(PROTECTIVE)


def test_a_change_by_another_program_is_undone() -> None:
    servo: Any = _Restored(range(0))
    settings = {name: XM430[name].address for name in (*EEPROM, *RAM) if name in XM430}
    restored = put_back(servo, settings | {"Temperature Limit": 80})
    assert restored["Temperature Limit"] == (XM430["Temperature Limit"].address, 80)
    assert set(servo.written) & set(EEPROM) == {"Temperature Limit"}
