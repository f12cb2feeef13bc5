"""Every fault happens at its time, to its servo, with its probability, and reproducibly for the same seed."""

import termios
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import serial

from hil.drivers.packet import (
    ALERT,
    BROADCAST_ID,
    Framer,
    HardwareError,
    Instruction,
    StatusError,
    encode,
    encode_status,
)
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.faults import FAULTS, Fault, FaultKind, Faults, parse_fault
from hil.fakes.description import DescriptionError, FakeArm, load_fake, make_bus
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.plant import CheckedPlant
from hil.fakes.protocol_fake import open_fake
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import BOOT_S, EmulatedServo
from tests.fakes.conftest import FreeInertia
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link.toml"
PING = encode(1, Instruction.PING)
PONG = encode_status(1, 0, b"\xfc\x03\x30")


def raw_replies(bench: Any, count: int = 1, servo_id: int = 1) -> list[bytes]:
    """Return the replies to each of several pings."""
    replies = []
    for _ in range(count):
        bench.bus.write(encode(servo_id, Instruction.PING))
        replies.append(bench.bus.read(1000, 0.1))
    return replies


def test_all_kinds_are_described() -> None:
    assert set(FAULTS) == set(FaultKind)


# Packets


def test_lost_reply_strikes_one_servo_while_it_lasts(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="lost_reply", servo=1, at=0.5, duration=1.0))
    assert raw_replies(bench) == [PONG]
    bench.wait(0.6)
    assert raw_replies(bench) == [b""]
    assert len(raw_replies(bench, servo_id=2)[0]) == 14
    bench.wait(1.0)
    assert raw_replies(bench) == [PONG]
    assert [(struck.kind, struck.servo) for struck in bench.bus.faults.happened] == [("lost_reply", 1)]


def test_a_lost_reply_in_a_group_leaves_the_others(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="lost_reply", servo=1))
    request = encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x7e\0\x0a\0\x01\x02")
    assert [reply.id for reply in bench.exchange(request)] == [2]


@pytest.mark.parametrize("kind", ["corrupted_reply", "truncated_reply"])
def test_damaged_replies_are_no_packets(bench: Any, kind: str) -> None:
    bench.bus.faults.add(Fault(kind=kind))
    replies = raw_replies(bench, 20)
    assert len(set(replies)) > 3
    for raw in replies:
        assert raw != PONG
        assert list(Framer().feed(raw)) == []
        assert len(raw) == len(PONG) or (kind == "truncated_reply" and 0 < len(raw) < len(PONG))


def test_corrupted_reply_flips_as_many_bits_as_asked(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="corrupted_reply", amount=1))
    for raw in raw_replies(bench, 10):
        assert sum((a ^ b).bit_count() for a, b in zip(raw, PONG, strict=True)) == 1


def test_duplicated_reply(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="duplicated_reply"))
    assert raw_replies(bench) == [PONG + PONG]


def test_a_late_reply_holds_back_the_replies_to_later_requests(bench: Any) -> None:
    """An adapter and its driver are one queue: nothing overtakes in it."""
    bench.bus.faults.add(Fault(kind="late_reply", servo=1, amount=0.02, duration=0.01))
    bench.bus.write(PING)
    assert bench.bus.read(14, 0.015) == b""
    bench.bus.write(encode(2, Instruction.PING))
    assert bench.bus.read(14, 0.004) == b""
    assert [packet.id for packet in Framer().feed(bench.bus.read(28, 0.01))] == [1, 2]
    bench.bus.write(encode(2, Instruction.PING))
    assert bench.bus.read(14, 0.001)[4] == 2, "which nothing holds back any more"


def test_a_late_reply_holds_back_those_behind_it(bench: Any) -> None:
    """They are in the same buffer of the adapter: bytes of one group read never overtake each other."""
    late = Fault(kind="late_reply", servo=1, amount=0.005)
    bench.bus.faults.add(late)
    bench.bus.write(encode(BROADCAST_ID, Instruction.SYNC_READ, bytes((132, 0, 4, 0, 1, 2))))
    assert bench.bus.read(30, 0.004) == b""
    assert [packet.id for packet in Framer().feed(bench.bus.read(30, 0.005))] == [1, 2]


