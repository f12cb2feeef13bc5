"""fake:// as a pyserial port, and dynamixel-sdk working through it."""

import math
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, Protocol2PacketHandler

from hil import fakes
from hil.drivers.clock import WallClock
from hil.drivers.packet import encode, encode_status
from hil.drivers.port import open_port
from hil.drivers.sdk_port import SdkPort
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.hand import Move
from hil.fakes.description import load_fake
from hil.fakes.protocol_fake import FakeSerial, open_fake
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link.toml"
URL = f"fake://{CONFIG}"
PING = encode(1, 1)
PONG = encode_status(1, 0, b"\xfc\x03\x30")


@pytest.fixture
def port() -> Iterator[FakeSerial]:
    fakes.register()
    with serial.serial_for_url(URL, baudrate=1_000_000, timeout=0.1) as opened:
        assert isinstance(opened, FakeSerial)
        yield opened


def test_registering_twice_is_harmless() -> None:
    fakes.register()
    fakes.register()
    assert serial.protocol_handler_packages.count("hil.fakes") == 1


def test_relative_path(monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.register()
    monkeypatch.chdir(CONFIG.parent)
    serial.serial_for_url("fake://fake_two_link.toml", timeout=0).close()


def test_ask_and_answer(port: FakeSerial) -> None:
    assert port.write(PING) == len(PING)
    assert port.in_waiting == 0
    assert port.read(len(PONG)) == PONG
    assert port.clock.now() == pytest.approx(240e-6 + 60e-6)
    assert port.bus.servos[1].model.name == "XM430-W350"


def test_waiting_lets_the_arm_run_in_virtual_time(port: FakeSerial, monkeypatch: pytest.MonkeyPatch) -> None:
    bus = port.bus
    bus.hand.move(Move(servo=2, to=0.5, duration=1.0))
    began, real = port.clock.now(), time.monotonic()
    monkeypatch.setattr("time.sleep", port.wait)
    time.sleep(0.5)
    assert 0.1 < bus.plant.position[1] < 0.4
    port.wait(4.5)
    assert bus.plant.position[1] == pytest.approx(0.5, abs=0.02)
    assert port.clock.now() == pytest.approx(began + 5.0)
    assert time.monotonic() - real < 5.0
    port.write(PING)
    port.wait(0.1)
    assert port.read(len(PONG)) == PONG, "what arrived meanwhile is not lost"
    for seconds in (-1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="cannot wait for"):
            port.wait(seconds)


def test_the_rest_of_pyserials_interface(port: FakeSerial) -> None:
    assert [port.cts, port.dsr, port.ri, port.cd] == [False] * 4
    port.write(PING)
    port.cancel_read()
    port.cancel_write()
    assert port.read(len(PONG)) == PONG


def test_read_waits_for_the_timeout_only(port: FakeSerial) -> None:
    assert port.read(1) == b""
    assert port.clock.now() == pytest.approx(0.1)
    port.timeout = 0
    port.write(PING)
    assert port.read(100) == b""
    port.clock.wait_until(port.clock.now() + 1.0)
    assert port.in_waiting == len(PONG)
    assert port.read(100) == PONG


def test_real_time_by_url() -> None:
    """pyserial creates the port object before it sets the URL that asks for real time."""
    fakes.register()
    with serial.serial_for_url(f"{URL}?time=real", baudrate=1_000_000, timeout=0.02) as opened:
        assert isinstance(opened, FakeSerial) and isinstance(opened.clock, WallClock)
        began = opened.clock.now()
        assert opened.read(1) == b""
        assert opened.clock.now() - began >= 0.02
    with serial.serial_for_url(URL) as opened:
        assert isinstance(opened.clock, VirtualClock)


def test_read_without_timeout_never_hangs(port: FakeSerial) -> None:
    port.timeout = None
    port.write(PING)
    with pytest.raises(serial.SerialException, match="would block forever: only 14 have arrived"):
        port.read(15)
    assert port.read(14) == PONG


def test_input_buffer(port: FakeSerial) -> None:
    port.write(PING)
    port.clock.wait_until(1.0)
    port.reset_input_buffer()
    assert port.in_waiting == 0
    port.reset_output_buffer()
    port.write(PING)
    port.flush()
    assert port.clock.now() == pytest.approx(1.0 + 100e-6)


def test_bytearrays_are_written_too(port: FakeSerial) -> None:
    assert port.write(bytearray(PING)) == len(PING)
    assert port.read(14) == PONG


def test_baud_can_be_changed(port: FakeSerial) -> None:
    port.baudrate = 57_600
    port.write(PING)
    assert port.read(14) == b""
    port.baudrate = 1_000_000
    port.write(PING)
    assert port.read(14) == PONG
    with pytest.raises(ValueError, match="must be positive"):
        port.baudrate = 0


@pytest.mark.parametrize(
    ("setting", "value", "answered"),
    [
        ("parity", serial.PARITY_EVEN, False),
        ("parity", serial.PARITY_ODD, False),
        ("parity", serial.PARITY_MARK, True),
        ("bytesize", serial.SEVENBITS, False),
        ("stopbits", serial.STOPBITS_TWO, True),
    ],
)
def test_servos_understand_eight_bits_without_parity_only(
    port: FakeSerial, setting: str, value: object, answered: bool
) -> None:
    usual = getattr(port, setting)
    setattr(port, setting, value)
    port.write(PING)
    assert port.read(len(PONG)) == (PONG if answered else b"")
    setattr(port, setting, usual)
    port.write(PING)
    assert port.read(len(PONG)) == PONG


def test_closed_port(port: FakeSerial) -> None:
    port.close()
    port.close()
    for use in (
        lambda: port.read(1),
        lambda: port.write(PING),
        lambda: port.in_waiting,
        port.reset_input_buffer,
        port.reset_output_buffer,
        port.flush,
    ):
        with pytest.raises(serial.PortNotOpenError):
            use()


def test_arm_outlives_closing_and_reopening(port: FakeSerial) -> None:
    port.write(encode(1, 3, b"\x41\0\x01"))
    port.close()
    port.open()
    assert port.bus.servos[1].value("LED") == 1
    with pytest.raises(serial.SerialException, match="already open"):
        port.open()
    assert open_fake(load_fake(CONFIG)).bus.servos[1].value("LED") == 0  # another port, another arm


def test_port_that_was_never_opened() -> None:
    fakes.register()
    port = serial.serial_for_url(URL, do_not_open=True)
    assert isinstance(port, FakeSerial)
    assert not port.is_open
    with pytest.raises(serial.PortNotOpenError):
        _ = port.bus


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("fake://", "does not name a file"),
        ("fake:///nowhere/arm.toml", "cannot be read"),
        (f"fake://{Path(__file__)}", "not valid TOML"),
    ],
)
def test_what_cannot_be_opened(url: str, said: str) -> None:
    fakes.register()
    with pytest.raises(serial.SerialException, match=said):
        serial.serial_for_url(url)


