"""The control table as a state machine, through the instructions of single packets."""

from collections.abc import Callable
from typing import Any

import pytest

from hil.drivers.packet import ALERT, HardwareError, Instruction, StatusError, encode
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import BOOT_S, EmulatedServo

Make = Callable[..., Any]


def test_ping_says_model_and_firmware(bench: Any) -> None:
    status = bench.ask(1, Instruction.PING)
    assert (status.error, status.data) == (0, b"\xfc\x03\x30")  # 1020, firmware 48


def test_read_and_write(bench: Any) -> None:
    assert bench.write(2, 65, 1) == StatusError.NONE
    assert bench.read(2, 65, 1) == 1
    assert bench.read(1, 65, 1) == 0
    assert bench.read(1, 0, 2) == 1020


def test_write_of_several_registers_asks_each_of_them(bench: Any) -> None:
    address = (76).to_bytes(2, "little")
    gains = (100).to_bytes(2, "little") + (200).to_bytes(2, "little")
    assert bench.ask(1, Instruction.WRITE, address + gains).error == 0
    assert (bench.servo().value("Velocity I Gain"), bench.servo().value("Velocity P Gain")) == (100, 200)
    too_much = (16_384).to_bytes(2, "little") + (7).to_bytes(2, "little")
    assert bench.ask(1, Instruction.WRITE, address + too_much).error == StatusError.DATA_RANGE
    assert (bench.servo().value("Velocity I Gain"), bench.servo().value("Velocity P Gain")) == (100, 7)


@pytest.mark.parametrize(
    ("address", "value", "size", "error"),
    [
        (64, 2, 1, StatusError.DATA_RANGE),
        (9, 255, 1, StatusError.DATA_RANGE),
        (8, 8, 1, StatusError.DATA_RANGE),
        (11, 2, 1, StatusError.DATA_RANGE),  # between two operating modes
        (98, 128, 1, StatusError.DATA_RANGE),
        (102, 5, 1, StatusError.DATA_LENGTH),  # half of Goal Current
        (103, 5, 1, StatusError.DATA_LENGTH),  # the other half
        (116, 5, 2, StatusError.DATA_LENGTH),
        (102, 1194, 2, StatusError.DATA_LIMIT),
        (102, -1194, 2, StatusError.DATA_LIMIT),
        (100, 886, 2, StatusError.DATA_LIMIT),
        (104, 201, 4, StatusError.DATA_LIMIT),
        (116, 4096, 4, StatusError.DATA_LIMIT),  # the factory's mode is position control
        (0, 1, 2, StatusError.ACCESS),
        (132, 1, 4, StatusError.ACCESS),
        (132, 1, 1, StatusError.ACCESS),  # a quarter of Present Position
        (134, 1, 2, StatusError.ACCESS),
        (66, 1, 1, StatusError.ACCESS),  # no register there
        (700, 1, 1, StatusError.ACCESS),
    ],
)
def test_refused_writes(bench: Any, address: int, value: int, size: int, error: StatusError) -> None:
    before = bytes(bench.servo().memory.data)
    assert bench.write(1, address, value, size) == error
    assert bytes(bench.servo().memory.data) == before


@pytest.mark.parametrize(("address", "length"), [(66, 1), (146, 8), (700, 4), (64, 0)])
def test_refused_reads(bench: Any, address: int, length: int) -> None:
    body = address.to_bytes(2, "little") + length.to_bytes(2, "little")
    status = bench.ask(1, Instruction.READ, body)
    assert (status.error, status.data) == (StatusError.ACCESS, b"")


def test_a_gap_between_registers_reads_zero(bench: Any) -> None:
    status = bench.ask(1, Instruction.READ, b"\x40\0\x05\0")  # 64..68: torque, LED, two undefined, status level
    assert status.data == b"\0\0\0\0\x02"


@pytest.mark.parametrize("instruction", [Instruction.WRITE, Instruction.REG_WRITE, Instruction.READ])
def test_instruction_cut_short(bench: Any, instruction: Instruction) -> None:
    assert bench.ask(1, instruction, b"\x40\0").error == StatusError.DATA_LENGTH


@pytest.mark.parametrize(
    "instruction", [0x77, Instruction.BULK_READ, Instruction.FAST_BULK_READ, Instruction.SYNC_READ]
)
def test_undefined_instruction(bench: Any, instruction: int) -> None:
    assert bench.ask(1, instruction, b"\x01").error == StatusError.INSTRUCTION


def test_damaged_packet_gets_a_crc_error(bench: Any) -> None:
    damaged = bytearray(encode(1, Instruction.WRITE, b"\x40\0\x01"))
    damaged[-1] ^= 1
    (status,) = bench.exchange(bytes(damaged))
    assert (status.id, status.error) == (1, StatusError.CRC)
    assert not bench.servo().torque_enabled