def test_noise_comes_before_a_reply_that_is_still_found(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="noise", amount=5))
    (raw,) = raw_replies(bench)
    assert len(raw) == 19
    assert raw.endswith(PONG)
    assert [packet.id for packet in Framer().feed(raw)] == [1]


def test_lost_and_corrupted_instructions(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="lost_instruction", duration=1.0))
    bench.bus.faults.add(Fault(kind="corrupted_instruction", at=1.0, duration=1.0))
    light = encode(1, Instruction.WRITE, b"\x41\0\x01")
    assert bench.exchange(light) == []
    bench.wait(1.0)
    (status,) = bench.exchange(light)
    assert status.error == StatusError.CRC
    assert bench.servo().value("LED") == 0
    bench.wait(1.0)
    assert bench.exchange(light)[0].error == 0


@pytest.mark.parametrize("kind", ["lost_instruction", "corrupted_instruction"])
def test_an_instruction_to_all_that_one_servo_does_not_receive(bench: Any, kind: str) -> None:
    bench.bus.faults.add(Fault(kind=kind, servo=2, duration=1.0))
    lights = encode(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x41\0\1\0" + b"\1\1\2\1")
    bench.exchange(lights)
    assert [bench.servo(servo_id).value("LED") for servo_id in (1, 2)] == [1, 0]
    assert raw_replies(bench) == [PONG], "the other one receives what is addressed to it"
    assert len(bench.exchange(encode(2, Instruction.PING))) == (kind == "corrupted_instruction")
    bench.wait(1.0)
    bench.exchange(lights)
    assert bench.servo(2).value("LED") == 1


def test_probability_and_seed() -> None:
    def struck(seed: int) -> list[bool]:
        bus = FakeBus([EmulatedServo(load_model("XM430-W350"), 1)], _Still(), VirtualClock(), seed=seed)
        bus.faults.add(Fault(kind="lost_reply", probability=0.3))
        lost = []
        for _ in range(300):
            bus.write(PING)
            lost.append(bus.read(14, 0.01) == b"")
        return lost

    assert struck(1) == struck(1)
    assert struck(1) != struck(2)
    assert 60 < sum(struck(1)) < 120


class _Still:
    joints = 1
    position = (0.0,)
    velocity = (0.0,)
    current = (0.0,)

    def advance(self, until: float, current: object) -> None: ...


# Servos and joints


def test_silent_servo_drives_on_and_its_watchdog_stops_it(bench: Any) -> None:
    bench.arm(1, watchdog=3, goal_ticks=100)
    bench.bus.faults.add(Fault(kind="silent_servo", servo=1, at=bench.bus.time, duration=0.5))
    for _ in range(4):
        bench.wait(0.03)
        bench.ask(2, Instruction.PING)
        assert raw_replies(bench) == [b""]
    assert bench.servo(1).watchdog_tripped
    bench.wait(0.5)
    assert len(raw_replies(bench)[0]) == 14


def test_reboot_takes_torque_and_deafens_for_a_while(bench: Any) -> None:
    bench.arm(1, goal_ticks=100)
    bench.bus.faults.add(Fault(kind="reboot", servo=1, at=1.0))
    bench.clock.wait_until(0.999)
    assert bench.servo(1).torque_enabled
    bench.clock.wait_until(1.001)
    assert not bench.servo(1).torque_enabled
    assert raw_replies(bench) == [b""]
    bench.clock.wait_until(1.0 + BOOT_S)
    assert raw_replies(bench) == [PONG]
    assert bench.plant.velocity[0] == pytest.approx(50 * 0.269 * 1.0, rel=0.06)  # it has been coasting since


@pytest.mark.parametrize(
    ("kind", "error", "shuts_down"),
    [
        ("overheating", HardwareError.OVERHEATING, True),
        ("overload", HardwareError.OVERLOAD, True),
        ("low_voltage", HardwareError.INPUT_VOLTAGE, False),
    ],
)
def test_hardware_errors(bench: Any, kind: str, error: HardwareError, shuts_down: bool) -> None:
    bench.arm(1, goal_ticks=100)
    bench.arm(2, goal_ticks=100)
    bench.bus.faults.add(Fault(kind=kind, servo=2, at=0.5, duration=1.0))
    bench.clock.wait_until(0.6)
    assert bench.servo(2).hardware_error == error
    assert bench.servo(2).torque_enabled is not shuts_down
    assert bench.servo(1).hardware_error == 0
    assert raw_replies(bench, servo_id=2)[0][8] == ALERT
    bench.clock.wait_until(2.0)
    assert bench.servo(2).hardware_error == error  # stays until a reboot
    assert bench.servo(2).value("Present Input Voltage") == 120


@pytest.mark.parametrize("how", ["duration", "clear"])
def test_an_overheated_servo_recovers_after_cooling(bench: Any, how: str) -> None:
    bench.arm(1, goal_ticks=100)
    fault = Fault(kind="overheating", servo=1, at=0.5, **({"duration": 20.0} if how == "duration" else {}))
    bench.bus.faults.add(fault)
    bench.clock.wait_until(20.49)
    assert bench.servo().value("Present Temperature") == 90, "it stays hot as long as the fault lasts"
    bench.clock.wait_until(20.5)
    if how == "clear":
        bench.bus.faults.clear()
    assert bench.servo().temperature_c == pytest.approx(90, abs=0.2)
    bench.ask(1, Instruction.REBOOT)
    bench.wait(BOOT_S)
    assert bench.servo().hardware_error == HardwareError.OVERHEATING, "it is still too hot"
    bench.clock.wait_until(22.5)
    assert bench.servo().temperature_c == pytest.approx(70, abs=0.2)
    bench.ask(1, Instruction.REBOOT)
    bench.wait(BOOT_S)
    assert bench.servo().hardware_error == 0
    bench.arm(1, goal_ticks=100)
    bench.wait(3600.0)
    assert bench.servo().value("Present Temperature") == 35
    assert bench.servo().torque_enabled
    assert not bench.servo().needs_ticks, "it costs nothing any more"


def test_a_servo_that_two_faults_heat_cools_after_both(bench: Any) -> None:
    bench.bus.faults.add(
        Fault(kind="overheating", servo=1, at=1.0, duration=2.0), Fault(kind="overheating", at=2.0, duration=5.0)
    )
    for second, temperature in ((0.9, 35), (2.9, 90), (6.9, 90), (8.0, 80), (20.0, 35)):
        bench.clock.wait_until(second)
        assert bench.servo().value("Present Temperature") == temperature


def test_what_is_cleared_or_added_now_takes_effect_now(bench: Any) -> None:
    """Not at the time of the last packet, up to which the bus has been computed."""
    bench.bus.faults.add(Fault(kind="overheating"))
    bench.wait(10.0)
    bench.bus.faults.clear()
    assert bench.servo().value("Present Temperature") == 90
    bench.wait(10.0)
    bench.bus.faults.add(Fault(kind="reboot"))
    bench.wait(0.9 * BOOT_S)
    assert raw_replies(bench) == [b""]


def test_encoder_jump_and_back(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="encoder_jump", servo=1, at=1.0, duration=1.0, amount=-300))
    assert bench.read(1, 132, 4, signed=True) == 0
    bench.clock.wait_until(1.5)
    assert bench.read(1, 132, 4, signed=True) == -300
    assert bench.read(2, 132, 4, signed=True) == 0
    bench.clock.wait_until(2.5)
    assert bench.read(1, 132, 4, signed=True) == 0


