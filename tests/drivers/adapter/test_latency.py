"""The adapter's latency timer, with a sysfs made of ordinary files; and delays that a busy computer causes."""

import math
import os
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from dynamixel_sdk import COMM_RX_CORRUPT, COMM_SUCCESS

from hil.drivers.adapter.latency import (
    FACTORY_MS,
    adapter_latency,
    command_to_set,
    latency_timer,
    read_latency_ms,
    write_latency_ms,
)
from hil.drivers.errors import WrongReply
from hil.drivers.preparation.prepare import learn_latency
from hil.drivers.servo import Servo
from hil.fakes.bus.clock import VirtualClock


@pytest.fixture
def sysfs(tmp_path: Path) -> Path:
    device = tmp_path / "class" / "tty" / "ttyUSB0" / "device"
    device.mkdir(parents=True)
    (device / "latency_timer").write_text("16\n")
    return tmp_path


def test_an_ftdi_adapter_has_a_timer_also_by_its_link(sysfs: Path, tmp_path: Path) -> None:
    link = tmp_path / "usb-FTDI-if00"
    link.symlink_to("/dev/ttyUSB0")
    for url in ("/dev/ttyUSB0", str(link)):
        file = latency_timer(url, sysfs)
        assert file is not None and read_latency_ms(file) == 16
        assert adapter_latency(url, sysfs) == 0.016


@pytest.mark.parametrize(
    ("url", "latency"), [("/dev/ttyACM0", 1e-3), ("/dev/pts/3", 1e-3), ("fake://x", 1e-3), ("socket://x:1", 16e-3)]
)
def test_other_ports_have_none(sysfs: Path, url: str, latency: float) -> None:
    assert latency_timer(url, sysfs) is None
    assert adapter_latency(url, sysfs) == latency


def test_it_is_set_and_read_back(sysfs: Path) -> None:
    file = latency_timer("/dev/ttyUSB0", sysfs)
    assert file is not None
    assert write_latency_ms(file)
    assert read_latency_ms(file) == 1


@pytest.mark.skipif(os.getuid() == 0, reason="root may write every file")
def test_without_permission_it_is_not_set(sysfs: Path) -> None:
    file = latency_timer("/dev/ttyUSB0", sysfs)
    assert file is not None
    file.chmod(0o444)
    assert not write_latency_ms(file)


def test_an_unplugged_adapter_counts_as_one_from_the_factory(tmp_path: Path) -> None:
    assert read_latency_ms(tmp_path / "gone") == FACTORY_MS
    assert not write_latency_ms(tmp_path / "gone" / "gone")


def test_the_command_to_type_is_whole() -> None:
    assert command_to_set(Path("/sys/x/latency_timer")) == "echo 1 | sudo tee /sys/x/latency_timer"


class Pinged:
    """A servo whose replies take `slow` [s] until `until` [s], and 0.3 ms later on."""

    def __init__(self, slow: float, until: float) -> None:
        self.clock = VirtualClock()
        self.port = SimpleNamespace(clock=self.clock, latency=1e-3, latency_measured=False, wire_time=lambda _: 2.4e-4)
        self._slow, self._until = slow, until

    def ping(self, attempts: int) -> int:
        now = self.clock.now()
        self.clock.wait_until(now + (self._slow if now < self._until else 3e-4))
        return attempts


@pytest.mark.parametrize(("until", "is_slow"), [(0.0, False), (0.2, False), (math.inf, True)])
def test_only_an_adapter_that_is_always_slow_is_slow(until: float, is_slow: bool) -> None:
    servo = Pinged(4e-3, until)
    learn_latency(cast("Servo", servo))
    assert servo.port.latency_measured == is_slow
    assert (servo.port.latency > 2e-3) == is_slow
    assert servo.clock.now() < 1.0


@pytest.mark.parametrize(("slow", "latency"), [(3e-4, 1e-3), (2e-3, 2.2e-3)])
def test_an_adapter_a_little_slower_than_its_kind_is_waited_for(slow: float, latency: float) -> None:
    servo = Pinged(slow, math.inf)
    learn_latency(cast("Servo", servo))
    assert servo.port.latency == pytest.approx(latency) and not servo.port.latency_measured


def test_the_slowest_phase_of_a_usb_frame_counts_but_no_pause_of_a_busy_computer() -> None:
    for later, latency in ((2e-3, 2.2e-3), (0.05, 1.25 * 2.5e-3)):
        servo = Pinged(later, until=later)  # the first reply is the slowest
        learn_latency(cast("Servo", servo))
        assert servo.port.latency == pytest.approx(latency) and not servo.port.latency_measured


def attempts_of(results: list[int]) -> tuple[list[float], str]:
    """When attempts at a read with these results are made [s], and the message if all fail."""
    clock, times = VirtualClock(), []
    servo = Servo.__new__(Servo)
    servo.id, servo.title = 1, "The servo"
    servo.port = SimpleNamespace(clock=clock, growth=1, late_replies=0)  # type: ignore[assignment]
    servo._sdk_port = SimpleNamespace()  # type: ignore[assignment]
    servo._sdk = SimpleNamespace(getTxRxResult=lambda _: "[TxRxResult] Incorrect status packet!")

    def action() -> tuple[int, int, int]:
        times.append(clock.now())
        return 7, results[len(times) - 1], 0

    try:
        servo._try("reading", action, is_read=True)
    except WrongReply as error:
        return times, str(error)
    return times, ""


def test_pieces_of_late_replies_are_gone_before_the_last_attempt() -> None:
    times, said = attempts_of([COMM_RX_CORRUPT, COMM_RX_CORRUPT, COMM_SUCCESS])
    assert times[1] == times[0] and times[2] - times[1] >= 0.05 and not said
    _, said = attempts_of(3 * [COMM_RX_CORRUPT])
    assert "second servo with ID 1" in said and "too late because other programs keep this computer busy" in said
