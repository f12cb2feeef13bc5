"""The conftest.py of docs/fake_bus_in_ci.md, for programs that cannot share an environment with hil."""

import re
import sys
from pathlib import Path

from tests.support.paths import ROOT
from tests.support.processes.pytest_session import run_pytest

THEIR_TESTS = """
import subprocess

import pytest
from dynamixel_sdk import PacketHandler, PortHandler

TORQUE_ENABLE, PRESENT_POSITION = 64, 132
client = PacketHandler(2.0)


def opened(path):
    port = PortHandler(path)
    assert port.openPort() and port.setBaudRate(1_000_000)
    return port


def test_a_hand_moves_the_arm(fake_pty):
    arm = fake_pty("koch")
    port = opened(arm.path)
    arm.hand("2:ticks=2047", "3:ticks=1500")
    assert abs(client.read4ByteTxRx(port, 3, PRESENT_POSITION)[0] - 1500) < 10
    client.write1ByteTxRx(port, 3, TORQUE_ENABLE, 1)
    with pytest.raises(subprocess.CalledProcessError):
        arm.hand("3:ticks=1000")
    port.closePort()


def test_two_arms_one_of_them_with_a_fault(fake_pty):
    healthy, silent = (opened(fake_pty("koch", *options).path) for options in ((), ("--fault", "lost_reply:servo=1")))
    assert client.ping(healthy, 1)[1] == 0
    assert client.ping(silent, 1)[1] != 0
    assert client.ping(silent, 2)[1] == 0


def test_an_arm_that_does_not_exist(fake_pty):
    with pytest.raises(pytest.fail.Exception, match="hil fake ended with code 2"):
        fake_pty("nonsense")
"""


def test_the_conftest_for_programs_without_hil_in_their_environment(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "fake_bus_in_ci.md").read_text(encoding="utf-8")
    (conftest,) = [code for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "@pytest.fixture" in code]
    (tmp_path / "conftest.py").write_text(conftest, encoding="utf-8")
    (tmp_path / "test_theirs.py").write_text(THEIR_TESTS, encoding="utf-8")
    hil = tmp_path / "hil"
    hil.write_text(f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m hil "$@"\n', encoding="utf-8")
    hil.chmod(0o755)
    done = run_pytest(tmp_path, "no:hil", HIL=str(hil))
    assert "3 passed" in done.stdout, done.stdout + done.stderr
