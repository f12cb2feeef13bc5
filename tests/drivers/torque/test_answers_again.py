"""Servos that answer again after torque was cut: what is sent to them, what is found out, and how it is reported."""

from typing import Any

import pytest

from hil.drivers.errors import NoReply
from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode, servo_model
from hil.drivers.torque.off import TorqueOff, cut_again, was_rebooted

FIRST, SECOND = (
    Joint(name, number, servo_model("XM430-W350"), 1, 2048, Mode.CURRENT) for number, name in ((1, "a"), (2, "b"))
)
ARMED = {
    **{"ID": 2, "Torque Enable": 1, "Bus Watchdog": 4, "Operating Mode": 0},
    **{"Goal Current": 7, "Current Limit": 1193, "Goal PWM": 885, "PWM Limit": 885},
}
REBOOTED = ARMED | {"Torque Enable": 0, "Bus Watchdog": 0, "Goal Current": 1193}


class Registers:
    """A servo that notes what is written. answers: number of reads that it answers."""

    def __init__(self, held: dict[str, int], answers: int = 99) -> None:
        self.id, self.held, self.answers = 2, dict(held), answers
        self.written: list[tuple[str, int]] = []

    def read(self, register: str) -> int:
        self.answers -= 1
        if self.answers < 0:
            raise NoReply("silent")
        return self.held[register]

    read_despite_error = read

    def write_despite_error(self, register: str, value: int) -> None:
        self.written.append((register, value))


@pytest.mark.parametrize(
    ("held", "rebooted"),
    [
        (ARMED, None),
        (REBOOTED, True),
        (REBOOTED | {"Goal Current": 7}, False),
        (REBOOTED | {"Operating Mode": 16}, True),
        (REBOOTED | {"Operating Mode": 16, "Goal PWM": 30}, False),
        (REBOOTED | {"ID": 3}, None),
    ],
)
def test_a_reboot_is_told_from_a_watchdog_that_another_program_switched_off(
    held: dict[str, int], rebooted: bool | None
) -> None:
    """A reboot resets the goal to its limit; another program leaves the goal as it is."""
    found: Any = Registers(held)
    assert was_rebooted(found) is rebooted


def test_a_servo_that_falls_silent_again_may_or_may_not_have_been_rebooted() -> None:
    for answers in range(6):
        found: Any = Registers(REBOOTED, answers)
        assert was_rebooted(found) is None


@pytest.mark.parametrize(("is_on", "armed"), [(1, True), (1, False), (0, True), (0, False)])
def test_a_servo_that_answers_again_is_left_without_torque_and_without_a_watchdog(is_on: int, armed: bool) -> None:
    found: Any = Registers(REBOOTED | {"Torque Enable": is_on})
    assert cut_again(found, armed=armed) is (True if armed else None)
    assert found.written == [*[("Torque Enable", 0)] * is_on, *[("Bus Watchdog", 0)] * armed]


@pytest.mark.parametrize("rebooted", [True, False, None])
def test_a_servo_that_is_confirmed_later_is_reported_with_the_reason_of_its_silence(rebooted: bool | None) -> None:
    report = TorqueOff((), ((FIRST, "Silent."), (SECOND, "Silent.")), tripped=frozenset((FIRST,)))
    later = report.with_later(SECOND, rebooted=rebooted)
    assert later.confirmed == (SECOND,) and later.unconfirmed == ((FIRST, "Silent."),)
    assert later.later == {SECOND} and later.tripped == {FIRST, SECOND}
    assert later.rebooted == ({SECOND} if rebooted else set())
    assert later.disarmed == ({SECOND} if rebooted is False else set())
    said = str(later)
    assert f"{SECOND.title} did not answer at first, but answers again." in said
    assert ("was rebooted: its Bus Watchdog is no longer armed" in said) is (rebooted is True)
    assert ("another program has switched off its Bus Watchdog" in said) is (rebooted is False)
    assert ("a brief dip of its supply rebooted it" in said) is (rebooted is False)
    assert FIRST.title not in said.partition("confirmed by reading it back.")[2]


def test_torque_is_off_only_if_every_servo_confirmed_it() -> None:
    assert TorqueOff((FIRST, SECOND), ()).is_off
    assert not TorqueOff((FIRST,), ((SECOND, "Silent."),)).is_off
    assert not TorqueOff((FIRST,), (), driven=(SECOND,)).is_off


def test_a_servo_that_does_not_behave_as_if_its_torque_were_off_is_no_longer_confirmed() -> None:
    report = TorqueOff((FIRST, SECOND), ()).with_doubted(SECOND, "It holds.")
    assert (report.confirmed, report.unconfirmed) == ((FIRST,), ((SECOND, "It holds."),))


def test_servos_that_another_program_drives_are_named_first() -> None:
    driven = TorqueOff((FIRST, SECOND), ()).with_driven([SECOND], [])
    assert (driven.confirmed, driven.unconfirmed, driven.driven) == ((FIRST,), (), (SECOND,))
    said = str(driven)
    assert said.startswith(f"TORQUE IS ON AT {str(SECOND).upper()}: ANOTHER PROGRAM TURNS IT BACK ON")
    assert f"Torque is off on {FIRST}, confirmed" in said and "NOT CONFIRMED" not in said
    both = str(TorqueOff((FIRST, SECOND), ()).with_driven([FIRST, SECOND], []))
    assert "confirmed" not in both.lower()
    silent = TorqueOff((FIRST, SECOND), ()).with_driven([SECOND], [FIRST])
    assert silent.confirmed == () and [joint for joint, _ in silent.unconfirmed] == [FIRST]
    assert f"TORQUE OFF IS NOT CONFIRMED for {str(FIRST).upper()}. Another program had" in str(silent)
