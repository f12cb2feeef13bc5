"""What the servos hold right before a cycle shows whether another master commands them."""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import BusShared
from hil.drivers.port import ReplyTime

Make = Callable[..., BusConfig]
INTERVAL = 0.01


def after_each(
    bus: ServoBus, act: Callable[[Any], None], cycles: int, interval: float = INTERVAL, late: float = 0.0
) -> float:
    """Drive both joints with goals that change, acting on the servos after each cycle; returns the duration [s]."""
    clock, servos = bus.port.clock, bus.port._serial.bus.servos
    start = clock.now()
    for cycle in range(cycles):
        clock.wait_until(start + cycle * interval)
        bus.exchange([0.01 * (cycle % 30), 0.1 + 0.003 * (cycle % 50)])
        act(servos)
        due = start + (cycle + 1) * interval
        if bus.prepared.read_back_at <= due:
            try:
                bus.check_not_overruled(due)
            finally:
                assert clock.now() <= due + late, "the next sample is not late"
    return float(clock.now() - start)


@contextmanager
def driven(config: BusConfig) -> Iterator[ServoBus]:
    with ServoBus.open(config) as bus, bus.torque(watchdog=0.1):
        yield bus


def nothing(_servos: Any) -> None:
    pass


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("interval", [0.0025, 0.01, 0.05])
def test_servos_that_only_this_program_commands(fake_config: Make, fast: bool, interval: float) -> None:
    with driven(fake_config(fast_sync_read=fast, interval=interval)) as bus:
        after_each(bus, nothing, 100, interval)
        assert bus.prepared.read_back_at > 0.0 and not bus.prepared.is_in_doubt


def test_a_goal_written_after_each_of_ours_is_found_within_a_tenth_of_a_second(fake_config: Make) -> None:
    with driven(fake_config(interval=INTERVAL)) as bus:
        start = bus.port.clock.now()
        with pytest.raises(BusShared, match=r"elbow.*ID 2.* another program: its Goal Current reads -7, but \d+ was"):
            after_each(bus, lambda servos: servos[2].write(102, b"\xf9\xff"), 100)
        assert bus.port.clock.now() - start < 0.1


@pytest.mark.parametrize("when", [20, 21, 22])
def test_a_goal_written_once_is_no_proof(fake_config: Make, when: int) -> None:
    times = iter(range(10_000))

    def once(servos: Any) -> None:
        if next(times) == when:
            servos[1].write(102, b"\xf9\xff")

    with driven(fake_config(interval=INTERVAL)) as bus:
        after_each(bus, once, 100)


@pytest.mark.parametrize(("every", "is_found"), [(400, True), (600, False)])
def test_goals_written_now_and_then_are_found_by_the_third(fake_config: Make, every: int, is_found: bool) -> None:
    times = iter(range(10_000))

    def seldom(servos: Any) -> None:
        if next(times) % every == 20:
            servos[1].write(102, b"\xf9\xff")

    with driven(fake_config(interval=INTERVAL)) as bus:
        if is_found:
            with pytest.raises(BusShared, match=r"shoulder.*another program: its Goal Current reads -7"):
                after_each(bus, seldom, 2 * every + 30)
            assert next(times) <= 2 * every + 22
        else:
            after_each(bus, seldom, 2 * every + 30)


@pytest.mark.parametrize("when", [20, 21, 22])
def test_nor_is_a_goal_of_ours_from_long_ago_seen_twice(fake_config: Make, when: int) -> None:
    """Lost writes leave it, and the status detects those."""
    times = iter(range(10_000))

    def twice(servos: Any) -> None:
        if next(times) in (when, when + 1):
            servos[1].write(102, b"\x07\x00")

    with driven(fake_config(interval=INTERVAL)) as bus:
        after_each(bus, twice, 100)


