"""What is restored when: no goal that would be torque, no watchdog cleared too early, no signal that hides the rest."""

import signal
from typing import Any

import pytest

from hil.drivers.errors import TorqueNotOff
from hil.drivers.servo_model import Mode
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.experiment.stop_request import StopRequest
from hil.setup.session.servo_session import servo_session
from tests.support.bench import SHORT, Arm, Bench

TORQUE_ENABLE, GOAL_PWM, GOAL_CURRENT, WATCHDOG = 64, 100, 102, 98


@pytest.fixture(autouse=True)
def _unusual_settings(bench: Bench) -> None:
    """Values to restore that a change of mode does not restore by itself."""

    def prepare(port: Any) -> None:
        for name, value in (("Goal Current", 700), ("Goal PWM", 500), ("Position P Gain", 900), ("Current Limit", 900)):
            port.bus.servos[2].memory.set(name, value)

    bench.prepare = prepare


def rewrite(bench: Bench, change: Any) -> list[tuple[int, bool, bytes]]:
    """Pass every write to servo 2 through `change(address, data)`, which returns the data to write, or None.

    Returns a list of the writes: address, whether the motor is in current mode with torque on, data.
    """
    servo = bench.servos[2]
    write, seen = servo.write, []

    def changed(address: int, data: bytes, *more: Any, **named: Any) -> Any:
        instead = change(address, data)
        seen.append((address, servo.torque_enabled and servo.value("Operating Mode") == Mode.CURRENT, data))
        return 0 if instead is None else write(address, instead, *more, **named)

    servo.write = changed
    return seen


def test_a_servo_that_says_off_but_locks_its_eeprom_is_not_said_to_be_off_and_its_watchdog_stops_it(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = arm(SHORT)
    with pytest.raises(TorqueNotOff) as ended, servo_session(config) as bus, bus.torque(config.safety.watchdog):
        servo = bench.servos[2]
        rewrite(bench, lambda address, data: None if address == TORQUE_ENABLE else data)
        read = servo.read
        monkeypatch.setattr(servo, "read", lambda at, n: (0, b"\x00") if (at, n) == (TORQUE_ENABLE, 1) else read(at, n))
    assert str(ended.value).startswith("TORQUE OFF IS NOT CONFIRMED for JOINT 'ELBOW' (ID 2, XM430-W350). Its Torque")
    assert "it refuses to change Operating Mode" in str(ended.value)
    assert servo.torque_enabled and servo.value("Bus Watchdog") == 255 and servo.value("Goal Current") == 0


@pytest.mark.parametrize("after", range(4))
def test_no_goal_is_restored_where_it_would_be_torque(arm: Arm, bench: Bench, after: int) -> None:
    """Another program switches torque on once, just before one of the writes of this program."""
    config, count = arm(SHORT), [-1]

    def meddle(address: int, data: bytes) -> bytes:
        count[0] += 1
        if count[0] == after:
            bench.servos[2].memory.set("Torque Enable", 1)
        return data

    with pytest.raises(ExperimentError, match="Another program switched torque on"), servo_session(config) as bus:
        with bus.torque(config.safety.watchdog):
            pass
        seen = rewrite(bench, meddle)
    assert bench.changed() == []
    assert not [data for address, drives, data in seen if drives and address in (GOAL_PWM, GOAL_CURRENT) and any(data)]


@pytest.mark.parametrize("stop", [None, SafetyStop("It swings.", Cause.LATE)], ids=["complete", "stopped"])
def test_a_signal_while_settings_are_restored_does_not_hide_what_was_not_restored(
    arm: Arm, bench: Bench, stop: SafetyStop | None
) -> None:
    config = arm(SHORT)

    def interrupted(address: int, data: bytes) -> bytes | None:
        if address == WATCHDOG:
            return data
        if address == GOAL_CURRENT:
            signal.raise_signal(signal.SIGINT)
            return None
        return data

    with pytest.raises(BaseException, match="Stopped by Ctrl-C") as ended, StopRequest(), servo_session(config) as bus:
        with bus.torque(config.safety.watchdog):
            pass
        rewrite(bench, interrupted)
        if stop is not None:
            stop.add_note("Torque is off.")
            raise stop
    said = "\n".join(ended.value.__notes__)
    assert "Some settings of joint 'elbow'" in said and "Only Goal Current may differ" in said
    assert ("Torque is off." in said) is (stop is not None)
    assert [each.split(" of ")[0] for each in bench.changed()] == ["Goal Current"]


def test_a_watchdog_that_cannot_be_cleared_leaves_mode_and_limit_restored(arm: Arm, bench: Bench) -> None:
    config = arm(SHORT)
    with pytest.raises(ExperimentError, match="Only Bus Watchdog"), servo_session(config) as bus:
        with bus.torque(config.safety.watchdog):
            pass
        bench.servos[2].memory.set("Bus Watchdog", 10)
        rewrite(bench, lambda address, data: None if address == WATCHDOG else data)
    assert [each.split(" of ")[0] for each in bench.changed()] == ["Bus Watchdog"]
