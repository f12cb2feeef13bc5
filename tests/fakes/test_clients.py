"""Independent clients in this process, the fake arm in another one, connected by a terminal in real time.

Each client is run with everything it supports; known client bugs are named and left out.
"""

import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import pytest

from benchmarks.bus import clients
from tests.support.paths import ROOT
from tests.support.processes import forked

CONFIG = ROOT / "configs" / "fake_two_link.toml"
WHY = 'needs the extra "clients": pip install hil[clients]'


@pytest.fixture
def device(tmp_path: Path) -> Iterator[str]:
    """Return the path of a terminal on which `hil fake` serves two XM430-W350 with IDs 1 and 2 at 1 MBd."""
    link = tmp_path / "arm"
    command = ["hil", "fake", str(CONFIG), "--pty", "--link", str(link), "--quiet"]
    with forked.start(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
        try:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], 30.0)
            assert ready, "hil fake did not start"
            assert process.stdout.readline().decode().strip() == str(link)
            yield str(link)
        finally:
            process.send_signal(signal.SIGTERM)
            assert process.wait(10.0) == 0
    assert not link.is_symlink()


# dynamixel-sdk


class Sdk:
    """dynamixel-sdk on its own port; calls are repeated if a busy machine made it miss its 34 ms."""

    def __init__(self, device: str) -> None:
        self.port = sdk.PortHandler(device)
        self.handler = sdk.PacketHandler(2.0)
        assert self.port.openPort()
        assert self.port.setBaudRate(1_000_000)

    def __call__(self, call: str, *args: Any) -> Any:
        """Return the call's results without the communication result, which must be success."""
        for _ in range(5):
            outcome = getattr(self.handler, call)(self.port, *args)
            results = outcome if isinstance(outcome, tuple) else (outcome,)
            # (data, result, error), (result, error), (data, result) of broadcastPing, or the result alone.
            at = 0 if len(results) == 1 else 1 if len(results) == 3 or isinstance(results[0], dict) else 0
            if results[at] == sdk.COMM_SUCCESS:
                rest = results[:at] + results[at + 1 :]
                return rest[0] if len(rest) == 1 else rest
        raise AssertionError(f"{call}{args}: {self.handler.getTxRxResult(results[at])}")

    def group(self, group: Any, call: str) -> Any:
        result = sdk.COMM_RX_TIMEOUT
        for _ in range(5):
            # After a missed reply, dynamixel-sdk 4.1 takes that one for the fast reply, and looks for data in it.
            with suppress(IndexError):
                result = getattr(group, call)()
            if result == sdk.COMM_SUCCESS:
                return group
        raise AssertionError(f"{call}: {self.handler.getTxRxResult(result)}")


@pytest.fixture
def ask(device: str) -> Iterator[Sdk]:
    client = Sdk(device)
    yield client
    client.port.closePort()


def test_sdk_single_servo_calls(ask: Sdk) -> None:
    assert ask("ping", 1) == (1020, 0)
    assert ask("broadcastPing") == {1: [1020, 48], 2: [1020, 48]}
    assert ask("write1ByteTxRx", 1, 11, 0) == 0
    assert ask("write2ByteTxRx", 1, 102, 0xFFF0) == 0
    assert ask("read2ByteTxRx", 1, 102) == (0xFFF0, 0)
    assert ask("write4ByteTxRx", 1, 116, 1234) == 0
    assert ask("read4ByteTxRx", 1, 116) == (1234, 0)
    assert ask("read1ByteTxRx", 1, 146) == (35, 0)
    assert ask("readTxRx", 1, 144, 3) == ([120, 0, 35], 0)
    assert ask("writeTxRx", 1, 76, 4, [1, 0, 2, 0]) == 0
    assert ask("read4ByteTxRx", 1, 76) == (0x20001, 0)
    assert ask("regWriteTxRx", 1, 65, 1, [1]) == 0
    assert ask("read1ByteTxRx", 1, 69) == (1, 0)
    assert ask.handler.action(ask.port, 254) == sdk.COMM_SUCCESS
    assert ask("read1ByteTxRx", 1, 65) == (1, 0)
    assert ask.handler.write1ByteTxOnly(ask.port, 1, 65, 0) == sdk.COMM_SUCCESS
    time.sleep(0.02)
    ask.port.clearPort()
    assert ask("read1ByteTxRx", 1, 65) == (0, 0)