def test_a_foreign_goal_is_told_from_the_first_sighting_until_some_time_after_the_last(fake_config: Make) -> None:
    with driven(fake_config(interval=INTERVAL)) as bus:

        def once(servos: Any) -> None:
            if not bus.commanded_by_another:
                servos[1].write(102, b"\xf7\xff")

        assert bus.commanded_by_another == ""
        after_each(bus, once, 20)
        assert re.search(r"Goal Current of .*shoulder.* was -9 although \d+ had been", bus.commanded_by_another)
        after_each(bus, nothing, 40)
        assert bus.commanded_by_another == ""


def test_of_a_goal_of_0_no_other_program_is_accused(fake_config: Make) -> None:
    """A tripped watchdog or a reboot also leaves 0."""
    with driven(fake_config(interval=INTERVAL)) as bus:

        def once(servos: Any) -> None:
            if not bus.commanded_by_another:
                servos[2].write(102, b"\0\0")

        after_each(bus, once, 20)
        assert re.search(r"Goal Current of .*elbow.* was 0 although \d+ had been written\.$", bus.commanded_by_another)


def test_a_changed_mode_is_found_within_a_tenth_of_a_second(fake_config: Make) -> None:
    times = iter(range(10_000))

    def taken(servos: Any) -> None:
        if next(times) == 20:
            for address, value in ((64, 0), (11, 3), (64, 1)):
                servos[1].write(address, bytes((value,)))

    with driven(fake_config(interval=INTERVAL)) as bus:
        start = bus.port.clock.now()
        with pytest.raises(BusShared, match=r"shoulder.*its Operating Mode reads 3, but 0 was written"):
            after_each(bus, taken, 100)
        assert 0.2 < bus.port.clock.now() - start < 0.3


@pytest.mark.parametrize("places", [(1, 2), (2, 1)])
def test_a_goal_of_ours_that_came_late_or_to_the_neighbour_is_not_foreign(
    fake_config: Make, places: tuple[int, int]
) -> None:
    source, target = places

    def copied(servos: Any) -> None:
        servos[target].write(102, servos[source].memory.value("Goal Current").to_bytes(2, "little"))

    with driven(fake_config(interval=INTERVAL)) as bus:
        after_each(bus, copied, 100)


def test_what_was_not_read_back_for_lack_of_time_is_tried_again_soon(fake_config: Make) -> None:
    with driven(fake_config(interval=INTERVAL)) as bus:
        bus.exchange([0.1, 0.1])
        now = bus.port.clock.now()
        assert bus.prepared.overruled(now + 2e-4) is None
        assert bus.port.clock.now() == now, "nothing was sent"
        assert now < bus.prepared.read_back_at <= now + 0.005


@pytest.mark.parametrize("interval", [0.001, 0.00125, 0.002, 0.0025, 0.01])
@pytest.mark.parametrize("ticks", [0, 100])
def test_a_watchdog_changed_by_another_program_is_seen_at_any_rate(
    fake_config: Make, interval: float, ticks: int
) -> None:
    """Where cycles leave no time for a read-back, one delays the next cycle now and then, by less than an interval."""
    latest = 0.0
    with driven(fake_config(interval=interval)) as bus:
        clock, servo = bus.port.clock, bus.port._serial.bus.servos[2]
        start = clock.now()
        for cycle in range(round(0.6 / interval)):
            clock.wait_until(start + cycle * interval)
            latest = max(latest, clock.now() - start - cycle * interval)
            bus.exchange([0.01 * (cycle % 30), 0.1])
            if is_changed := cycle * interval >= 0.2:
                servo.write(98, bytes((ticks,)))
            due = start + (cycle + 1) * interval
            if bus.prepared.read_back_at <= due:
                bus.check_not_overruled(due)
            if bus.watchdog_changed is not None:
                break
            assert not is_changed or clock.now() < start + 0.2 + 0.35
        assert bus.watchdog_changed == (1, ticks) and clock.now() > start + 0.2
    assert latest < interval, "no sample is missed"


