"""Bulk and fast bulk reads and writes, Factory Reset, Clear, Control Table Backup, Secondary ID, indirect addresses."""

from collections.abc import Callable
from typing import Any

import pytest

from hil.drivers.packet import BROADCAST_ID, HEADER, Framer, Instruction, StatusError, crc, encode, encode_status
from hil.fakes.servo.registers import all_model_names, load_model
from hil.fakes.servo.servo import BOOT_S

Make = Callable[..., Any]

BACK_UP, RESTORE = b"\x01CTRL", b"\x02CTRL"
CLEAR = b"\x01DXL\x22"


def part(servo_id: int, address: int, length: int) -> bytes:
    return bytes((servo_id,)) + address.to_bytes(2, "little") + length.to_bytes(2, "little")


# Bulk


def test_bulk_read_asks_each_servo_for_something_else(bench: Any) -> None:
    body = part(2, 144, 2) + part(1, 146, 1)
    voltage, temperature = bench.exchange(encode(BROADCAST_ID, Instruction.BULK_READ, body))
    assert (voltage.id, voltage.data) == (2, (120).to_bytes(2, "little"))
    assert (temperature.id, temperature.data) == (1, b"\x23")


def test_bulk_read_breaks_off_at_a_silent_servo(bench: Any) -> None:
    body = part(1, 146, 1) + part(9, 146, 1) + part(2, 146, 1)
    assert [reply.id for reply in bench.exchange(encode(BROADCAST_ID, Instruction.BULK_READ, body))] == [1]


def test_bulk_write_writes_different_registers(bench: Any) -> None:
    body = part(1, 65, 1) + b"\x01" + part(2, 76, 2) + b"\x07\x00" + part(9, 65, 1) + b"\x01"
    assert bench.exchange(encode(BROADCAST_ID, Instruction.BULK_WRITE, body)) == []
    assert bench.servo(1).value("LED") == 1
    assert bench.servo(2).value("Velocity I Gain") == 7


def test_a_bulk_write_cut_short_writes_what_is_whole(bench: Any) -> None:
    body = part(1, 65, 1) + b"\x01" + part(2, 76, 2) + b"\x07"
    bench.exchange(encode(BROADCAST_ID, Instruction.BULK_WRITE, body))
    assert (bench.servo(1).value("LED"), bench.servo(2).value("Velocity I Gain")) == (1, 1920)


def test_fast_bulk_read_is_one_packet_with_growing_crcs(bench: Any) -> None:
    bench.bus.write(encode(BROADCAST_ID, Instruction.FAST_BULK_READ, part(2, 146, 1) + part(1, 144, 2)))
    raw = bench.bus.read(100, 0.01)
    front = HEADER + b"\xfe\x0c\0\x55"
    first = front + b"\0\x02\x23"
    first += crc(first).to_bytes(2, "little")
    second = first + b"\0\x01\x78\0"
    assert raw == second + crc(second).to_bytes(2, "little")
    assert len(list(Framer().feed(raw))) == 1


def test_fast_bulk_read_needs_the_firmware(make_bench: Make) -> None:
    bench = make_bench({"firmware": 44})
    assert bench.exchange(encode(BROADCAST_ID, Instruction.FAST_BULK_READ, part(1, 146, 1))) == []


# Factory Reset


@pytest.mark.parametrize(("option", "kept_id", "kept_baud"), [(0xFF, 1, 1), (1, 5, 1), (2, 5, 3)])
def test_factory_reset(make_bench: Make, option: int, kept_id: int, kept_baud: int) -> None:
    bench = make_bench({"servo_id": 5, "registers": {"Current Limit": 40, "Operating Mode": 0}})
    assert bench.ask(5, Instruction.FACTORY_RESET, bytes((option,))).error == 0
    bench.wait(BOOT_S)
    (servo,) = bench.bus.servos.values()
    assert [servo.value(name) for name in ("ID", "Baud Rate", "Current Limit", "Operating Mode")] == [
        kept_id,
        kept_baud,
        1193,
        3,
    ]
    assert servo.value("Return Delay Time") == 250
    assert (servo.value("Model Number"), servo.value("Firmware Version")) == (1020, 48)


