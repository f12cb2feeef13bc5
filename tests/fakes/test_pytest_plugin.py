"""The plugin as other projects' tests use it: in another pytest process, with only the installed package."""

from pathlib import Path

from tests.support.paths import ROOT
from tests.support.processes.pytest_session import run_pytest

THEIR_TESTS = f"""
from hil.drivers.packet import encode, encode_status
from hil.fakes.bus.faults import Fault
import serial

PONG = encode_status(1, 0, b"\\xfc\\x03\\x30")


def test_default_arm(fake_arm):
    port = fake_arm()
    port.write(encode(1, 1))
    assert port.read(14) == PONG
    assert not port.bus.servos[2].torque_enabled


def test_file_seed_and_faults(fake_arm):
    port = fake_arm({str(ROOT / "configs" / "fake_two_link.toml")!r}, seed=3, faults=[Fault(kind="lost_reply")])
    port.write(encode(1, 1))
    assert port.read(14) == b""


def test_an_arm_by_name(fake_arm):
    assert sorted(fake_arm("koch").bus.servos) == [1, 2, 3, 4, 5, 6]


def test_terminal(fake_pty):
    arm = fake_pty()
    with serial.Serial(arm.path, 1_000_000, timeout=1.0) as port:
        port.write(encode(1, 1))
        assert port.read(14) == PONG
    with arm.lock:
        assert arm.bus.servos[1].hardware_error == 0
"""


def test_fixtures_for_other_peoples_tests(tmp_path: Path) -> None:
    (tmp_path / "test_theirs.py").write_text(THEIR_TESTS, encoding="utf-8")
    done = run_pytest(tmp_path, PYTHONPATH=str(ROOT))
    assert "4 passed" in done.stdout, done.stdout + done.stderr


UNRELATED = """
import sys


def test_nothing_of_ours(request):
    ours = {name for name in sys.modules if name.partition(".")[0] == "hil"}
    assert ours <= {"hil", "hil.fakes", "hil.fakes.pytest_plugin"}
    assert not {"serial", "pydantic", "numpy", "dynamixel_sdk"} & set(sys.modules)
    assert request.config.pluginmanager.has_plugin("hil")
"""


def test_an_unrelated_session_imports_nothing_but_the_plugin(tmp_path: Path) -> None:
    (tmp_path / "test_unrelated.py").write_text(UNRELATED, encoding="utf-8")
    # Plugins of others, as far as they are known to import numpy, are none of ours.
    done = run_pytest(tmp_path, "no:hypothesispytest", "no:randomly")
    assert "1 passed" in done.stdout, done.stdout + done.stderr
