"""Heating, overload, the supply, the servo's own clock, the current sensor's noise."""

import statistics
from collections.abc import Callable
from typing import Any

import pytest

from hil.drivers.packet import HardwareError
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.faults import Fault
from hil.fakes.bus.supply import Supply
from hil.fakes.servo.health import Overload, Thermal
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import BOOT_S, EmulatedServo
from tests.fakes.conftest import Bench, FreeInertia

Make = Callable[..., Any]

THERMAL = Thermal(resistance_k_w=10.0, time_s=20.0, ambient_c=25.0)


def test_motor_current_warms_the_servo_until_it_shuts_down(make_bench: Make) -> None:
    bench = make_bench({"thermal": THERMAL, "temperature_c": 25.0})
    bench.arm(goal_ticks=500)  # 1.345 A in 5.2 ohm are 9.4 W: 94 K in the end
    bench.wait(10.0)
    servo = bench.servo()
    assert servo.temperature_c == pytest.approx(25 + 94.1 * (1 - 2.718281828**-0.5), abs=1.0)
    assert bench.read(1, 146, 1) == round(servo.temperature_c)
    assert servo.torque_enabled
    bench.wait(12.0)
    assert bench.servo().hardware_error == HardwareError.OVERHEATING
    assert not bench.servo().torque_enabled
    hot = bench.servo().temperature_c
    bench.wait(20.0)
    assert bench.servo().temperature_c == pytest.approx(25 + (hot - 25) * 2.718281828**-1, abs=5.0)


def test_a_servo_with_a_thermal_model_cools_by_it_after_a_fault(make_bench: Make) -> None:
    bench = make_bench({"thermal": THERMAL, "temperature_c": 25.0})
    bench.bus.faults.add(Fault(kind="overheating", duration=1.0))
    bench.wait(20.0)
    assert bench.servo().temperature_c == pytest.approx(25 + 65 * 2.718281828**-1, abs=0.5)
    bench.wait(200.0)
    assert bench.servo().temperature_c == pytest.approx(25, abs=0.1)


def test_a_current_held_too_long_is_an_overload(make_bench: Make) -> None:
    bench = make_bench({"overload": Overload(current_a=0.5, time_s=1.0)})
    bench.arm(goal_ticks=250)
    bench.wait(0.9)
    bench.write(1, 102, 50, 2)
    bench.wait(0.5)  # the timer runs down as fast as it runs up
    bench.write(1, 102, 250, 2)
    bench.wait(0.5)
    assert bench.servo().torque_enabled
    bench.wait(0.2)
    assert bench.servo().hardware_error == HardwareError.OVERLOAD
    assert not bench.servo().torque_enabled
    assert bench.servo().motor_current_a == 0.0
    bench.ask(1, 8)
    bench.wait(BOOT_S)
    bench.arm(goal_ticks=250)
    assert bench.servo().torque_enabled


def on_supply(supply: Supply, **settings: Any) -> Bench:
    servos = [EmulatedServo(load_model("XM430-W350"), servo_id, **settings) for servo_id in (1, 2)]
    bench = Bench(*servos)
    bench.bus = FakeBus(servos, FreeInertia(2, 0.0), bench.clock, supply=supply)
    bench.plant = bench.bus.plant  # type: ignore[assignment]
    return bench


def test_the_supply_sags_under_what_the_bridges_draw() -> None:
    bench = on_supply(Supply(resistance_ohm=1.0))
    bench.arm(1, goal_ticks=500)
    bench.wait(0.1)
    # At rest the bridge is on for R i / V of the time, so the supply gives R i^2 / V.
    volt = 12.0
    for _ in range(50):
        volt = 12.0 - 5.2 * 1.345**2 / volt
    for servo_id in (1, 2):
        assert bench.servo(servo_id).supply_v == pytest.approx(volt, abs=0.01)
    assert bench.read(2, 144, 2) == round(10 * volt)
    assert bench.servo().hardware_error == 0
    bench.arm(2, goal_ticks=1000)
    bench.wait(0.1)
    assert HardwareError.INPUT_VOLTAGE in bench.servo(1).hardware_error
    assert bench.servo(1).torque_enabled  # the factory's Shutdown does not mask it


def test_a_supply_that_breaks_down_boots_the_servos() -> None:
    bench = on_supply(Supply(resistance_ohm=1.0, brownout_v=9.5))
    bench.arm(1, goal_ticks=500)
    bench.arm(2, goal_ticks=1000)
    bench.wait(0.1)
    assert not bench.servo(1).torque_enabled
    assert not bench.servo(2).torque_enabled
    assert bench.exchange(b"\xff\xff\xfd\x00\x01\x03\x00\x01\x19\x4e") == []  # still booting
    bench.wait(BOOT_S)
    assert bench.read(1, 64, 1) == 0


def test_realtime_tick_runs_by_the_servos_own_clock(make_bench: Make) -> None:
    bench = make_bench({"clock_error_ppm": 1000.0}, {"clock_error_ppm": -1000.0})
    bench.wait(10.0)
    assert bench.read(1, 120, 2) == pytest.approx(10_010, abs=1)
    assert bench.read(2, 120, 2) == pytest.approx(10_000, abs=1)  # 10 ms later


def test_current_is_measured_with_noise_that_the_seed_repeats() -> None:
    def measured(seed: int) -> list[int]:
        bench = Bench(EmulatedServo(load_model("XM430-W350"), 1, current_noise_a=0.02, seed=seed))
        bench.plant.current[0] = 0.3
        bench.plant.gain = 0.0
        bench.arm(goal_ticks=112)
        return [bench.read(1, 126, 2, signed=True) for _ in range(400)]

    first = measured(1)
    assert first == measured(1)
    assert first != measured(2)
    assert statistics.mean(first) == pytest.approx(112, abs=1.5)
    assert statistics.stdev(first) == pytest.approx(0.02 / 2.69e-3, rel=0.15)


def test_the_330_series_measures_the_supplys_current() -> None:
    servo = EmulatedServo(load_model("XC330-T288"), 1)
    bench = Bench(servo)
    bench.plant.gain = 0.0
    bench.arm(goal_ticks=400)
    bench.wait(0.1)
    share = 0.4 * servo.model.resistance_ohm / 11.1
    assert bench.read(1, 126, 2) == pytest.approx(400 * share, abs=1)


def test_without_any_of_this_time_passes_in_one_step(make_bench: Make) -> None:
    bench = make_bench()
    bench.arm(goal_ticks=10)
    before = len(bench.plant.told)
    bench.wait(5.0)
    assert bench.servo().torque_enabled
    assert len(bench.plant.told) == before + 1
    assert isinstance(bench.clock, VirtualClock)
