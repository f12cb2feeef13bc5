"""The wire: timing of bytes, who replies, groups, broadcasts, noise and collisions. Two servos at 1 MBd."""

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.drivers.packet import (
    BROADCAST_ID,
    HEADER,
    Framer,
    Instruction,
    StatusError,
    crc,
    encode,
    encode_status,
)
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import BOOT_S, EmulatedServo

Make = Callable[..., Any]

BYTE_S = 10e-6
PING = encode(1, Instruction.PING)
STATE = b"\x7e\0\x0a\0"  # Present Current, Velocity, Position: 10 bytes at 126


def sync_read(address: int, length: int, *ids: int, fast: bool = False) -> bytes:
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return encode(BROADCAST_ID, instruction, address.to_bytes(2, "little") + length.to_bytes(2, "little") + bytes(ids))


# When


def test_reply_comes_after_wire_time_both_ways(bench: Any) -> None:
    bench.bus.write(PING)
    reply = bench.bus.read(14, 1.0)
    assert len(reply) == 14
    assert bench.clock.now() == pytest.approx((len(PING) + 14) * BYTE_S, abs=1e-12)


def test_return_delay_and_adapter_latency_add_up(make_bench: Make) -> None:
    bench = make_bench({"return_delay_us": 500}, adapter_latency_us=60.0)
    bench.bus.write(PING)
    assert bench.bus.in_waiting == 0
    assert len(bench.bus.read(1, 1.0)) == 1
    assert bench.clock.now() == pytest.approx((len(PING) + 1) * BYTE_S + 500e-6 + 60e-6, abs=1e-12)
    assert len(bench.bus.read(13, 1.0)) == 13
    assert bench.clock.now() == pytest.approx((len(PING) + 14) * BYTE_S + 560e-6, abs=1e-12)


def test_read_times_out_with_what_has_come(bench: Any) -> None:
    bench.bus.write(PING)
    head = bench.bus.read(14, (len(PING) + 5) * BYTE_S + 1e-9)
    assert len(head) == 5
    assert bench.clock.now() == pytest.approx((len(PING) + 5) * BYTE_S, abs=2e-9)
    assert bench.bus.read(14, 0.0) == b""
    assert head + bench.bus.read(9, 1.0) == encode_status(1, 0, b"\xfc\x03\x30")
    assert bench.bus.read(1, 0.25) == b""
    assert bench.clock.now() == pytest.approx((len(PING) + 14) * BYTE_S + 0.25, abs=1e-9)


def test_waiting_in_a_loop_reaches_the_end_of_a_timeout(bench: Any) -> None:
    bench.clock.wait_until(1000.1)
    end = bench.clock.now() + 0.034
    for _ in range(5):
        bench.bus.read(1, max(0.0, end - bench.clock.now()))
    assert bench.clock.now() >= end


def test_a_packet_acts_when_its_last_byte_arrives(bench: Any) -> None:
    bench.arm(goal_ticks=0)
    start = bench.clock.now()
    goal = encode(1, Instruction.WRITE, b"\x66\0\x64\0")
    bench.bus.write(goal)
    bench.wait(0.1)
    bench.bus.advance(bench.clock.now())
    (quiet_until, quiet), (_, driven) = bench.plant.told[-2:]
    assert quiet_until == pytest.approx(start + len(goal) * BYTE_S, abs=1e-12)
    assert quiet == [0.0, 0.0]
    assert driven == pytest.approx([0.269, 0.0])
    assert bench.plant.velocity[0] == pytest.approx(50 * 0.269 * (start + 0.1 - quiet_until))


def test_bytes_wait_for_those_still_being_sent(bench: Any) -> None:
    sync_write = encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x41\0\x01\0\x01\x01\x02\x01")
    bench.bus.write(sync_write)
    bench.bus.write(PING)
    bench.bus.read(14, 1.0)
    assert bench.clock.now() == pytest.approx((len(sync_write) + len(PING) + 14) * BYTE_S, abs=1e-12)


def test_sync_read_is_sampled_at_the_end_of_its_instruction(bench: Any) -> None:
    bench.plant.velocity[:] = [10.0, -10.0]
    request = sync_read(132, 4, 1, 2)
    first, second = bench.exchange(request)
    at = len(request) * BYTE_S
    ticks = round(10.0 * at * 4096 / 6.283185307)
    assert ticks == 1
    assert int.from_bytes(first.data, "little") == ticks
    assert int.from_bytes(second.data, "little", signed=True) == -ticks