def test_sdk_stuffed_data_comes_back(ask: Sdk) -> None:
    """The SDK does not stuff what it sends; replies are stuffed, and it can unstuff them."""
    assert ask("write1ByteTxRx", 1, 11, 4) == 0
    assert ask("write4ByteTxRx", 1, 116, 0xFFFD_FFFF) == 0
    assert ask("read4ByteTxRx", 1, 116) == (0xFFFD_FFFF, 0)


def test_sdk_groups(ask: Sdk) -> None:
    write = sdk.GroupSyncWrite(ask.port, ask.handler, 84, 2)
    assert write.addParam(1, [10, 0])
    assert write.addParam(2, [20, 0])
    ask.group(write, "txPacket")
    for call in ("txRxPacket", "fastSyncRead"):
        read = sdk.GroupSyncRead(ask.port, ask.handler, 84, 2)
        assert read.addParam(1)
        assert read.addParam(2)
        ask.group(read, call)
        assert [read.getData(servo_id, 84, 2) for servo_id in (1, 2)] == [10, 20]
    bulk_write = sdk.GroupBulkWrite(ask.port, ask.handler)
    assert bulk_write.addParam(1, 65, 1, [1])
    assert bulk_write.addParam(2, 76, 2, [7, 0])
    ask.group(bulk_write, "txPacket")
    for call in ("txRxPacket", "fastBulkRead"):
        bulk_read = sdk.GroupBulkRead(ask.port, ask.handler)
        assert bulk_read.addParam(1, 65, 1)
        assert bulk_read.addParam(2, 76, 2)
        ask.group(bulk_read, call)
        assert (bulk_read.getData(1, 65, 1), bulk_read.getData(2, 76, 2)) == (1, 7)


def test_sdk_lock_watchdog_clear_reboot_and_reset(ask: Sdk) -> None:
    for address, size, value in ((11, 1, 0), (102, 2, 0), (98, 1, 50), (64, 1, 1)):
        assert ask(f"write{size}ByteTxRx", 1, address, value) == 0
    assert ask("write1ByteTxRx", 1, 11, 3) == 7  # the EEPROM is locked
    assert ask("write1ByteTxRx", 1, 98, 1) == 0  # 20 ms
    time.sleep(0.2)
    assert ask("read1ByteTxRx", 1, 98) == (0xFF, 0)
    assert ask("write2ByteTxRx", 1, 102, 10) == 4
    assert ask("write1ByteTxRx", 1, 98, 0) == 0
    assert ask("write1ByteTxRx", 1, 64, 0) == 0
    assert ask("clearMultiTurn", 1) == 0
    assert ask("reboot", 1) == 0
    assert ask.handler.ping(ask.port, 1)[1] == sdk.COMM_RX_TIMEOUT
    time.sleep(0.5)
    assert ask("ping", 1) == (1020, 0)
    assert ask("write2ByteTxRx", 2, 38, 100) == 0
    assert ask("factoryReset", 2, 2) == 0
    time.sleep(0.5)
    assert ask("read2ByteTxRx", 2, 38) == (1193, 0)
    assert ask.port.setBaudRate(57_600)
    assert ask.handler.ping(ask.port, 1)[1] == sdk.COMM_RX_TIMEOUT


# rustypot


