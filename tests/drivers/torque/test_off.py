"""Cutting torque, packet by packet: what is sent when, to a port and servos that only record."""

import signal
import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from hil.drivers.control_table import load_control_table
from hil.drivers.errors import DriverError, NoReply, PortLost, WrongReply
from hil.drivers.joint import Joint
from hil.drivers.packet import BROADCAST_ID, Instruction, encode
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode, servo_model
from hil.drivers.torque.held import switched_on
from hil.drivers.torque.off import (
    TorqueOff,
    and_list,
    by_reason,
    cut_torque,
    disarm_watchdogs,
    is_torque_on,
    signals_held_back,
    tell_watchdogs,
)
from hil.fakes.bus.clock import VirtualClock

WATCHDOG_S = 0.1
OFF = 2 * encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes((64, 0, 1, 0, 1, 0, 2, 0)))
ALL, FIRST, SECOND = "all", 1, 2
JOINTS = [
    Joint(name, number, servo_model("XM430-W350"), 1, 2048, Mode.CURRENT) for number, name in ((1, "a"), (2, "b"))
]


class Bench:
    """A port and two servos. fails: what each write to a servo raises, in order; none after that."""

    def __init__(self, **fails: list[BaseException]) -> None:
        self.sent: list[tuple[object, float]] = []
        self.attempts: list[int | None] = []
        self.watchdogs = {FIRST: 0xFF, SECOND: 4}
        clock = VirtualClock()
        self.port: Any = SimpleNamespace(clock=clock, write=self._note)
        self.servos: dict[Joint, Any] = {}
        for joint, name in zip(JOINTS, ("first", "second"), strict=True):
            self.servos[joint] = self._servo(joint.id, fails.get(name, []))

    def _note(self, data: bytes) -> None:
        assert data == OFF
        self.sent.append((ALL, round(self.port.clock.now(), 6)))

    def _servo(self, number: int, failures: list[BaseException]) -> Any:
        def write(register: str, value: int, attempts: int | None = None) -> None:
            assert (register, value) in (("Torque Enable", 0), ("Bus Watchdog", 0))
            self.sent.append((number, round(self.port.clock.now(), 6)))
            self.attempts.append(attempts)
            if failures:
                raise failures.pop(0)

        return SimpleNamespace(
            id=number,
            table=load_control_table("XM430-W350"),
            read_despite_error=lambda _: self.watchdogs[number],
            read_surely=lambda _: self.watchdogs[number],
            write_despite_error=write,
            write_once=partial(write, attempts=1),
        )

    def cut(self, *silent: Joint) -> Any:
        self.interrupts: list[BaseException] = []
        return cut_torque(self.port, self.servos, silent, WATCHDOG_S, self.interrupts)


def test_all_are_told_twice_at_once_and_each_is_polled_once() -> None:
    bench = Bench()
    assert bench.cut() == (tuple(JOINTS), ())
    assert [who for who, _ in bench.sent] == [ALL, FIRST, SECOND]
    assert bench.attempts == [1, 1]


QUIET_S = WATCHDOG_S + 0.025
"""How long nothing is sent: the watchdog counts in steps of 20 ms."""


def test_after_a_missing_reply_nothing_feeds_any_watchdog_until_it_has_acted() -> None:
    bench = Bench(first=[NoReply("nothing")])
    assert bench.cut() == (tuple(JOINTS), ())
    assert bench.sent == [(ALL, 0.0), (FIRST, 0.0), (ALL, QUIET_S), (FIRST, QUIET_S), (SECOND, QUIET_S)]
    assert bench.attempts == [1, None, None]


def test_after_a_damaged_reply_all_are_told_again_and_the_others_polled_at_once() -> None:
    bench = Bench(first=[WrongReply("noise")])
    assert bench.cut() == (tuple(JOINTS), ())
    assert bench.sent == [*((who, 0.0) for who in (ALL, FIRST, ALL, SECOND)), (ALL, QUIET_S), (FIRST, QUIET_S)]