# Groups


def test_sync_read_answers_in_the_order_asked(make_bench: Make) -> None:
    bench = make_bench({"return_delay_us": 100}, {"return_delay_us": 20})
    request = sync_read(126, 10, 2, 1)
    bench.bus.write(request)
    raw = bench.bus.read(42, 1.0)
    assert [packet.id for packet in Framer().feed(raw)] == [2, 1]
    assert bench.clock.now() == pytest.approx((len(request) + 42) * BYTE_S + 120e-6, abs=1e-12)


@pytest.mark.parametrize("silence", ["absent", "unplugged", "level 0", "other baud", "booting"])
def test_sync_read_breaks_off_at_a_silent_servo(make_bench: Make, silence: str) -> None:
    bench = make_bench({}, {"baud": 57_600} if silence == "other baud" else {}, {})
    middle = 9 if silence == "absent" else 2
    if silence == "unplugged":
        bench.servo(2).connected = False
    elif silence == "level 0":
        bench.write(2, 68, 0)
    elif silence == "booting":
        bench.ask(2, Instruction.REBOOT)
    assert [packet.id for packet in bench.exchange(sync_read(126, 10, 1, middle, 3))] == [1]
    assert bench.exchange(sync_read(126, 10, middle, 1)) == []


def test_a_refusal_in_a_sync_read_is_an_answer(make_bench: Make) -> None:
    bench = make_bench({"model": load_model("XL430-W250")}, {})
    refused, read = bench.exchange(sync_read(102, 2, 1, 2))
    assert (refused.id, refused.error, refused.data) == (1, StatusError.ACCESS, b"")
    assert (read.id, read.error) == (2, 0)


def test_sync_write_reaches_all_without_an_answer(bench: Any) -> None:
    for servo_id in (1, 2):
        bench.arm(servo_id)
    body = b"\x66\0\x02\0" + b"\x01\x32\0" + b"\x07\x01\0" + b"\x02\xce\xff"
    assert bench.exchange(encode(BROADCAST_ID, Instruction.SYNC_WRITE, body)) == []
    assert [bench.servo(servo_id).goal_current_ticks for servo_id in (1, 2)] == [50, -50]


def test_sync_write_refused_by_one_is_taken_by_the_other(bench: Any) -> None:
    bench.write(1, 38, 40, 2)
    body = b"\x66\0\x02\0" + b"\x01\x32\0" + b"\x02\x32\0"
    before = bench.servo(1).goal_current_ticks
    bench.exchange(encode(BROADCAST_ID, Instruction.SYNC_WRITE, body))
    assert [bench.servo(servo_id).goal_current_ticks for servo_id in (1, 2)] == [before, 50]


def test_goal_and_state_in_one_write(bench: Any) -> None:
    for servo_id in (1, 2):
        bench.arm(servo_id)
    goals = encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x66\0\x02\0\x01\x64\0\x02\x9c\xff")
    start = bench.clock.now()
    bench.bus.write(goals + sync_read(126, 10, 1, 2))
    raw = bench.bus.read(42, 1.0)
    assert bench.clock.now() - start == pytest.approx(78 * BYTE_S, abs=1e-12)  # as observed on a real bus
    first, second = Framer().feed(raw)
    assert [int.from_bytes(p.data[:2], "little", signed=True) for p in (first, second)] == [100, -100]


def test_fast_sync_read_is_the_manuals_packet() -> None:
    """The example on page protocol2: three XC330-T288 in the order 3, 7, 4 at positions 166, 2079 and 1023."""

    class Still:
        joints = 3
        position = [0.0] * 3
        velocity = [0.0] * 3
        current = [0.0] * 3

        def advance(self, until: float, current: object) -> None: ...

    model = load_model("XC330-T288")
    servos = [EmulatedServo(model, number, zero_ticks=ticks) for number, ticks in ((3, 166), (7, 2079), (4, 1023))]
    bus = FakeBus(servos, Still(), VirtualClock())
    request = sync_read(132, 4, 3, 7, 4, fast=True)
    assert request == bytes.fromhex("FFFFFD00FE0A008A840004000307 0420F2")
    bus.write(request)
    raw = bus.read(100, 0.01)
    printed = bytes.fromhex("FFFFFD00FE19005500 03A60000008408 00071F08000016CA 0004FF030000")
    assert raw[:-2] == printed
    assert int.from_bytes(raw[-2:], "little") == crc(printed)