@pytest.mark.parametrize("interval", [0.001, 1 / 900, 0.00125, 1 / 650, 0.002, 0.0025])
@pytest.mark.parametrize("lost", [0, 1])
def test_lost_torque_is_read_at_any_rate(fake_config: Make, interval: float, lost: int) -> None:
    """Where cycles leave no time for Torque Enable of all servos, one is asked at a time, or a cycle is delayed."""
    with driven(fake_config(interval=interval, fast_sync_read=False)) as bus:
        clock, servo = bus.port.clock, bus.port._serial.bus.servos[lost + 1]
        start = clock.now()
        for cycle in range(round(0.6 / interval)):
            clock.wait_until(start + cycle * interval)
            assert clock.now() < start + (cycle + 1) * interval, "no sample is missed"
            status = bus.exchange([0.01 * (cycle % 30), 0.1]).status
            if is_off := cycle * interval >= 0.2:
                servo.write(64, b"\0")
            due = start + (cycle + 1) * interval
            if bus.prepared.read_back_at <= due:
                bus.check_not_overruled(due)
            if bus.torque_lost is not None or (status and status[lost] and status[lost].torque is False):
                break
            assert not is_off or clock.now() < start + 0.2 + 0.3
        assert is_off and bus.torque_lost in (lost, None)
        assert bus.read_torque() == lost


@pytest.mark.parametrize(("interval", "every"), [(0.00125, 13), (0.00125, 40), (1 / 650, 9)])
def test_goals_written_now_and_then_are_found_where_there_is_time_for_one_servo_only(
    fake_config: Make, interval: float, every: int
) -> None:
    """Each stands until the next cycle overwrites it."""
    times = iter(range(10_000))

    def seldom(servos: Any) -> None:
        if next(times) % every == 5:
            servos[2].write(102, b"\xf9\xff")

    with driven(fake_config(interval=interval, fast_sync_read=False)) as bus:
        start = bus.port.clock.now()
        with pytest.raises(BusShared, match=r"elbow.*Goal Current reads -7"):
            after_each(bus, seldom, round(2.0 / interval), interval, late=interval)
        assert bus.port.clock.now() - start < 12 * every * interval


@pytest.mark.parametrize(("interval", "every"), [(0.01, 0.0), (0.00125, 0.0), (0.001, 0.08), (0.0009, 0.1)])
def test_how_often_goals_are_read_back_is_known_beforehand(fake_config: Make, interval: float, every: float) -> None:
    with ServoBus.open(fake_config(interval=interval, fast_sync_read=False)) as bus:
        told, shortest = bus.prepared.read_back_every(bus.port.off_wire)
        assert told == pytest.approx(every, rel=0.3)
        assert (interval >= shortest) is (every == 0.0)
        assert bus.prepared.read_back_every(0.01)[0] == math.inf


def test_a_servo_that_does_not_answer_is_asked_once_more_and_left_to_the_next_cycle(fake_config: Make) -> None:
    interval = 0.0025
    with driven(fake_config(interval=interval)) as bus:
        bus.exchange([0.1, 0.1])
        bus.port._serial.bus.servos[2].connected = False
        due = bus.port.clock.now() + interval
        bus.check_not_overruled(due)
        assert due < bus.port.clock.now() <= due + 1e-3
        bus.check_not_overruled(bus.port.clock.now() + interval)
        assert bus.port.clock.now() <= due + 1e-3, "a late reply may be on its way"
        state = bus.exchange([0.1, 0.1])
        assert state.missing == (False, True)
        bus.port._serial.bus.servos[2].connected = True
        assert bus.exchange([0.1, 0.1]).missing == (False, False)


def test_in_a_long_cycle_a_lost_read_back_is_not_repeated(fake_config: Make) -> None:
    with driven(fake_config(interval=INTERVAL)) as bus:
        bus.exchange([0.1, 0.1])
        bus.port._serial.bus.servos[2].connected = False
        due = bus.port.clock.now() + INTERVAL
        bus.check_not_overruled(due)
        assert bus.port.clock.now() <= due
        bus.port._serial.bus.servos[2].connected = True