def test_eeprom_is_locked_while_torque_is_on(bench: Any) -> None:
    bench.arm()
    for address, value in [(11, 3), (38, 100), (7, 9), (8, 1)]:
        size = 2 if address == 38 else 1
        assert bench.write(1, address, value, size) == StatusError.ACCESS
    assert bench.servo().operating_mode == 0
    assert bench.write(1, 64, 0) == 0
    assert bench.write(1, 11, 3) == 0
    assert bench.servo().operating_mode == 3


def test_goal_current_is_held_to_the_current_limit_register(bench: Any) -> None:
    assert bench.write(1, 38, 300, 2) == 0
    assert bench.write(1, 11, 0) == 0
    assert bench.write(1, 102, -300, 2) == 0
    assert bench.write(1, 102, 301, 2) == StatusError.DATA_LIMIT
    assert bench.servo().goal_current_ticks == -300


def test_changing_the_operating_mode_sets_goal_current_to_its_limit(bench: Any) -> None:
    assert bench.write(1, 38, 500, 2) == 0
    assert bench.write(1, 102, 0, 2) == 0
    assert bench.write(1, 11, 0) == 0
    assert bench.servo().goal_current_ticks == 500
    # So torque without a goal first is full current: what a careful client avoids.
    assert bench.write(1, 64, 1) == 0
    assert bench.servo().motor_current_a == pytest.approx(500 * 2.69e-3)


def test_current_flows_in_current_mode_with_torque_only(bench: Any) -> None:
    assert bench.write(1, 64, 1) == 0
    assert bench.servo().torque_enabled
    assert bench.servo().motor_current_a == 0.0  # position mode: not simulated, no current
    assert bench.write(1, 64, 0) == 0
    bench.arm(goal_ticks=-100)
    assert bench.servo().motor_current_a == pytest.approx(-0.269)
    assert bench.write(1, 64, 0) == 0
    assert bench.servo().motor_current_a == 0.0


def test_present_values_in_ticks(make_bench: Make) -> None:
    bench = make_bench({"zero_ticks": 3072, "direction": -1}, {"zero_ticks": 2048})
    bench.plant.position[:] = [0.5, -0.25]
    assert bench.read(1, 132, 4, signed=True) == 3072 - round(0.5 * 4096 / 6.283185307)
    assert bench.read(2, 132, 4, signed=True) == 2048 - round(0.25 * 4096 / 6.283185307)
    bench.plant.velocity[:] = [-0.9, 0.3]
    assert bench.read(1, 128, 4, signed=True) == round(0.9 / 0.0239808)  # 0.229 rpm
    assert bench.read(1, 122, 1) == 1  # moving
    bench.arm(2, goal_ticks=-74)
    assert bench.read(2, 126, 2, signed=True) == -74
    assert bench.read(1, 144, 2) == 120
    assert bench.read(1, 146, 1) == 35


def test_goal_turns_the_joint_the_way_the_direction_says(make_bench: Make) -> None:
    bench = make_bench({"direction": -1})
    bench.arm(goal_ticks=100)
    bench.wait(0.1)
    assert bench.servo().motor_current_a == pytest.approx(-0.269)
    assert bench.plant.velocity[0] < 0
    assert bench.read(1, 128, 4, signed=True) > 0  # the servo turns the way it was told


def test_homing_offset_shifts_present_position(bench: Any) -> None:
    assert bench.read(1, 132, 4) == 0
    assert bench.write(1, 20, -500, 4) == 0
    assert bench.read(1, 132, 4, signed=True) == -500


@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288", "XM540-W270"])
def test_reverse_mode_turns_position_velocity_and_current(make_bench: Make, model: str) -> None:
    bench = make_bench({"model": load_model(model)})
    bench.plant.position[0] = 0.1
    before = bench.read(1, 132, 4, signed=True)
    assert bench.write(1, 10, 1) == 0
    assert bench.read(1, 132, 4, signed=True) == 4096 - before
    bench.plant.velocity[0] = 1.0
    assert bench.read(1, 128, 4, signed=True) == -42
    bench.arm(goal_ticks=100)
    assert bench.servo().motor_current_a == pytest.approx(-100 * load_model(model).current_unit_a)


def test_a_goal_beyond_a_limit_that_was_lowered_later_is_limited(bench: Any) -> None:
    bench.arm(goal_ticks=500)
    assert bench.write(1, 64, 0) == 0
    assert bench.write(1, 38, 100, 2) == 0
    assert bench.write(1, 64, 1) == 0
    assert bench.read(1, 102, 2, signed=True) == 500
    assert bench.servo().motor_current_a == pytest.approx(100 * bench.servo().model.current_unit_a)