def test_fast_sync_read_is_not_stuffed(bench: Any) -> None:
    bench.arm(1, goal_ticks=-1)
    bench.plant.velocity[0] = -3 * 0.0239808  # FD FF FF FF behind FF FF
    bench.bus.write(sync_read(126, 10, 1, 2, fast=True))
    raw = bench.bus.read(100, 0.01)
    assert len(raw) == 8 + 2 * (10 + 4)
    assert raw[:8] == HEADER + b"\xfe\x1d\0\x55"
    assert raw[8:13] == b"\0\x01\xff\xff\xfd"
    assert raw[20:22] == crc(raw[:20]).to_bytes(2, "little")
    assert raw[22:24] == b"\0\x02"
    assert crc(raw[:-2]).to_bytes(2, "little") == raw[-2:]


def test_fast_sync_read_breaks_off_and_old_firmware_is_silent(make_bench: Make) -> None:
    bench = make_bench({}, {"firmware": 44})
    bench.bus.write(sync_read(126, 10, 1, 2, fast=True))
    raw = bench.bus.read(100, 0.01)
    assert len(raw) == 8 + 14  # announced for two
    assert list(Framer().feed(raw)) == []


def test_replies_are_stuffed(bench: Any) -> None:
    bench.arm(1, goal_ticks=-1)
    bench.plant.velocity[0] = -3 * 0.0239808
    bench.bus.write(sync_read(126, 10, 1))
    raw = bench.bus.read(100, 0.01)
    assert len(raw) == 22
    assert b"\xff\xff\xfd\xfd\xff\xff\xff" in raw
    (packet,) = Framer().feed(raw)
    assert packet.data[:6] == b"\xff\xff\xfd\xff\xff\xff"


# Broadcasts


def test_broadcast_ping_is_answered_by_rising_id(make_bench: Make) -> None:
    bench = make_bench({"servo_id": 8}, {"servo_id": 3, "return_delay_us": 50}, {"servo_id": 5, "baud": 57_600})
    request = encode(BROADCAST_ID, Instruction.PING)
    bench.bus.write(request)
    raw = bench.bus.read(28, 1.0)
    assert [packet.id for packet in Framer().feed(raw)] == [3, 8]
    assert bench.clock.now() == pytest.approx((len(request) + 28) * BYTE_S + 50e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("instruction", "body"),
    [
        (Instruction.READ, b"\x84\0\x04\0"),
        (Instruction.WRITE, b"\x41\0\x01"),
        (Instruction.REG_WRITE, b"\x41\0\x01"),
        (Instruction.ACTION, b""),
        (Instruction.REBOOT, b""),
        (0x77, b""),
    ],
)
def test_broadcast_of_anything_else_has_no_answer(bench: Any, instruction: int, body: bytes) -> None:
    assert bench.exchange(encode(BROADCAST_ID, instruction, body)) == []


def test_broadcast_writes_act_on_all(bench: Any) -> None:
    bench.exchange(encode(BROADCAST_ID, Instruction.REG_WRITE, b"\x41\0\x01"))
    assert [bench.servo(i).value("LED") for i in (1, 2)] == [0, 0]
    bench.exchange(encode(BROADCAST_ID, Instruction.ACTION))
    assert [bench.servo(i).value("LED") for i in (1, 2)] == [1, 1]
    bench.exchange(encode(BROADCAST_ID, Instruction.REBOOT))
    bench.wait(BOOT_S)
    assert [bench.read(i, 65, 1) for i in (1, 2)] == [0, 0]


# Identity and baud


def test_new_id_is_the_one_that_counts(bench: Any) -> None:
    assert bench.write(1, 7, 9) == 0
    assert bench.exchange(PING) == []
    assert bench.ask(9, Instruction.PING).error == 0
    assert set(bench.bus.servos) == {9, 2}


@pytest.fixture
def twins(make_bench: Make) -> Any:
    """A bench with the IDs 1, 1 and 2."""
    return make_bench({}, {"servo_id": 1}, {"servo_id": 2})