def test_with_a_servo_that_was_silent_before_all_are_told_and_none_is_polled_until_its_watchdog_has_acted() -> None:
    bench = Bench()
    assert bench.cut(JOINTS[1]) == (tuple(JOINTS), ())
    quiet = 0.002 + QUIET_S
    assert bench.sent == [(ALL, 0.0), (ALL, 0.001), (ALL, 0.002), (ALL, quiet), (FIRST, quiet), (SECOND, quiet)]


def test_one_that_is_never_confirmed_is_named_with_the_last_reason() -> None:
    bench = Bench(second=[NoReply("silent"), DriverError()])
    assert bench.cut() == ((JOINTS[0],), ((JOINTS[1], "DriverError"),))


def test_on_a_lost_port_nothing_waits_and_all_are_tried_once() -> None:
    bench = Bench(first=[PortLost("gone")])

    def lose(_: bytes) -> None:
        raise PortLost("gone")

    confirmed, unconfirmed = bench.cut()
    assert confirmed == (JOINTS[1],) and unconfirmed == ((JOINTS[0], "gone"),)
    assert bench.sent == [(who, 0.0) for who in (ALL, FIRST, SECOND)]
    bench.port.write = lose
    bench.sent.clear()
    bench.cut(JOINTS[1])
    assert bench.sent == [(FIRST, 0.0), (SECOND, 0.0)], "those that were silent, too"


@pytest.mark.parametrize(("count", "confirmed"), [(4, True), (5, False)])
def test_an_interrupted_write_is_repeated_five_times_at_most(count: int, confirmed: bool) -> None:
    bench = Bench(first=[KeyboardInterrupt() for _ in range(count)])
    assert (JOINTS[0] in bench.cut()[0]) is True, "it is tried again after the watchdog's time"
    assert len(bench.interrupts) == count
    assert (bench.sent[-1][1] < WATCHDOG_S) is confirmed, "five count as a failure"
    assert [who for who, _ in bench.sent].count(FIRST) == (5 if confirmed else 6)


def test_watchdogs_are_switched_off_whatever_fails() -> None:
    bench = Bench(first=[NoReply("nothing")], second=[KeyboardInterrupt()])
    interrupts: list[BaseException] = []
    assert disarm_watchdogs(bench.servos, interrupts) == {JOINTS[0]}, "the one that had tripped"
    assert [who for who, _ in bench.sent] == [FIRST, SECOND, SECOND] and len(interrupts) == 1


def test_what_is_said_of_one_servo_of_two_and_of_those_without_a_watchdog() -> None:
    first, second = JOINTS
    assert str(TorqueOff((first,), ())) == "Torque is off on the servo, confirmed by reading it back."
    assert str(TorqueOff((first, second), ())) == "Torque is off on both servos, confirmed by reading it back."
    watched = str(TorqueOff((first,), ((second, "It is silent."),), frozenset((first,))))
    assert (
        "NOT CONFIRMED for JOINT 'B' (ID 2, XM430-W350). It is silent." in watched and "Bus Watchdog stops" in watched
    )
    unwatched = str(TorqueOff((first,), ((second, "It is silent."),), frozenset((second,))))
    assert "NOTHING STOPS JOINT 'B' (ID 2, XM430-W350): without a Bus Watchdog" in unwatched


def test_a_reason_that_concerns_several_servos_is_given_once() -> None:
    first, second = JOINTS
    reasons = [(joint, f"{joint.title} does not answer. Check {joint}.") for joint in JOINTS]
    said = str(TorqueOff((), tuple(reasons)))
    both = f"{str(first).upper()} and {str(second).upper()}. Each does not answer. Check it."
    assert both in said and said.count("does not answer") == 1
    said = str(TorqueOff((), ((first, "It is hot."), (second, "It is silent."))))
    assert f"for {str(first).upper()}. It is hot. Nor for {str(second).upper()}. It is silent. The" in said
    wet = by_reason([(joint, "It is hot. It is also wet.") for joint in JOINTS])
    assert wet == {"Each is hot. It is also wet.": JOINTS}
    assert by_reason(reasons[1:]) == {"It does not answer. Check it.": [second]}
    assert by_reason([(first, f"{first.title}: Current Limit reads 3.")]) == {"Current Limit reads 3.": [first]}
    assert by_reason([(first, "It is hot."), (second, "It is silent.")]) == {
        "It is hot.": [first],
        "It is silent.": [second],
    }
    assert and_list("abc") == "a, b and c" and and_list("a") == "a"


