"""The Bus Watchdog: fed by any packet on the bus, and tripping in bus time at exactly the right moment."""

from typing import Any

import pytest

from hil.drivers.packet import Instruction, StatusError, encode

LIMIT_S = 0.060  # a watchdog of 3


def test_trips_when_nobody_talks_and_the_current_drops_at_that_moment(bench: Any) -> None:
    bench.arm(watchdog=3, goal_ticks=100)
    heard_at = bench.servo().heard_at
    bench.wait(1.0)
    servo = bench.servo()
    assert servo.watchdog_tripped
    assert servo.goal_current_ticks == 0
    assert servo.torque_enabled
    # The plant was told of the current up to the trip, and of none from there on.
    (trip_at, before), (end, after) = bench.plant.told[-2:]
    assert trip_at == pytest.approx(heard_at + LIMIT_S, abs=1e-12)
    assert before == pytest.approx([0.269, 0.0])
    assert (end, after) == (bench.clock.now(), [0.0, 0.0])
    assert bench.read(1, 98, 1) == 0xFF


def test_any_instruction_on_the_bus_feeds_it(bench: Any) -> None:
    bench.arm(1, watchdog=3, goal_ticks=100)
    for _ in range(20):
        bench.wait(0.045)
        bench.ask(2, Instruction.PING)  # not even to this servo
    assert not bench.servo(1).watchdog_tripped
    assert bench.servo(1).motor_current_a == pytest.approx(0.269)


def test_damaged_packets_and_other_bauds_do_not_feed_it(bench: Any) -> None:
    bench.arm(1, watchdog=3)
    for _ in range(2):
        bench.wait(0.04)
        bench.bus.write(encode(2, Instruction.PING)[:-1] + b"\0")
    assert bench.servo(1).watchdog_tripped


def test_interval_must_be_longer_than_the_setting(bench: Any) -> None:
    bench.arm(watchdog=3)
    heard_at = bench.servo().heard_at
    bench.clock.wait_until(heard_at + LIMIT_S)
    assert not bench.servo().watchdog_tripped
    bench.wait(1e-6)
    assert bench.servo().watchdog_tripped


def test_a_packet_that_comes_too_late_does_not_save_it(bench: Any) -> None:
    bench.arm(watchdog=3, goal_ticks=100)
    bench.wait(0.061)
    assert bench.write(1, 102, 50, 2) == StatusError.DATA_RANGE


def test_does_not_count_while_torque_is_off(bench: Any) -> None:
    assert bench.write(1, 98, 3) == 0
    bench.wait(1.0)
    assert not bench.servo().watchdog_tripped
    assert bench.write(1, 64, 1) == 0  # from here on it counts
    bench.wait(0.05)
    assert not bench.servo().watchdog_tripped
    bench.wait(0.02)
    assert bench.servo().watchdog_tripped


def test_tripped_refuses_every_goal_until_zero_is_written(bench: Any) -> None:
    bench.arm(watchdog=3, goal_ticks=100)
    bench.wait(0.1)
    for address, size in [(100, 2), (102, 2), (104, 4), (116, 4)]:
        assert bench.write(1, address, 1, size) == StatusError.DATA_RANGE
    assert bench.exchange(encode(254, Instruction.SYNC_WRITE, b"\x66\0\x02\0\x01\x32\0")) == []
    assert bench.servo().goal_current_ticks == 0
    assert bench.write(1, 98, 3) == StatusError.DATA_RANGE
    assert bench.write(1, 65, 1) == 0  # other registers are free
    assert bench.write(1, 98, 0) == 0
    assert not bench.servo().watchdog_tripped
    assert bench.write(1, 102, 50, 2) == 0
    assert bench.servo().motor_current_a == pytest.approx(50 * 2.69e-3)
    bench.wait(10.0)
    assert not bench.servo().watchdog_tripped  # 0 is also off


def test_torque_off_does_not_clear_a_trip_and_reboot_does(bench: Any) -> None:
    bench.arm(watchdog=3)
    bench.wait(0.1)
    assert bench.write(1, 64, 0) == 0
    assert bench.servo().watchdog_tripped
    assert bench.ask(1, Instruction.REBOOT).error == 0
    assert not bench.servo().watchdog_tripped


def test_two_watchdogs_trip_one_after_the_other(bench: Any) -> None:
    bench.arm(1, watchdog=5, goal_ticks=100)
    bench.arm(2, watchdog=3, goal_ticks=100)
    heard_at = bench.servo(1).heard_at
    bench.wait(1.0)
    assert bench.servo(1).watchdog_tripped
    assert bench.servo(2).watchdog_tripped
    told = bench.plant.told[-3:]
    assert [until for until, _ in told[:2]] == pytest.approx([heard_at + 0.06, heard_at + 0.10], abs=1e-12)
    assert [list(current) for _, current in told] == [
        pytest.approx([0.269, 0.269]),
        pytest.approx([0.269, 0.0]),
        [0.0, 0.0],
    ]


def test_a_pulled_servo_stops_while_the_bus_goes_on(bench: Any) -> None:
    bench.arm(1, watchdog=3, goal_ticks=100)
    bench.servo(1).connected = False
    for _ in range(3):
        bench.wait(0.03)
        bench.ask(2, Instruction.PING)
    assert bench.servo(1).watchdog_tripped
    assert bench.exchange(encode(1, Instruction.PING)) == []