def test_open_from_python_on_a_clock_of_ones_own() -> None:
    clock = VirtualClock(100.0)
    port = open_fake(load_fake(CONFIG), clock)
    port.write(PING)
    assert port.read(14) == PONG
    assert clock.now() == pytest.approx(100.0003)


def test_two_runs_are_the_same() -> None:
    def run() -> tuple[bytes, float]:
        port = open_fake(load_fake(CONFIG))
        received = b""
        port.write(encode(1, 3, b"\x0b\0\0"))
        received += port.read(11)
        for address, value in ((102, b"\x64\0"), (64, b"\x01")):
            port.write(encode(1, 3, bytes((address, 0)) + value))
            received += port.read(11)
        for _ in range(50):
            port.clock.wait_until(port.clock.now() + 0.0025)
            port.write(encode(254, 0x82, b"\x7e\0\x0a\0\x01\x02"))
            received += port.read(42)
        return received, port.clock.now()

    assert run() == run()


def test_import_is_cheap() -> None:
    code = "import sys, hil.fakes; assert not {'serial', 'pydantic', 'numpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=CONFIG.parents[1])


# dynamixel-sdk through the drivers' port


@pytest.fixture
def sdk() -> tuple[Protocol2PacketHandler, SdkPort, FakeSerial]:
    fakes.register()
    port = open_port(URL, 1_000_000)
    fake = port._serial
    assert isinstance(fake, FakeSerial)
    return Protocol2PacketHandler(), SdkPort(port), fake