def test_stuck_joint_holds_the_arm_and_lets_go() -> None:
    port = open_fake(load_fake(CONFIG))
    bus = port.bus
    for servo_id in (1, 2):
        for body in (b"\x0b\0\0", b"\x66\0\0\0", b"\x40\0\x01", b"\x66\0\x78\0"):
            port.write(encode(servo_id, Instruction.WRITE, body))
            port.read(11)
    bus.faults.add(Fault(kind="stuck_joint", servo=2, at=0.3, duration=0.5))
    port.clock.wait_until(0.3)
    bus.advance(0.3)
    held = bus.plant.position[1]
    assert abs(held) > 0.01
    port.clock.wait_until(0.79)
    bus.advance(0.79)
    assert bus.plant.position[1] == pytest.approx(held, abs=1e-3)
    assert bus.plant.velocity[1] == 0.0
    assert bus.plant.velocity[0] != 0.0
    port.clock.wait_until(1.0)
    bus.advance(1.0)
    assert bus.plant.velocity[1] != 0.0


def test_a_plant_that_cannot_jam_says_so(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="stuck_joint"))
    with pytest.raises(PlantError, match="FreeInertia has no jam"):
        bench.wait(0.1)
        bench.bus.advance(bench.clock.now())


def test_a_plant_that_cannot_jam_is_refused_before_it_moves() -> None:
    fake = load_fake(CONFIG)
    stuck = fake.model_copy(update={"faults": (Fault(kind="stuck_joint", at=5.0),)})
    with patch.object(FakeArm, "make_plant", lambda _: CheckedPlant(FreeInertia(2), "free:make")):
        make_bus(fake, VirtualClock())
        with pytest.raises(PlantError, match="has no jam"):
            make_bus(stuck, VirtualClock())


