"""The local device behind a port: other programs that use it, its true baud rate, and which adapter it is."""

import fcntl
import os
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from hil.drivers.adapter.device import adapter_name, device_of, is_pseudo_terminal, other_users, true_baud
from hil.drivers.errors import PortLost, PortNotOpened
from hil.drivers.port import open_port

_TIOCGEXCL = 0x80045440


@pytest.fixture
def device() -> Iterator[str]:
    master, slave = os.openpty()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


def test_a_program_without_locks_is_kept_out(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.drivers.port.opening.is_pseudo_terminal", lambda _: False)
    port = open_port(device, 1_000_000)
    answer = fcntl.ioctl(port._serial.fileno(), _TIOCGEXCL, bytes(4))
    assert struct.unpack("i", answer) == (1,), "only root may open the device now"
    port.close()


def test_a_pty_stays_open_to_the_program_at_its_other_end(device: str) -> None:
    assert is_pseudo_terminal(device) and not is_pseudo_terminal("/dev/ttyUSB0")
    port = open_port(device, 1_000_000)
    assert struct.unpack("i", fcntl.ioctl(port._serial.fileno(), _TIOCGEXCL, bytes(4))) == (0,)
    port.close()


def test_a_program_that_has_the_device_open_is_named(tmp_path: Path) -> None:
    link = tmp_path / "usb-FTDI-if00"
    link.symlink_to("/dev/null")
    for number, name, file in (
        (12, "screen", "/dev/null"),
        (13, "cat", "/dev/zero"),
        (os.getpid(), "hil", "/dev/null"),
    ):
        files = tmp_path / "proc" / str(number) / "fd"
        files.mkdir(parents=True)
        (files / "3").symlink_to(file)
        (files.parent / "comm").write_text(f"{name}\n")
    assert other_users(str(link), tmp_path / "proc") == ["screen (PID 12)"]


def test_a_device_that_another_program_uses_is_refused_and_closed(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("hil.drivers.port.opening.is_pseudo_terminal", lambda _: False)
        patch.setattr("hil.drivers.port.opening.keep_others_out", lambda _: None)
        patch.setattr("hil.drivers.port.opening.other_users", lambda _: ["screen (PID 12)"])
        with pytest.raises(PortNotOpened, match=r"already open in screen \(PID 12\).*Close that program"):
            open_port(device, 1_000_000)
    open_port(device, 1_000_000).close()


def test_a_device_that_is_busy_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(*_: object, **__: object) -> None:
        raise serial.SerialException(16, "could not open port /dev/ttyACM0: [Errno 16] Device or resource busy: 'x'")

    monkeypatch.setattr(serial, "serial_for_url", busy)
    with pytest.raises(PortNotOpened, match=r"it is in use.*Another program.*ModemManager"):
        open_port("/dev/ttyACM0", 1_000_000)


@pytest.mark.parametrize("baud", [57_600, 1_000_000, 4_500_000])
def test_the_true_baud_rate_is_read(device: str, baud: int) -> None:
    port = open_port(device, baud)
    assert true_baud(port._serial.fileno()) == baud
    port.close()
    with Path("/dev/null").open() as file:
        assert true_baud(file.fileno()) is None


def test_a_baud_rate_that_the_adapter_replaces_by_another_one_is_refused(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """FTDI's driver sets 9600 where a rate is too high, and reports no error."""

    def limited(descriptor: int) -> int | None:
        actual = true_baud(descriptor)
        return actual if actual is None or actual <= 3_000_000 else 9_600

    monkeypatch.setattr("hil.drivers.port.opening.true_baud", limited)
    with pytest.raises(PortNotOpened, match="cannot be set to 4000000 baud: its adapter runs at 9600"):
        open_port(device, 4_000_000)
    port = open_port(device, 1_000_000)
    with pytest.raises(PortNotOpened, match="cannot be set to 4000000 baud"):
        port.set_baud(4_000_000)
    assert port.baud == 1_000_000 == true_baud(port._serial.fileno())
    port.close()


def test_a_baud_rate_that_the_adapter_does_not_hit_exactly_will_do(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.drivers.port.opening.true_baud", lambda _: 1_020_000)
    open_port(device, 1_000_000).close()


def plug_in(sysfs: Path, port: str, socket: str, serial_number: str | None) -> None:
    """A USB serial adapter in a sysfs made of ordinary files."""
    usb = sysfs / "devices" / "usb1" / socket
    interface = usb / f"{socket}:1.0"
    (interface / port).mkdir(parents=True)
    (interface / "bInterfaceNumber").write_text("00\n")
    for name, value in (("idVendor", "0403"), ("idProduct", "6014"), ("serial", serial_number)):
        if value is not None:
            (usb / name).write_text(f"{value}\n")
    tty = sysfs / "class" / "tty" / port
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(interface / port)


def test_an_adapter_keeps_its_name_under_another_port_and_in_another_socket(tmp_path: Path) -> None:
    plug_in(tmp_path / "before", "ttyUSB0", "1-2", "FT4THXYZ")
    plug_in(tmp_path / "after", "ttyUSB1", "1-4", "FT4THXYZ")
    plug_in(tmp_path / "after", "ttyUSB0", "1-2", "FT4OTHER")
    link = tmp_path / "by-id"
    link.symlink_to("/dev/ttyUSB1")
    before = adapter_name("/dev/ttyUSB0", tmp_path / "before")
    assert before == "usb-0403-6014-FT4THXYZ-00" == adapter_name(str(link), tmp_path / "after")
    assert adapter_name("/dev/ttyUSB0", tmp_path / "after") != before
    assert device_of(before, tmp_path / "after") == "/dev/ttyUSB1"
    assert device_of("", tmp_path / "after") is None


def test_an_adapter_without_a_number_of_its_own_has_no_lasting_name(tmp_path: Path) -> None:
    plug_in(tmp_path, "ttyUSB0", "1-2", None)
    plug_in(tmp_path, "ttyUSB1", "1-3", "0001")
    assert adapter_name("/dev/ttyUSB0", tmp_path) == "" != adapter_name("/dev/ttyUSB1", tmp_path)
    plug_in(tmp_path, "ttyUSB2", "1-4", "0001")
    assert device_of("usb-0403-6014-0001-00", tmp_path) is None
    for port in ("/dev/ttyUSB1", "/dev/ttyUSB2", "/dev/ttyS0", "fake://koch"):
        assert adapter_name(port, tmp_path) == ""


def test_an_adapter_that_was_reset_is_used_again_under_its_new_name(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged: dict[str, str] = {}
    monkeypatch.setattr("hil.drivers.port.descriptor_port.adapter_name", lambda _: "usb-A")
    monkeypatch.setattr("hil.drivers.port.descriptor_port.device_of", plugged.get)
    master, slave = os.openpty()
    port = open_port(os.ttyname(slave), 1_000_000)
    os.close(slave)
    os.close(master)
    with pytest.raises(PortLost):
        port.write(b"x")
    assert not port.reopen(), "it is not back"
    with pytest.raises(PortLost):
        port.write(b"x")
    for use in (port.has_input, port.put_aside, port.discard_input, lambda: port.read(1, 0.0)):
        with pytest.raises(PortLost):
            use()
    with pytest.raises(PortLost):
        port.ask(b"y", 1, port.reply_time(0.0, 1), port.clock.now())
    plugged["usb-A"] = device
    assert port.reopen() and port.url == device
    port.write(b"x")
    assert port.ask(b"y", 1, port.reply_time(0.0, 1), port.clock.now()) == b""
    port.close()