def test_factory_reset_is_the_manuals_packet(bench: Any) -> None:
    request = bytes.fromhex("FFFFFD00 01 0400 06 01 A1E6")
    assert request == encode(1, Instruction.FACTORY_RESET, b"\x01")
    bench.bus.write(request)
    assert bench.bus.read(100, 0.01) == bytes.fromhex("FFFFFD00 01 0400 55 00 A10C")


@pytest.mark.parametrize(("body", "error"), [(b"", StatusError.DATA_LENGTH), (b"\x03", StatusError.DATA_RANGE)])
def test_factory_reset_of_another_kind(bench: Any, body: bytes, error: StatusError) -> None:
    assert bench.ask(1, Instruction.FACTORY_RESET, body).error == error


def test_broadcast_factory_reset_of_everything_is_ignored(bench: Any) -> None:
    bench.write(1, 38, 40, 2)
    assert bench.exchange(encode(BROADCAST_ID, Instruction.FACTORY_RESET, b"\xff")) == []
    assert bench.servo(1).value("Current Limit") == 40
    bench.exchange(encode(BROADCAST_ID, Instruction.FACTORY_RESET, b"\x02"))
    assert bench.servo(1).value("Current Limit") == 1193


# Clear


def test_clear_forgets_turns_when_at_rest(bench: Any) -> None:
    bench.plant.position[0] = 10.0
    before = bench.read(1, 132, 4, signed=True)
    request = encode(1, Instruction.CLEAR, CLEAR)
    assert request == bytes.fromhex("FFFFFD00 01 0800 10 01 44 58 4C 22 B1DC")  # the manual's example
    bench.plant.velocity[0] = 1.0
    (status,) = bench.exchange(request)
    assert status.error == StatusError.RESULT_FAIL
    bench.plant.velocity[0] = 0.0
    bench.plant.position[0] = 10.0
    (status,) = bench.exchange(request)
    assert status.error == 0
    assert bench.read(1, 132, 4, signed=True) == before % 4096


@pytest.mark.parametrize(
    ("body", "error"), [(CLEAR[:-1], StatusError.DATA_LENGTH), (b"\x02DXL\x22", StatusError.DATA_RANGE)]
)
def test_clear_of_another_kind(bench: Any, body: bytes, error: StatusError) -> None:
    assert bench.ask(1, Instruction.CLEAR, body).error == error


# Control Table Backup


def test_backup_and_restore(bench: Any) -> None:
    assert bench.read(1, 147, 1) == 0
    assert bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, RESTORE).error == StatusError.RESULT_FAIL  # nothing there
    bench.write(1, 38, 40, 2)
    bench.write(1, 84, 33, 2)
    assert bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, BACK_UP).error == 0
    assert bench.read(1, 147, 1) == 1
    bench.write(1, 38, 50, 2)
    bench.write(1, 84, 44, 2)
    request = encode(1, Instruction.CONTROL_TABLE_BACKUP, RESTORE)
    assert request[-2:] == bytes.fromhex("9EF5")  # F59E; the manual prints F592
    (status,) = bench.exchange(request)
    assert status.error == 0
    assert (bench.read(1, 38, 2), bench.read(1, 84, 2)) == (40, 33)


def test_backup_is_restored_at_boot_if_asked(bench: Any) -> None:
    bench.write(1, 84, 33, 2)
    bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, BACK_UP)
    for startup, gain in ((0, 800), (2, 33)):
        bench.write(1, 60, startup)
        bench.ask(1, Instruction.REBOOT)
        bench.wait(BOOT_S)
        assert bench.read(1, 84, 2) == gain
        assert bench.read(1, 147, 1) == 1


def test_torque_on_at_boot_if_asked(bench: Any) -> None:
    bench.write(1, 60, 1)
    bench.ask(1, Instruction.REBOOT)
    bench.wait(BOOT_S)
    assert bench.read(1, 64, 1) == 1