@pytest.mark.parametrize("model", ["XL430-W250", "XM430-W350"])
@pytest.mark.parametrize(
    "before",
    [
        {"Torque Enable": 1},
        {},
        {"Torque Enable": 1, "PWM Limit": 300},
        {"Drive Mode": 8},
        {"Torque Enable": 1, "Bus Watchdog": 255},
        {"Operating Mode": 3, "Torque Enable": 1},
    ],
    ids=["torque", "no torque", "lower limit", "torque on by goal update", "watchdog tripped", "another mode"],
)
def test_a_goal_pwm_written_as_in_a_control_cycle_does_what_it_does_in_any_write(
    model: str, before: dict[str, int]
) -> None:
    """A write addressed to the Secondary ID always takes the general path."""
    servos = [EmulatedServo(load_model(model), 1) for _ in range(2)]
    states = []
    for servo, write in zip(servos, (servos[0].write, servos[1].write_as_shadow), strict=True):
        servo.memory.set("Operating Mode", 16)
        for name, value in before.items():
            servo.memory.set(name, value)
        servo.fail(HardwareError(0))  # everything that depends on registers is derived anew
        told = []
        for goal in (100, -300, 301, 885, -886, -885, 32767):
            error = write(100, goal.to_bytes(2, "little", signed=True))
            servo.tick(1e-3, 0.1, 0.2, 0.0, 0.2)
            told.append((error, bytes(servo.memory.data), servo.controller.goals, servo.motor_current_a))
        states.append(told)
    assert states[0] == states[1]


def test_reverse_mode_mirrors_the_turns_too(make_bench: Make) -> None:
    bench = make_bench({"model": load_model("XM430-W350"), "zero_ticks": 2048})
    bench.plant.position[0] = 10.0
    assert bench.ask(1, Instruction.REBOOT).error == 0
    bench.wait(BOOT_S)
    within = bench.read(1, 132, 4, signed=True)
    assert within == 8567 - 2 * 4096
    assert bench.write(1, 10, 1) == 0
    assert bench.read(1, 132, 4, signed=True) == 4096 - within
    assert bench.write(1, 10, 0) == 0
    assert bench.read(1, 132, 4, signed=True) == within


@pytest.mark.parametrize("mode", [3, 4, 5])
def test_a_reversed_servo_moves_to_its_goal(make_bench: Make, mode: int) -> None:
    bench = make_bench({"registers": {"Drive Mode": 1, "Operating Mode": mode}, "zero_ticks": 2048})
    bench.plant.gain = 5.0
    assert bench.write(1, 112, 100, 4) == 0
    assert bench.write(1, 80, 2000, 2) == 0  # damping: the inertia on this bench has no friction
    assert bench.write(1, 64, 1) == 0
    assert bench.write(1, 116, 2148, 4) == 0
    bench.wait(2.0)
    assert bench.read(1, 132, 4, signed=True) == pytest.approx(2148, abs=40)
    assert bench.plant.position[0] < -0.1


def test_torque_on_by_goal_update(make_bench: Make) -> None:
    bench = make_bench({"registers": {"Drive Mode": 8, "Operating Mode": 0}})
    assert not bench.servo().torque_enabled
    assert bench.write(1, 102, 50, 2) == 0
    assert bench.servo().torque_enabled
    assert bench.servo().motor_current_a == pytest.approx(50 * 2.69e-3)


def test_realtime_tick_counts_milliseconds_and_wraps(bench: Any) -> None:
    bench.wait(1.5)
    assert bench.read(1, 120, 2) == 1500
    bench.clock.wait_until(1.5 + 32.768)
    assert bench.read(1, 120, 2) == 1500


def test_reg_write_waits_for_action(bench: Any) -> None:
    assert bench.ask(1, Instruction.REG_WRITE, b"\x41\0\x01").error == 0
    assert (bench.servo().value("LED"), bench.read(1, 69, 1)) == (0, 1)
    assert bench.ask(1, Instruction.ACTION).error == 0
    assert (bench.servo().value("LED"), bench.read(1, 69, 1)) == (1, 0)
    assert bench.ask(1, Instruction.ACTION).error == StatusError.INSTRUCTION  # nothing is registered now


def test_reg_write_is_checked_when_it_comes(bench: Any) -> None:
    assert bench.ask(1, Instruction.REG_WRITE, b"\x41\0\x07").error == StatusError.DATA_RANGE
    assert bench.ask(1, Instruction.ACTION).error == StatusError.INSTRUCTION