def heard(bench: Any, raw: bytes) -> bytes:
    bench.bus.write(raw)
    return bytes(bench.bus.read(1000, 0.01))


def status(servo_id: int, position: int) -> bytes:
    return encode_status(servo_id, 0, position.to_bytes(4, "little"))


READ_POSITION = encode(1, Instruction.READ, b"\x84\0\4\0")


def test_equal_replies_of_two_servos_with_one_id_merge(twins: Any) -> None:
    pongs = [encode_status(servo_id, 0, b"\xfc\x03\x30") for servo_id in (1, 2)]
    assert heard(twins, PING) == pongs[0]
    assert heard(twins, encode(BROADCAST_ID, Instruction.PING)) == b"".join(pongs)
    assert heard(twins, READ_POSITION) == status(1, 0)
    assert heard(twins, sync_read(132, 4, 1, 2)) == status(1, 0) + status(2, 0)
    fast = heard(twins, sync_read(132, 4, 2, 1, fast=True))
    assert fast[8:14] + fast[16:22] == b"\0\2\0\0\0\0\0\1\0\0\0\0"
    assert crc(fast[:-2]) == int.from_bytes(fast[-2:], "little")
    assert twins.write(1, 65, 1) == 0
    assert [servo.value("LED") for servo in twins.bus._servos] == [1, 1, 0]
    assert twins.bus.collisions == 6


def test_different_replies_of_two_servos_with_one_id_are_garbled(twins: Any) -> None:
    twins.plant.position[:2] = [0.5, 1.0]
    garbled = bytes(a & b for a, b in zip(status(1, 326), status(1, 652), strict=True))
    assert list(Framer().feed(garbled)) == []
    assert heard(twins, READ_POSITION) == garbled
    # In a group read, the last one waits for a whole status.
    assert heard(twins, sync_read(132, 4, 2, 1, 2)) == status(2, 0) + garbled
    fast = heard(twins, sync_read(132, 4, 1, 2, fast=True))
    assert (len(fast), fast[8:12]) == (8 + 8, b"\0\1\x04\0")
    assert crc(fast[:-2]) != int.from_bytes(fast[-2:], "little")


def test_replies_of_two_servos_with_one_id_that_do_not_overlap_both_arrive(make_bench: Make) -> None:
    twins = make_bench({"return_delay_us": 200}, {"servo_id": 1}, {"servo_id": 2})
    twins.plant.position[1] = 1.0
    assert heard(twins, READ_POSITION) == status(1, 652) + status(1, 0)
    assert twins.bus.collisions == 0
    assert heard(twins, sync_read(132, 4, 1, 2)) == status(1, 652) + status(1, 0)
    start = twins.clock.now()
    twins.bus.write(READ_POSITION)
    twins.bus.read(30, 1.0)
    assert twins.clock.now() - start == pytest.approx((14 + 15) * BYTE_S + 200e-6)


def test_replies_of_two_servos_with_one_id_that_overlap_in_part_are_garbled(make_bench: Make) -> None:
    twins = make_bench({"return_delay_us": 100}, {"servo_id": 1})
    twins.plant.position[1] = 1.0
    early, late = status(1, 652), status(1, 0)
    both = bytes(a & b for a, b in zip(early[10:], late, strict=False))
    assert heard(twins, READ_POSITION) == early[:10] + both + late[5:]
    assert twins.bus.collisions == 1


def test_wrong_baud_is_silence(bench: Any) -> None:
    bench.bus.baud = 57_600
    assert bench.exchange(PING, 0.1) == []
    bench.bus.baud = 1_000_000
    assert bench.ask(1, Instruction.PING).error == 0


def test_baud_of_one_servo_changes(bench: Any) -> None:
    assert bench.write(1, 8, 1) == 0
    assert bench.exchange(PING) == []
    assert bench.ask(2, Instruction.PING).error == 0
    bench.bus.baud = 57_600
    start = bench.clock.now()
    bench.bus.write(PING)
    assert len(bench.bus.read(14, 1.0)) == 14
    assert bench.clock.now() - start == pytest.approx(24 * 10 / 57_600, abs=1e-9)


# Disorder


