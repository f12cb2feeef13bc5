"""The limit that is lowered for a run, old firmware, and servos that a killed program left behind."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import serial

from hil.drivers.errors import TorqueNotOff, WrongModel
from hil.errors import StopRequested
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan
from hil.runs.run_folder import RunFolder
from tests.support.stops.stopped_runs import Arm, assert_stopped, fault, once, run_until_stopped


def test_the_servos_own_current_limit_is_lowered_for_the_run_and_restored_after_a_stop(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    seen: list[list[int]] = []

    def limits() -> list[int]:
        return [servo.value("Current Limit") for servo in ports[0].bus.servos.values()]

    def look() -> None:
        seen.append(limits())
        fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=-120)

    run_until_stopped(arm(), tmp_path / "run", once(look), plan)
    assert seen == [[447, 298]], "1.2 and 0.8 A in ticks of 2.69 mA, rounded up"
    assert limits() == [1193, 1193]


@pytest.fixture
def as_found(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], None]], None]:
    """Applies a change to each servo before the port is opened."""

    def prepare(change: Callable[[Any], None]) -> None:
        opened = serial.serial_for_url

        def open_changed(*args: Any, **kwargs: Any) -> Any:
            port = opened(*args, **kwargs)
            for servo in port.bus.servos.values():
                change(servo)
            return port

        monkeypatch.setattr(serial, "serial_for_url", open_changed)

    return prepare


def has_old_firmware(servo: Any) -> None:
    if servo.value("ID") == 2:
        servo.memory.set("Firmware Version", 37)


def was_left_by_a_killed_program(servo: Any) -> None:
    """Leave the servo with torque on, a tripped watchdog and a lowered Current Limit."""
    servo.write(11, b"\x00")  # Operating Mode: current
    servo.write(38, (447).to_bytes(2, "little"))
    servo.write(64, b"\x01")
    servo.trip_watchdog()


Found = Callable[[Callable[[Any], None]], None]


def test_firmware_without_a_bus_watchdog_is_refused(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    config = arm()
    with pytest.raises(WrongModel, match=r"'elbow' \(ID 2.*firmware 37 has no Bus Watchdog.*allow_no_watchdog = true"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])
    assert not any(servo.value("Bus Watchdog") for servo in ports[0].bus.servos.values())


def test_firmware_without_a_bus_watchdog_runs_where_the_user_says_so(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    armed: list[tuple[int, ...]] = []
    config = arm(("[experiment]\n", "[safety]\nallow_no_watchdog = true\n\n[experiment]\n"))

    def look() -> None:
        armed.append(tuple(servo.value("Bus Watchdog") for servo in ports[0].bus.servos.values()))
        os.kill(os.getpid(), signal.SIGINT)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(StopRequested):
        run_experiment(config, run, config.path, once(look), plan)
    assert armed == [(4, 0)], "20 ms units: the servo that has a watchdog has it armed, the other is not written to"
    assert_stopped(ports[0])


def test_a_servo_without_a_watchdog_that_falls_silent_is_said_to_go_on(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    config = arm(("[experiment]\n", "[safety]\nallow_no_watchdog = true\n\n[experiment]\n"))
    pull = once(lambda: setattr(ports[0].bus.servos[2], "connected", False))
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(TorqueNotOff, match=r"NOTHING STOPS JOINT 'ELBOW' \(ID 2.*cut the power now"):
        run_experiment(config, run, config.path, pull, plan)
    port = ports[0]
    port.clock.wait_until(port.clock.now() + 1.0)
    assert not port.bus.servos[1].torque_enabled
    assert port.bus.servos[2].motor_current_a != 0.0, "and it does"


def test_servos_that_a_killed_program_left_behind_are_taken_over(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(was_left_by_a_killed_program)
    config = arm()
    said = run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert said == "Torque is off on both servos, confirmed by reading it back."
    servos = ports[0].bus.servos.values()
    assert not any(servo.torque_enabled or servo.value("Bus Watchdog") for servo in servos)
