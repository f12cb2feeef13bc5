"""Statements of the e-Manual and ROBOTIS' own sources, point by point; docs/fake-bus.md names the source of each."""

from collections.abc import Callable
from typing import Any

import pytest

from hil.drivers.packet import Instruction, StatusError, encode
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import BOOT_S

Make = Callable[..., Any]

TURN = 4096


@pytest.mark.parametrize("name", ["XL330-M077", "XL330-M288", "XC330-T181", "XC330-T288", "XC330-M288"])
@pytest.mark.parametrize(("firmware", "data"), [(44, 224), (48, 224), (51, 224), (52, 208), (53, 224), (55, 224)])
def test_indirect_data_of_330_servos_are_elsewhere_with_firmware_52(
    make_bench: Make, name: str, firmware: int, data: int
) -> None:
    bench = make_bench({"model": load_model(name, firmware), "firmware": firmware})
    for index in range(4):
        assert bench.write(1, 180 + 2 * index, 132 + index, 2) == 0  # as dynamixel_hardware_interface does
    bench.plant.position[0] = 1.0
    assert bench.read(1, data + 6, 4, signed=True) == 652
    other = (432 - data + 6).to_bytes(2, "little") + b"\x04\0"
    assert int.from_bytes(bench.ask(1, Instruction.READ, other).data, "little") != 652


def test_indirect_data_of_430_servos_stay_at_224() -> None:
    for firmware in (44, 52, 60):
        assert load_model("XM430-W350", firmware).indirect[0] == (168, 224, 28)


@pytest.fixture
def shadowed(make_bench: Make) -> Any:
    """Return a bench on which servo 2 also listens to ID 1."""
    return make_bench({}, {"registers": {"Secondary(Shadow) ID": 1}})


def test_eeprom_is_not_written_through_a_secondary_id(shadowed: Any) -> None:
    assert shadowed.write(1, 11, 0) == 0  # one status, the first servo's
    assert [shadowed.servo(i).operating_mode for i in (1, 2)] == [0, 3]
    for instruction, body in (
        (Instruction.SYNC_WRITE, b"\x26\0\x02\0\x01\x10\0"),
        (Instruction.REG_WRITE, b"\x26\0\x20\0"),
    ):
        shadowed.exchange(encode(254 if instruction == Instruction.SYNC_WRITE else 1, instruction, body))
    shadowed.exchange(encode(254, Instruction.BULK_WRITE, b"\x01\x26\0\x02\0\x10\0"))
    shadowed.exchange(encode(1, Instruction.ACTION))
    assert shadowed.servo(2).value("Current Limit") == 1193
    assert shadowed.servo(1).value("Current Limit") == 32
    shadowed.ask(1, Instruction.FACTORY_RESET, b"\x02")
    assert shadowed.servo(2).shadow_id == 1


def test_ram_is_written_through_a_secondary_id(shadowed: Any) -> None:
    assert shadowed.write(1, 64, 1) == 0
    assert [shadowed.servo(i).torque_enabled for i in (1, 2)] == [True, True]


@pytest.mark.parametrize("how", ["mode", "torque", "boot"])
def test_present_position_loses_its_turns(make_bench: Make, how: str) -> None:
    bench = make_bench({"registers": {"Operating Mode": 4 if how == "mode" else 3, "Homing Offset": 100}})
    bench.plant.position[0] = 10.0  # 6519 ticks
    assert bench.read(1, 132, 4, signed=True) == 6519 + 100
    if how == "mode":
        assert bench.write(1, 11, 3) == 0
    elif how == "torque":
        assert bench.write(1, 64, 1) == 0
    else:
        bench.ask(1, Instruction.REBOOT)
        bench.wait(BOOT_S)
    within = 6519 - TURN + 100
    assert bench.read(1, 132, 4, signed=True) == within
    if how != "boot":
        assert bench.read(1, 116, 4, signed=True) == within  # and nothing moves


@pytest.mark.parametrize("mode", [0, 1, 4, 5, 16])
def test_present_position_keeps_its_turns_in_other_modes(make_bench: Make, mode: int) -> None:
    bench = make_bench({})
    bench.plant.position[0] = 10.0
    assert bench.write(1, 11, mode) == 0
    if mode in (0, 1, 16):
        assert bench.write(1, {0: 102, 1: 104, 16: 100}[mode], 0, 4 if mode == 1 else 2) == 0
    assert bench.write(1, 64, 1) == 0
    assert bench.read(1, 132, 4, signed=True) == 6519


@pytest.mark.parametrize(("offset", "counts"), [(1024, True), (-1024, True), (1025, False), (-3000, False)])
def test_homing_offset_beyond_a_quarter_turn_is_ignored_in_position_mode(
    make_bench: Make, offset: int, counts: bool
) -> None:
    bench = make_bench({"zero_ticks": 2048})
    assert bench.write(1, 20, offset, 4) == 0
    assert bench.read(1, 132, 4, signed=True) == 2048 + offset * counts
    assert bench.read(1, 20, 4, signed=True) == offset
    assert bench.write(1, 11, 4) == 0
    assert bench.read(1, 132, 4, signed=True) == 2048 + offset
    assert bench.write(1, 11, 3) == 0
    assert bench.read(1, 132, 4, signed=True) == 2048 + offset * counts


def test_homing_offset_keeps_its_sign_in_reverse_mode(make_bench: Make) -> None:
    bench = make_bench({"zero_ticks": 1000, "registers": {"Drive Mode": 1, "Homing Offset": 50}})
    assert bench.read(1, 132, 4, signed=True) == TURN - 1000 + 50


def test_a_led_byte_out_of_range_does_not_keep_the_goal_from_being_taken(make_bench: Make) -> None:
    """The order in ROBOTIS' example indirect_address: Goal Position followed by LED in one Sync Write."""
    bench = make_bench({})
    for index, address in enumerate((116, 117, 118, 119, 65)):
        assert bench.write(1, 168 + 2 * index, address, 2) == 0
    assert bench.write(1, 64, 1) == 0
    bench.exchange(encode(254, Instruction.SYNC_WRITE, b"\xe0\0\x05\0\x01\xe8\x03\0\0\xff"))
    assert (bench.servo().value("Goal Position"), bench.servo().value("LED")) == (1000, 0)
    body = b"\xe0\0\xd0\x07\0\0\xff"
    assert bench.ask(1, Instruction.WRITE, body).error == StatusError.DATA_RANGE
    assert bench.servo().value("Goal Position") == 2000


def test_xl320_takes_its_torque_limit_from_max_torque_when_it_is_switched_on(make_bench: Make) -> None:
    bench = make_bench({"model": load_model("XL320"), "registers": {"Max Torque": 400}})
    assert bench.read(1, 35, 2) == 400
    assert bench.write(1, 35, 200, 2) == 0
    assert bench.read(1, 35, 2) == 200


def test_xl320_has_a_led_of_three_colours(make_bench: Make) -> None:
    bench = make_bench({"model": load_model("XL320")})
    assert bench.write(1, 25, 7) == 0
    assert bench.write(1, 25, 8) == StatusError.DATA_RANGE
    assert bench.read(1, 25, 1) == 7
    assert bench.read(1, 29, 1) == 32  # P Gain, as from the factory