def test_by_chance_or_not_at_all(bench: Any) -> None:
    bench.bus.faults.add(*(Fault(kind="overload", at=0.01 * k, probability=0.0) for k in range(20)))
    bench.wait(1.0)
    assert bench.servo(1).hardware_error == 0
    assert bench.bus.faults.happened == []


def test_a_long_run_remembers_the_latest_faults_and_the_number_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.fakes.bus.faults.MOST_REMEMBERED", 10)
    faults = Faults(0, begin=lambda _: None, end=lambda _: None)
    lost = Fault(kind="lost_reply")
    for packet in range(25):
        assert faults.strikes(lost, 1, float(packet))
    assert faults.count == 25
    assert [fault.time for fault in faults.happened] == [float(packet) for packet in range(10, 25)]


def test_clear_ends_what_lasts(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="silent_servo"), Fault(kind="reboot", at=5.0))
    assert raw_replies(bench) == [b""]
    assert [fault.kind for fault in bench.bus.faults.lasting] == ["silent_servo"]
    bench.bus.faults.clear()
    assert raw_replies(bench) == [PONG]
    assert bench.bus.faults.lasting == ()


# The cable


def test_a_pulled_cable_fails_as_a_real_one_and_comes_back() -> None:
    port = open_fake(load_fake(CONFIG))
    port.bus.faults.add(Fault(kind="cable_pulled", at=1.0, duration=0.5))
    port.write(encode(1, Instruction.WRITE, b"\x62\0\x05"))
    port.read(11)
    port.write(encode(1, Instruction.WRITE, b"\x40\0\x01"))
    port.read(11)
    port.clock.wait_until(0.9999)
    port.write(PING)
    with pytest.raises(serial.SerialException, match="unplugged"):
        port.read(14)  # the reply is cut off in the middle
    assert port.clock.now() == pytest.approx(1.0)
    for use in (lambda: port.write(PING), lambda: port.read(1), lambda: port.in_waiting):
        with pytest.raises(serial.SerialException, match="Input/output error"):
            use()
    with pytest.raises(termios.error):
        port.reset_input_buffer()
    port.close()
    with pytest.raises(serial.SerialException, match="cable is unplugged"):
        port.open()
    assert port.bus._servos[0].torque_enabled
    port.clock.wait_until(1.6)
    with pytest.raises(serial.PortNotOpenError):
        port.write(PING)
    port.open()
    port.write(PING)
    assert port.read(14) == PONG
    assert port.bus.servos[1].watchdog_tripped  # no packet for 0.1 s