Sdk = tuple[Protocol2PacketHandler, SdkPort, FakeSerial]


def test_sdk_pings_and_scans(sdk: Sdk) -> None:
    handler, port, _ = sdk
    assert handler.ping(port, 2) == (1020, COMM_SUCCESS, 0)
    assert handler.ping(port, 3)[1] != COMM_SUCCESS
    found, result = handler.broadcastPing(port)
    assert result == COMM_SUCCESS
    assert found == {1: [1020, 48], 2: [1020, 48]}


def test_sdk_reads_and_writes(sdk: Sdk) -> None:
    handler, port, fake = sdk
    assert handler.write1ByteTxRx(port, 1, 11, 0) == (COMM_SUCCESS, 0)
    assert handler.write2ByteTxRx(port, 1, 102, 0xFFF0) == (COMM_SUCCESS, 0)
    assert fake.bus.servos[1].goal_current_ticks == -16
    assert handler.write1ByteTxRx(port, 1, 64, 1) == (COMM_SUCCESS, 0)
    assert handler.write1ByteTxRx(port, 1, 11, 3) == (COMM_SUCCESS, 7)  # EEPROM is locked
    assert handler.read2ByteTxRx(port, 1, 102) == (0xFFF0, COMM_SUCCESS, 0)
    assert handler.read4ByteTxRx(port, 1, 132)[0] == pytest.approx(2048, abs=2)
    assert handler.regWriteTxRx(port, 1, 65, 1, [1]) == (COMM_SUCCESS, 0)
    assert handler.action(port, 254) == COMM_SUCCESS
    assert fake.bus.servos[1].value("LED") == 1
    assert handler.reboot(port, 1) == (COMM_SUCCESS, 0)
    assert not fake.bus.servos[1].torque_enabled


@pytest.mark.parametrize("fast", [False, True], ids=["sync", "fast sync"])
def test_sdk_reads_groups(sdk: Sdk, fast: bool) -> None:
    handler, port, _ = sdk
    reading = GroupSyncRead(port, handler, 132, 4)
    for servo_id in (1, 2):
        assert reading.addParam(servo_id)
    assert (reading.fastSyncRead() if fast else reading.txRxPacket()) == COMM_SUCCESS
    # The shoulder hangs: a quarter turn below 3072.
    assert [reading.getData(servo_id, 132, 4) for servo_id in (1, 2)] == [2048, 2048]


def test_sdk_writes_groups(sdk: Sdk) -> None:
    handler, port, fake = sdk
    writing = GroupSyncWrite(port, handler, 102, 2)
    writing.addParam(1, [10, 0])
    writing.addParam(2, [20, 0])
    assert writing.txPacket() == COMM_SUCCESS
    fake.flush()
    assert [fake.bus.servos[servo_id].goal_current_ticks for servo_id in (1, 2)] == [10, 20]


def test_sdk_sends_a_header_in_its_data_unstuffed_and_is_understood(sdk: Sdk) -> None:
    """dynamixel-sdk 4.1.0 does not stuff; its length and CRC match what it sends, so the bytes are accepted."""
    handler, port, fake = sdk
    assert handler.write1ByteTxRx(port, 1, 11, 4) == (COMM_SUCCESS, 0)
    assert handler.write4ByteTxRx(port, 1, 116, 0xFF_FD_FF_FF) == (COMM_SUCCESS, 0)
    assert fake.bus.servos[1].value("Goal Position") == -131_073