def test_a_program_whose_packets_destroy_the_read_backs_is_found_at_its_second_goal(fake_config: Make) -> None:
    """It writes every 13 cycles, at a moment when the servos answer a read-back."""
    interval, read_backs = 0.0025, 0
    with driven(fake_config(interval=interval)) as bus:
        ask, servos = bus.port.ask, bus.port._serial.bus.servos

        def collides(data: bytes, count: int, expected: ReplyTime, start: float) -> bytes:
            nonlocal read_backs
            received = ask(data, count, expected, start)
            read_backs += data in [read.request for read in bus.prepared._read_back.reads]  # type: ignore[union-attr]
            if read_backs % 13 != 5 or b"\x83" in data[:16]:
                return received
            servos[1].write(102, b"\xf9\xff")
            read_backs += 1
            return received[:4]

        with mock.patch.object(bus.port, "ask", collides), pytest.raises(BusShared, match="Goal Current reads -7"):
            after_each(bus, nothing, 100, interval, late=1e-3)
        assert read_backs <= 5 + 2 * 13


@pytest.mark.parametrize(
    ("interval", "every", "phase"),
    [(0.01, 2, 0), (0.01, 2, 1), (0.01, 3, 0), (0.01, 3, 1), (0.01, 3, 2), (0.0025, 20, 0), (0.0025, 13, 8)],
)
def test_a_program_that_overwrites_some_goals_regularly_is_found_at_its_third_goal_at_the_latest(
    fake_config: Make, interval: float, every: int, phase: int
) -> None:
    """One may be missed at 400 Hz, because the modes are read then."""
    times = iter(range(10_000))
    foreign: list[float] = []

    with driven(fake_config(interval=interval)) as bus:

        def sometimes(servos: Any) -> None:
            if next(times) % every == phase:
                servos[2].write(102, b"\xf9\xff")
                foreign.append(bus.port.clock.now())

        with pytest.raises(BusShared, match="Goal Current reads -7"):
            after_each(bus, sometimes, 5 * every, interval)
        assert len(foreign) <= 3


@pytest.mark.parametrize("interval", [0.004, 0.005, 1 / 150, 0.01])
@pytest.mark.parametrize("adapter_us", [60, 1000])
def test_foreign_goals_are_found_at_every_rate_although_the_status_takes_time_too(
    fake_config: Make, fake_file: Callable[..., str], interval: float, adapter_us: int
) -> None:
    url = fake_file(("latency_us = 60", f"latency_us = {adapter_us}"))
    with driven(fake_config(url, interval=interval)) as bus:
        start = bus.port.clock.now()
        with pytest.raises(BusShared, match="another program"):
            after_each(bus, lambda servos: servos[2].write(102, b"\xf9\xff"), 100, interval)
        assert bus.port.clock.now() - start < 0.1


def test_one_long_read_back_is_not_the_last(fake_config: Make) -> None:
    with driven(fake_config(interval=INTERVAL)) as bus:
        after_each(bus, nothing, 20)
        assert bus.prepared._read_back is not None
        bus.prepared._read_back.took(0.02)  # this program was suspended during it
        start = bus.port.clock.now()
        with pytest.raises(BusShared):
            after_each(bus, lambda servos: servos[2].write(102, b"\xf9\xff"), 200)
        assert bus.port.clock.now() - start < 1.0


@pytest.mark.parametrize(("every", "is_lost"), [(2, True), (4, False), (8, False)])
def test_a_servo_that_misses_half_of_its_goals_is_found_although_others_arrive(
    fake_config: Make, every: int, is_lost: bool
) -> None:
    cycle, held = 0, b""

    def lose(servos: Any) -> None:
        nonlocal cycle, held
        cycle += 1
        if cycle % every == 0:
            servos[2].write(102, held)  # as if the latest goal had not arrived
        held = servos[2].goal_current_ticks.to_bytes(2, "little")

    with driven(fake_config(interval=INTERVAL)) as bus:
        after_each(bus, lose, 7 if is_lost else 60)
        assert (bus.goals_lost is not None) == is_lost
        if is_lost:
            joint, held_instead = bus.goals_lost
            assert joint == 1 and re.fullmatch(r"its Goal Current reads \d+ but \d+ was written", held_instead)
