"""LeRobot's own tests of its Dynamixel bus on the fake bus; skipped if LeRobot or its tests are not installed.

LeRobot's wheel contains no tests: `LEROBOT_TESTS` names the folder of its tests, e.g. in a checkout.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, GroupSyncRead, PacketHandler, PortHandler

from tests.fakes.lerobot_adaptor import MockMotors
from tests.support.paths import ROOT

FOLDER = os.environ.get("LEROBOT_TESTS", "")
PYTHON = os.environ.get("LEROBOT_PYTHON", sys.executable)

NO_SERVO_WOULD = (
    "test__write[0-1-1-2]",  # writes Model Number
    "test__write[10-2-2-999]",  # an undefined Drive Mode
    "test__write[42-4-3-1337]",  # an undefined address
    "test__read_error[True]",  # a status with an error and data: servos send none then,
    "test__read_error[False]",  # which dynamixel-sdk 4.1 answers with an IndexError
)
"""Tests that expect something that no real servo does."""

CONFTEST = f"""
import importlib.util, sys, types
spec = importlib.util.spec_from_file_location("lerobot_adaptor", {str(ROOT / "tests/fakes/lerobot_adaptor.py")!r})
adaptor = importlib.util.module_from_spec(spec)
spec.loader.exec_module(adaptor)
for name in ("tests", "tests.mocks", "tests.mocks.mock_dynamixel"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = []
sys.modules["tests.mocks.mock_dynamixel"].MockMotors = adaptor.MockMotors
sys.modules["tests.mocks.mock_dynamixel"].MockPortHandler = object
"""


@pytest.mark.skipif(not FOLDER, reason="LEROBOT_TESTS does not name the folder of LeRobot's tests")
def test_lerobots_own_tests(tmp_path: Path) -> None:
    theirs = Path(FOLDER) / "motors" / "test_dynamixel.py"
    (tmp_path / "conftest.py").write_text(CONFTEST, encoding="utf-8")
    (tmp_path / "test_dynamixel.py").symlink_to(theirs.resolve())
    command = [PYTHON, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    failed = [line.split("::")[1].split(" ")[0] for line in done.stdout.splitlines() if line.startswith("FAILED")]
    assert set(failed) <= set(NO_SERVO_WOULD), done.stdout[-4000:]
    assert " passed" in done.stdout, done.stdout + done.stderr


class Patient(PortHandler):  # type: ignore[misc]
    """Waits longer for a reply than the SDK does, because this computer may be busy."""

    patience_ms = 5000.0

    def setPacketTimeout(self, length: int) -> None:
        self.setPacketTimeoutMillis(self.patience_ms)


def test_the_adaptors_servos_reply_as_its_stubs_say() -> None:
    """What LeRobot's tests need from the adaptor, without LeRobot."""
    motors, handler = MockMotors(), PacketHandler(2.0)
    motors.open()
    try:
        port = Patient(motors.port)
        assert port.openPort() and port.setBaudRate(1_000_000)
        undefined = motors.build_read_stub(42, 4, 3, 1337)
        assert handler.read4ByteTxRx(port, 3, 42) == (1337, COMM_SUCCESS, 0)
        positions = motors.build_sequential_sync_read_stub(132, 4, {1: [351, 42], 2: [28, 3600]})
        group = GroupSyncRead(port, handler, 132, 4)
        assert group.addParam(1) and group.addParam(2)
        for expected in ([351, 28], [42, 3600]):
            assert group.txRxPacket() == COMM_SUCCESS
            assert [group.getData(servo, 132, 4) for servo in (1, 2)] == expected
        written = motors.build_write_stub(20, 4, 2, -5)
        assert handler.write4ByteTxRx(port, 2, 20, 2**32 - 5) == (COMM_SUCCESS, 0)
        silent = motors.build_read_stub(10, 1, 1, 4, reply=False)
        port.patience_ms = 50.0
        assert handler.read1ByteTxRx(port, 1, 10)[1] == COMM_RX_TIMEOUT
        port.closePort()
    finally:
        motors.close()
    assert [motors.stubs[name].calls for name in (undefined, positions, written, silent)] == [1, 2, 1, 1]
