"""The adapter's latency timer, with a sysfs made of ordinary files."""

import os
from pathlib import Path

import pytest

from hil.drivers.latency import (
    FACTORY_MS,
    adapter_latency,
    command_to_set,
    latency_timer,
    read_latency_ms,
    write_latency_ms,
)


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