def test_what_was_open_when_the_cable_was_pulled_stays_lost() -> None:
    port = open_fake(load_fake(CONFIG))
    port.bus.faults.add(Fault(kind="cable_pulled", at=1.0, duration=0.5))
    port.clock.wait_until(2.0)
    with pytest.raises(serial.SerialException):
        port.write(PING)
    port.close()
    port.open()
    port.write(PING)
    assert port.read(14) == PONG


# Descriptions


def test_from_the_command_line() -> None:
    fault = parse_fault("lost_reply:servo=2,at=3,duration=0.5,probability=0.2")
    assert fault == Fault(kind="lost_reply", servo=2, at=3.0, duration=0.5, probability=0.2)
    assert parse_fault("overload") == Fault(kind="overload")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("gone", "Available kinds: lost_reply, corrupted_reply"),
        ("overload:when=3", '"when=3" is not KEY=VALUE with one of the keys at, duration'),
        ("overload:at=soon", "at = 'soon': must be a number"),
        ("overload:probability=2", "probability = 2.0"),
        ("overload:servo=1.5", "servo = '1.5': must be a number"),
    ],
)
def test_wrong_on_the_command_line(text: str, said: str) -> None:
    with pytest.raises(ValueError, match="fault") as caught:
        parse_fault(text)
    assert said in str(caught.value)


WRONG_AMOUNTS = [
    ("noise", -5, "a whole number from 1 to 1000 (bytes)"),
    ("noise", 1e9, "a whole number from 1 to 1000 (bytes)"),
    ("encoder_jump", 1e12, "a whole number from -1000000 to 1000000 (ticks)"),
    ("status_error", 300, "a whole number from 1 to 255 (ERR byte)"),
    ("status_error", -1, "a whole number from 1 to 255"),
    ("status_error", 1.5, "a whole number from 1 to 255"),
    ("corrupted_reply", 0, "a whole number from 1 to 88 (bits)"),
    ("reboot", -1, "a number from 0 to 3600 (seconds without response)"),
    ("late_reply", -1, "a number from 1e-06 to 3600 (seconds)"),
    ("other_master", 0, "a number from 0.001 to 3600"),
    ("low_voltage", -1, "a number from 0.1 to 40 (volts below it)"),
    ("overheating", -1, "a number from 1 to 150 (kelvin above it)"),
    ("lost_reply", 1, "lost_reply has no amount"),
]


@pytest.mark.parametrize(("kind", "amount", "said"), WRONG_AMOUNTS)
def test_a_wrong_amount_is_refused_wherever_it_comes_from(
    bench: Any, tmp_path: Path, kind: str, amount: float, said: str
) -> None:
    given = f"amount = {float(amount)!r}: "
    fault = Fault(kind=kind)
    attempts: dict[str, Callable[[], object]] = {
        "the command line": lambda: parse_fault(f"{kind}:amount={amount}"),
        "TOML": lambda: load_fake(with_fault(tmp_path, f'kind = "{kind}"\namount = {float(amount)}')),
        "Python": lambda: Fault(kind=kind, amount=float(amount)),
        "while running": lambda: bench.bus.faults.add(fault.model_copy(update={"amount": float(amount)})),
    }
    for source, attempt in attempts.items():
        with pytest.raises(ValueError, match="amount = ") as caught:
            attempt()
        assert given in str(caught.value), source
        assert said in str(caught.value), source


@pytest.mark.parametrize("kind", [kind for kind, facts in FAULTS.items() if facts.amount])
@pytest.mark.parametrize("end", ["least", "most"])
def test_every_allowed_amount_works(kind: FaultKind, end: str) -> None:
    port = open_fake(load_fake(CONFIG))
    port.bus.faults.add(Fault(kind=kind, amount=getattr(FAULTS[kind], end)))
    for _ in range(3):
        port.write(PING)
        port.read(14)
    port.write(encode(1, Instruction.READ, b"\x78\0\x1c\0"))
    port.read(39)
    assert FAULTS[kind].allows(FAULTS[kind].default)