def test_backup_needs_torque_off_signature_and_firmware(make_bench: Make) -> None:
    bench = make_bench({}, {"firmware": 44})
    assert bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x01CTR").error == StatusError.DATA_LENGTH
    assert bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, b"\x01CTRX").error == StatusError.DATA_RANGE
    assert bench.ask(2, Instruction.CONTROL_TABLE_BACKUP, BACK_UP).error == StatusError.INSTRUCTION
    bench.arm(1)
    assert bench.ask(1, Instruction.CONTROL_TABLE_BACKUP, BACK_UP).error == StatusError.RESULT_FAIL


# Secondary ID


def test_secondary_id_is_obeyed_and_not_answered(bench: Any) -> None:
    for servo_id in (1, 2):
        assert bench.write(servo_id, 12, 5) == 0
    assert bench.exchange(encode(5, Instruction.WRITE, b"\x41\0\x01")) == []
    assert [bench.servo(i).value("LED") for i in (1, 2)] == [1, 1]
    bench.exchange(encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x41\0\x01\0\x05\x00"))
    assert [bench.servo(i).value("LED") for i in (1, 2)] == [0, 0]


# Indirect addresses


def test_scattered_registers_are_read_and_written_in_one_piece(bench: Any) -> None:
    goal = [102, 103, 84, 85, 65]
    for index, address in enumerate(goal):
        assert bench.write(1, 168 + 2 * index, address, 2) == 0
    body = (224).to_bytes(2, "little") + b"\x64\x00\x21\x00\x01"
    assert bench.ask(1, Instruction.WRITE, body).error == 0
    servo = bench.servo()
    assert [servo.value(name) for name in ("Goal Current", "Position P Gain", "LED")] == [100, 33, 1]
    assert bench.read(1, 224, 5) == int.from_bytes(b"\x64\x00\x21\x00\x01", "little")


def test_present_values_can_be_read_indirectly(bench: Any) -> None:
    for index in range(4):
        bench.write(1, 578 + 2 * index, 132 + index, 2)
    bench.plant.position[0] = 1.0
    assert bench.read(1, 634, 4, signed=True) == bench.read(1, 132, 4, signed=True) == 652


def test_indirect_writes_obey_the_registers_they_reach(bench: Any) -> None:
    bench.write(1, 168, 132, 2)  # Present Position
    assert bench.write(1, 224, 1) == StatusError.ACCESS  # a quarter of it
    bench.write(1, 168, 65, 2)
    assert bench.write(1, 224, 7) == StatusError.DATA_RANGE
    assert bench.write(1, 168, 63, 2) == StatusError.DATA_RANGE  # EEPROM cannot be reached
    assert bench.write(1, 225, 7) == 0  # plain memory as long as its address points at itself
    assert bench.read(1, 225, 1) == 7
    bench.ask(1, Instruction.REBOOT)
    bench.wait(BOOT_S)
    assert bench.read(1, 168, 2) == 224


def test_indirect_addresses_are_in_the_ram_and_so_not_locked(bench: Any) -> None:
    bench.write(1, 64, 1)
    assert bench.write(1, 168, 65, 2) == 0
    bench.write(1, 224, 1)
    assert bench.servo().value("LED") == 1


# Models that are only half known


@pytest.mark.parametrize("name", all_model_names())
def test_every_model_answers(make_bench: Make, name: str) -> None:
    model = load_model(name)
    bench = make_bench({"model": model})
    status = bench.ask(1, Instruction.PING)
    assert status.data[:2] == model.number.to_bytes(2, "little")
    register = model.registers["Torque Enable"]
    assert bench.write(1, register.address, 1, register.size) == 0
    bench.wait(0.1)
    assert bench.servo().torque_enabled
    assert bench.servo().motor_current_a == 0.0  # nothing was asked of it, in whatever mode it starts


def test_the_manuals_status(bench: Any) -> None:
    assert encode_status(1, 0, b"") == bytes.fromhex("FFFFFD00 01 0400 55 00 A10C")