def test_the_result_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        TorqueOff((), ()).confirmed = ()  # type: ignore[misc]


def test_signals_are_raised_once_after_the_block() -> None:
    came: list[int] = []
    former = signal.signal(signal.SIGTERM, lambda number, _: came.append(number))
    try:
        with signals_held_back():
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            assert not came
        assert came == [signal.SIGTERM]
        signal.raise_signal(signal.SIGTERM)
        assert len(came) == 2, "its handler is the former one"
    finally:
        signal.signal(signal.SIGTERM, former)


def test_handlers_that_python_did_not_install_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    installed: list[int] = []
    monkeypatch.setattr(signal, "getsignal", lambda number: None if number == signal.SIGHUP else signal.SIG_DFL)
    monkeypatch.setattr(signal, "signal", lambda number, _: installed.append(number))
    with signals_held_back():
        pass
    assert sorted(installed) == sorted(2 * [signal.SIGINT, signal.SIGTERM])


def test_other_threads_touch_no_handler() -> None:
    before = signal.getsignal(signal.SIGINT)
    inside: list[object] = []

    def work() -> None:
        with signals_held_back():
            inside.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert inside == [before]


class Misunderstood:
    """A servo whose answers are given in turn, whatever is asked."""

    def __init__(self, answers: list[int]) -> None:
        self.id, self.title = 1, JOINTS[0].title
        self._answers = iter(answers)

    def read(self, _register: str) -> int:
        answer = next(self._answers, None)
        if answer is None:
            raise NoReply("no reply")
        return answer

    read_despite_error = read
    read_surely = Servo.read_surely


@pytest.mark.parametrize(
    ("answers", "on"),
    [
        ([1, 1, 1], True),
        ([0, 1, 0], False),
        ([1, 3, 1], None),
        ([1, 1, 0], None),
        ([1], None),
        ([0, 1, 1, 1, 1, 1], True),  # switched on between the two readings
        (3 * [0, 1, 1], None),
    ],
)
def test_torque_is_known_only_from_answers_to_the_question(answers: list[int], on: bool | None) -> None:
    assert is_torque_on(Misunderstood(answers)) is on  # type: ignore[arg-type]


@pytest.mark.parametrize(("answers", "is_named"), [([1, 1, 1, 1, 0], True), ([0], False), ([1, *3 * [1, 3]], False)])
def test_no_other_program_is_accused_by_an_answer_to_another_question(answers: list[int], is_named: bool) -> None:
    found = switched_on({JOINTS[0]: Misunderstood(answers)})  # type: ignore[dict-item]
    assert found.startswith(JOINTS[0].title) is is_named and bool(found) is is_named


def test_a_servo_that_falls_silent_before_torque_is_on_is_named() -> None:
    with pytest.raises(NoReply):
        switched_on({JOINTS[0]: Misunderstood([1, 1])})  # type: ignore[dict-item]


@pytest.mark.parametrize(("seconds", "value"), [(0.06, 3), (0.1, 5), (0.001, 1)])
def test_watchdogs_are_set_in_units_of_20_ms_in_one_packet(seconds: float, value: int) -> None:
    """Never to 0, which would switch them off."""
    sent: list[bytes] = []
    port: Any = SimpleNamespace(write=sent.append)
    tell_watchdogs(port, {JOINTS[0]: Bench().servos[JOINTS[0]]}, seconds)
    tell_watchdogs(port, {}, seconds)
    assert sent == [encode(BROADCAST_ID, Instruction.SYNC_WRITE, bytes((98, 0, 1, 0, FIRST, value)))]