def test_a_pause_ends_a_packet_that_was_begun(bench: Any) -> None:
    bench.bus.write(PING[:6])
    bench.wait(1.4e-3)
    bench.bus.write(PING[6:])
    assert len(bench.bus.read(14, 0.01)) == 14
    bench.bus.write(PING[:6])
    bench.wait(6 * BYTE_S + 1.6e-3)
    bench.bus.write(PING[6:])
    assert bench.bus.read(14, 0.01) == b""
    assert bench.ask(1, Instruction.PING).error == 0


def test_host_that_talks_into_a_reply_loses_both(bench: Any) -> None:
    bench.bus.write(PING)
    bench.wait((len(PING) + 4.5) * BYTE_S)
    bench.bus.write(encode(1, Instruction.WRITE, b"\x41\0\x01"))
    assert len(bench.bus.read(100, 0.01)) == 4
    assert bench.bus.collisions == 1
    assert bench.servo().value("LED") == 0
    assert bench.ask(1, Instruction.PING).error == 0


def test_a_second_instruction_in_one_write_runs_into_the_first_ones_reply(bench: Any) -> None:
    assert bench.exchange(PING + encode(2, Instruction.PING)) == []
    assert bench.bus.collisions == 1


def test_no_collision_when_the_reply_waits_long_enough(make_bench: Make) -> None:
    bench = make_bench({"return_delay_us": 400}, {})
    statuses = bench.exchange(PING + encode(2, Instruction.PING))
    assert [status.id for status in statuses] == [2, 1]
    assert bench.bus.collisions == 0


def test_two_servos_that_talk_at_once_lose_both(make_bench: Make) -> None:
    bench = make_bench({"return_delay_us": 200}, {})
    assert bench.exchange(PING + encode(2, Instruction.PING)) == []
    assert bench.bus.collisions == 1


def test_the_next_instruction_may_follow_a_reply_at_once(bench: Any) -> None:
    for _ in range(300):  # at many times, so with many roundings
        bench.bus.write(PING)
        assert len(bench.bus.read(14, 1.0)) == 14
    assert bench.bus.collisions == 0


def test_late_bytes_are_not_dropped_with_those_that_have_come(bench: Any) -> None:
    bench.bus.write(PING)
    bench.wait((len(PING) + 4) * BYTE_S + 1e-9)
    assert bench.bus.in_waiting == 4
    bench.bus.discard_input()
    assert bench.bus.in_waiting == 0
    assert len(bench.bus.read(100, 0.01)) == 10


SPICY = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x01, 0xFE, 0x03, 0x83]), max_size=30).map(bytes)
ANY_PACKET = st.builds(
    encode,
    st.sampled_from([1, 2, 5, BROADCAST_ID]),
    st.one_of(st.sampled_from(list(Instruction)), st.integers(0, 255)),
    st.one_of(
        st.binary(max_size=12),
        st.builds(
            lambda address, rest: address.to_bytes(2, "little") + rest, st.integers(0, 160), st.binary(max_size=12)
        ),
    ),
)


@settings(max_examples=150)
@given(st.lists(st.one_of(st.binary(max_size=30), SPICY, ANY_PACKET), max_size=8))
def test_whatever_is_sent_the_next_good_packet_is_answered(make_bench: Make, everything: list[bytes]) -> None:
    bench = make_bench()
    for raw in everything:
        bench.bus.write(raw)
        bench.bus.read(1000, 0.002)
    bench.wait(BOOT_S + 1.0)
    bench.bus.read(100_000, 0.0)
    # Whatever ID, baud and level it set itself to, a servo answers a ping there.
    for servo in bench.bus._servos:
        alone = sum(other.id == servo.id and other.baud == servo.baud for other in bench.bus._servos) == 1
        bench.bus.baud = servo.baud
        statuses = bench.exchange(encode(servo.id, Instruction.PING), 0.1)
        assert [status.id for status in statuses] == [servo.id] * alone
    for servo in bench.bus._servos:
        assert abs(servo.motor_current_a) <= 1193 * 2.69e-3


def test_one_servo_per_joint() -> None:
    class OneJoint:
        joints = 1

    with pytest.raises(ValueError, match="2 servos for a plant of 1 joints"):
        FakeBus([EmulatedServo(load_model("XM430-W350"), i) for i in (1, 2)], OneJoint(), VirtualClock())  # type: ignore[arg-type]