def test_rustypot(device: str) -> None:
    rustypot = pytest.importorskip("rustypot", reason=WHY)
    client = rustypot.Xl430PyController(device, 1_000_000, 0.5)
    assert client.ping(1)
    assert not client.ping(7)
    assert client.scan([1, 2, 3]) == {1: 1020, 2: 1020}
    assert client.sync_read_model_number([1, 2]) == [1020, 1020]
    assert list(client.read_raw_data(1, 144, 3)) == [120, 0, 35]
    client.write_operating_mode(1, 4)
    client.sync_write_goal_pwm([1, 2], [100, 200])
    assert client.sync_read_goal_pwm([1, 2]) == [100, 200]
    assert client.sync_read_present_position([1, 2]) == pytest.approx([2048, 2048], abs=2)
    client.write_raw_data(1, 116, [0xFF, 0xFF, 0xFD, 0xFF])  # stuffed on its way
    assert list(client.read_raw_data(1, 116, 4)) == [0xFF, 0xFF, 0xFD, 0xFF]
    client.write_torque_enable(1, 1)
    _, error = client.read_raw_data_with_error(1, 64, 1)
    assert error == 0
    client.write_operating_mode(1, 3)  # it does not look at the error of a write: the EEPROM is locked
    assert client.sync_read_operating_mode([1]) == [4]
    client.write_bus_watchdog(1, 1)
    time.sleep(0.2)
    assert list(client.read_raw_data(1, 98, 1)) == [0xFF]
    assert client.reboot(1)
    time.sleep(0.5)
    assert client.sync_read_torque_enable([1, 2]) in ([0, 0], [False, False])


# dynamixel-python


def test_dynamixel_python(device: str) -> None:
    """The client does not stuff what it sends, but its CRC is for stuffed data: writes of FF FF FD are left out."""
    dxl2 = pytest.importorskip("dxl2", reason=WHY)
    bus = dxl2.v2.MotorBus(device, 1_000_000, timeout=0.3)
    bus.connect()
    try:
        assert bus.ping(1).data == {"model_number": 1020, "firmware_version": 48}
        assert set(bus.broadcast_ping().data) == {1, 2}
        assert bus.ping(9).timeout
        assert set(bus.scan([57_600, 1_000_000])) == {1_000_000}
        assert bus.write(1, 65, 1, 1).ok
        assert bus.read(1, 65, 1).data == 1
        assert bus.write(1, 11, 1, 0).ok
        for value in (-1, -5):
            assert bus.write(1, 102, 2, value, signed=True).ok
            assert bus.read(1, 102, 2, signed=True).data == value
        assert bus.reg_write(2, 65, 1, 1).ok
        assert bus.action(2).ok
        params = dxl2.v2.SyncParams(65, 1)
        params.add_motor(1)
        params.add_motor(2)
        assert bus.sync_read(params).data == [1, 1]
        assert bus.fast_sync_read(params).data == [1, 1]
        writes = dxl2.v2.SyncParams(84, 2)
        writes.add_value(1, 30)
        writes.add_value(2, 40)
        bus.sync_write(writes)
        reads = dxl2.v2.BulkParams()
        reads.add_address(1, 84, 2)
        reads.add_address(2, 146, 1)
        assert bus.bulk_read(reads).data == [30, 35]
        assert bus.fast_bulk_read(reads).data == [30, 35]
        assert bus.control_table_backup(1).ok
        assert bus.control_table_restore(1).ok
        assert bus.clear_position(1).ok
        assert bus.write(1, 102, 2, 0).ok
        assert bus.write(1, 64, 1, 1).ok
        assert bus.write(1, 11, 1, 3).error == 7
        assert bus.write(1, 98, 1, 1).ok
        time.sleep(0.2)
        assert bus.read(1, 98, 1).data == 0xFF
        assert bus.reboot(1).ok
        time.sleep(0.5)
        assert bus.read(1, 64, 1).data == 0
        assert bus.factory_reset_except_id_baudrate(2).ok
    finally:
        bus.disconnect()


# All of them, by the same calls as the benchmark's


@pytest.mark.parametrize("name", ["dynamixel_sdk", "dynamixel_easy_sdk", "rustypot", "dxl2"])
def test_every_call_of_the_benchmark_is_right(name: str) -> None:
    outcome = clients.run(name, [sys.executable])
    if "missing" in outcome:
        pytest.skip(WHY)
    assert [each for each in outcome["results"] if each["wrong"]] == []