def test_reboot_clears_ram_and_keeps_eeprom(bench: Any) -> None:
    bench.arm(watchdog=5, goal_ticks=100)
    assert bench.write(1, 68, 1) == 0
    (status,) = bench.exchange(encode(1, Instruction.PING))  # level 1 answers pings
    assert status.error == 0
    assert bench.exchange(encode(1, Instruction.REBOOT)) == []  # and no reboot
    servo = bench.servo()
    assert not servo.torque_enabled
    assert servo.motor_current_a == 0.0
    assert (servo.value("Bus Watchdog"), servo.status_return_level) == (0, 2)
    assert servo.operating_mode == 0
    assert bench.exchange(encode(1, Instruction.PING)) == []  # still booting
    bench.wait(BOOT_S)
    assert bench.ask(1, Instruction.PING).error == 0
    assert bench.read(1, 120, 2) < 400


def test_reboot_forgets_turns(make_bench: Make) -> None:
    bench = make_bench({"zero_ticks": 2048})
    bench.plant.position[0] = 10.0
    before = bench.read(1, 132, 4, signed=True)
    assert before == 8567
    assert bench.ask(1, Instruction.REBOOT).error == 0
    bench.wait(BOOT_S)
    assert bench.read(1, 132, 4, signed=True) == before - 2 * 4096


@pytest.mark.parametrize("level", [0, 1, 2])
def test_status_return_level(bench: Any, level: int) -> None:
    assert bench.write(1, 68, level) == 0
    answered = {
        "ping": bench.exchange(encode(1, Instruction.PING)),
        "read": bench.exchange(encode(1, Instruction.READ, b"\x40\0\x01\0")),
        "write": bench.exchange(encode(1, Instruction.WRITE, b"\x41\0\x01")),
        "refused write": bench.exchange(encode(1, Instruction.WRITE, b"\x41\0\x07")),
        "sync read": bench.exchange(encode(254, Instruction.SYNC_READ, b"\x40\0\x01\0\x01")),
    }
    expected = {0: {"ping"}, 1: {"ping", "read", "sync read"}, 2: set(answered)}[level]
    assert {name for name, statuses in answered.items() if statuses} == expected
    assert bench.servo().value("LED") == 1  # written all the same


def test_masked_error_takes_torque_and_only_reboot_gives_it_back(bench: Any) -> None:
    bench.arm(goal_ticks=100)
    bench.servo().fail(HardwareError.OVERLOAD)
    assert not bench.servo().torque_enabled
    assert bench.servo().motor_current_a == 0.0
    assert bench.ask(1, Instruction.PING).error == ALERT
    status = bench.ask(1, Instruction.READ, b"\x46\0\x01\0")
    assert (status.error, status.data[0]) == (ALERT, HardwareError.OVERLOAD)
    assert bench.write(1, 64, 1) == ALERT
    assert not bench.servo().torque_enabled
    assert bench.write(1, 65, 9) == ALERT | StatusError.DATA_RANGE
    assert bench.ask(1, Instruction.REBOOT).error == 0
    bench.wait(BOOT_S)
    assert bench.write(1, 64, 1) == 0
    assert bench.servo().torque_enabled


def test_unmasked_error_raises_the_alert_and_leaves_torque(bench: Any) -> None:
    bench.arm(goal_ticks=100)
    bench.servo().input_voltage_v = 9.0  # below 9.5 V; the factory's Shutdown does not mask it
    assert bench.servo().hardware_error == HardwareError.INPUT_VOLTAGE
    assert bench.servo().torque_enabled
    assert bench.ask(1, Instruction.PING).error == ALERT
    bench.servo().input_voltage_v = 12.0
    assert bench.ask(1, Instruction.PING).error == ALERT  # stays until Reboot


def test_reboot_of_a_servo_that_is_still_hot_brings_its_alert_back(bench: Any) -> None:
    bench.servo().temperature_c = 81
    assert bench.ask(1, Instruction.PING).error == ALERT
    assert bench.ask(1, Instruction.REBOOT).error == 0
    bench.wait(BOOT_S)
    assert bench.ask(1, Instruction.PING).error == ALERT


def test_overheating_shuts_down(bench: Any) -> None:
    bench.arm(goal_ticks=100)
    bench.servo().temperature_c = 81.0
    assert bench.servo().hardware_error == HardwareError.OVERHEATING
    assert not bench.servo().torque_enabled


def test_servo_without_current_mode(make_bench: Make) -> None:
    bench = make_bench({"model": load_model("XL430-W250")})
    assert bench.write(1, 11, 0) == StatusError.DATA_RANGE
    assert bench.write(1, 102, 5, 2) == StatusError.ACCESS
    assert bench.write(1, 64, 1) == 0
    bench.plant.current[0] = 0.4
    assert bench.read(1, 126, 2) == 0
    assert bench.servo().motor_current_a == 0.0