def test_flipping_many_bits_of_a_short_reply(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="truncated_reply"), Fault(kind="corrupted_reply", amount=88))
    assert all(1 <= len(raw) < len(PONG) for raw in raw_replies(bench, 20))


def with_fault(tmp_path: Path, fault: str) -> Path:
    path = tmp_path / "arm.toml"
    path.write_text(CONFIG.read_text(encoding="utf-8") + f"\n[[fake.faults]]\n{fault}\n", encoding="utf-8")
    return path


def test_from_toml(tmp_path: Path) -> None:
    path = with_fault(tmp_path, 'kind = "lost_reply"\nservo = 2\nat = 1.5')
    port = open_fake(load_fake(path))
    assert port.bus.faults.next_change == 1.5
    port.clock.wait_until(2.0)
    port.write(encode(2, Instruction.PING))
    assert port.read(14) == b""


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ('kind = "gone"', "fake.faults[1].kind = 'gone'"),
        ('kind = "overload"\nat = -1.0', "fake.faults[1].at = -1.0: must be at least 0"),
        ('kind = "overload"\nservo = 3', "overload: no servo has the ID 3; the IDs are 1, 2"),
        ('kind = "overload"\nwhen = 3.0', "fake.faults[1].when is not a known key"),
    ],
)
def test_wrong_in_toml(tmp_path: Path, fault: str, said: str) -> None:
    with pytest.raises(DescriptionError) as caught:
        load_fake(with_fault(tmp_path, fault))
    assert said in str(caught.value)


def test_the_same_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    def played() -> bytes:
        path = with_fault(tmp_path, 'kind = "corrupted_reply"\nprobability = 0.4')
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("id = 1\nmodel", "id = 1\ncurrent_noise_a = 0.01\nmodel", 2), encoding="utf-8")
        port = open_fake(load_fake(path))
        received = b""
        for _ in range(100):
            port.clock.wait_until(port.clock.now() + 0.0025)
            port.write(encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x7e\0\x0a\0\x01\x02"))
            received += port.read(42)
        return received

    assert played() == played()


# Servo answers, and another master


@pytest.mark.parametrize("error", [1, 2, 7, 0x84])
def test_status_error_refuses_and_says_which(bench: Any, error: int) -> None:
    bench.bus.faults.add(Fault(kind="status_error", servo=1, amount=float(error)))
    assert bench.write(1, 65, 1) == error
    assert bench.ask(1, Instruction.READ, b"\x41\0\x01\0").error == error
    assert bench.ask(1, Instruction.PING).error == error
    assert bench.write(2, 65, 1) == 0
    bench.exchange(encode(254, Instruction.SYNC_WRITE, b"\x41\0\x01\0\x01\x01\x02\x00"))
    answers = bench.exchange(encode(254, Instruction.SYNC_READ, b"\x7e\0\x0a\0\x01\x02"))
    assert [(status.id, status.error, len(status.data)) for status in answers] == [(1, error, 0), (2, 0, 10)]
    bench.bus.faults.clear()
    assert [bench.servo(i).value("LED") for i in (1, 2)] == [0, 0]
    assert bench.write(1, 65, 1) == 0


def test_an_alert_alone_is_obeyed(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="status_error", amount=128.0))
    assert bench.write(1, 65, 1) == 128
    assert bench.servo().value("LED") == 1


def test_another_master_is_heard_and_answered(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="other_master", servo=2, at=0.1, duration=0.09, amount=0.02))
    assert bench.bus.read(1000, 0.09) == b""
    packets = list(Framer().feed(bench.bus.read(1000, 0.2)))
    assert [packet.id for packet in packets] == [2] * 10
    assert [packet.is_status for packet in packets] == [False, True] * 5
    assert bench.bus.read(1000, 1.0) == b""


def test_another_master_runs_into_the_hosts_packets(bench: Any) -> None:
    bench.bus.faults.add(Fault(kind="other_master", servo=1, amount=0.0013))
    heard = [status.id for _ in range(100) for status in bench.exchange(encode(2, Instruction.PING), 0.0005)]
    assert 0 < heard.count(2) < 100
    assert bench.bus.collisions > 0
