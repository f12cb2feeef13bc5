"""The fake arm on a terminal: baud rate, link, cable, clocks; `hil fake` and its error messages."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import serial

from hil.cli.app import main
from hil.drivers.packet import BROADCAST_ID, Instruction, encode, encode_status
from hil.fakes.bus.faults import Fault
from hil.fakes.description import load_fake
from hil.fakes.pty_server import LinkError, PtyServer
from tests.support.command_line import hil
from tests.support.paths import ROOT
from tests.support.processes import forked

CONFIG = ROOT / "configs" / "fake_two_link.toml"
PING = encode(1, Instruction.PING)
PONG = encode_status(1, 0, b"\xfc\x03\x30")


@pytest.fixture
def serve() -> Callable[..., PtyServer]:
    """Return a function that starts servers in threads and stops them after the test."""
    running: list[tuple[PtyServer, Thread]] = []

    def start(*faults: Fault, link: Path | None = None) -> PtyServer:
        server = PtyServer(load_fake(CONFIG).model_copy(update={"faults": faults}), link)
        thread = Thread(target=server.serve, daemon=True)
        thread.start()
        running.append((server, thread))
        return server

    yield start  # type: ignore[misc]
    for server, thread in running:
        server.stop()
        thread.join(5.0)
        assert not thread.is_alive()
        server.close()


def opened(path: str, baud: int = 1_000_000) -> serial.Serial:
    return serial.Serial(path, baud, timeout=1.0)


Serve = Callable[..., PtyServer]


def test_a_real_terminal_answers(serve: Serve) -> None:
    server = serve()
    with opened(server.path) as port:
        for _ in range(50):
            port.write(PING)
            assert port.read(14) == PONG
        port.write(encode(BROADCAST_ID, Instruction.SYNC_READ, b"\x7e\0\x0a\0\x01\x02"))
        assert len(port.read(42)) == 42
    with opened(server.path) as port:  # and again, for the next program
        port.write(PING)
        assert port.read(14) == PONG
    assert server.counts.packets == 52


@pytest.mark.parametrize("junk", [b"\xff" * 4096, encode(1, Instruction.READ, b"\x84\0\4\0") * 200])
def test_a_host_cannot_write_faster_than_the_wire(serve: Serve, junk: bytes) -> None:
    server = serve()
    with opened(server.path) as port:
        port.write_timeout = 0.1
        written, began = 0, time.monotonic()
        while time.monotonic() - began < 0.5:
            with contextlib.suppress(serial.SerialTimeoutException):
                written += port.write(junk)
        port.reset_output_buffer()
        answered = False
        while not answered and time.monotonic() - began < 20.0:
            port.reset_input_buffer()
            port.write(PING)
            answered = PONG in port.read(4096)
        assert answered
        assert time.monotonic() - began < 5.0
        assert written < 1_000_000


def test_the_terminals_baud_is_the_buss(serve: Serve) -> None:
    server = serve()
    with opened(server.path, 4_500_000) as port:
        port.timeout = 0.05
        port.write(PING)
        assert port.read(14) == b""
        give_up = time.monotonic() + 10.0
        while server.bus.baud != 4_500_000 and time.monotonic() < give_up:
            time.sleep(0.01)  # the server looks at the terminal in its own time, also on a busy computer
        assert server.bus.baud == 4_500_000
        port.baudrate = 1_000_000
        port.timeout = 1.0
        port.write(PING)
        assert port.read(14) == PONG


def test_time_passes_by_itself(serve: Serve) -> None:
    server = serve()
    with opened(server.path) as port:
        for body in (b"\x0b\0\0", b"\x66\0\0\0", b"\x62\0\x03", b"\x40\0\x01", b"\x66\0\x32\0"):
            port.write(encode(1, Instruction.WRITE, body))
            assert port.read(11)[8] == 0
    deadline = time.monotonic() + 5.0
    while time.monotonic() < deadline:
        with server.lock:
            if server.bus.servos[1].watchdog_tripped:
                break
        time.sleep(0.02)
    with server.lock:
        assert server.bus.servos[1].watchdog_tripped
        assert server.bus.plant.position[0] > -1.5707963  # it was pushed before


def test_link_is_made_and_taken_away(serve: Serve, tmp_path: Path) -> None:
    link = tmp_path / "arm"
    server = PtyServer(load_fake(CONFIG), link)
    assert str(link.readlink()) == server.path
    server.close()
    server.close()
    assert not link.is_symlink()


def test_a_link_that_exists_or_cannot_be_made(tmp_path: Path) -> None:
    taken = tmp_path / "arm"
    taken.write_text("mine")
    descriptors = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    with pytest.raises(LinkError, match="arm already exists; remove it or choose another"):
        PtyServer(load_fake(CONFIG), taken)
    with pytest.raises(LinkError, match="cannot be created: No such file or directory"):
        PtyServer(load_fake(CONFIG), tmp_path / "nowhere" / "arm")
    assert taken.read_text() == "mine"
    assert len(os.listdir("/proc/self/fd")) == descriptors  # noqa: PTH208


def test_a_link_left_by_a_killed_fake_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "arm"
    command = ["hil", "fake", str(CONFIG), "--pty", "--link", str(link)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with forked.start(command, stdout=subprocess.PIPE, cwd=ROOT, env=environment) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            with pytest.raises(LinkError, match="arm is the link of a fake that is still running; stop it or choose"):
                PtyServer(load_fake(CONFIG), link)
        finally:
            process.kill()
    assert link.is_symlink()
    with PtyServer(load_fake(CONFIG), link) as server:
        assert str(link.readlink()) == server.path


def test_a_link_that_points_to_a_terminal_or_to_nothing_is_replaced_and_no_other(tmp_path: Path) -> None:
    link, file = tmp_path / "arm", tmp_path / "file"
    file.write_text("mine")
    with PtyServer(load_fake(CONFIG)) as other:
        for target in (other.path, "/dev/pts/999999"):
            link.symlink_to(target)
            with PtyServer(load_fake(CONFIG), link) as server:
                assert str(link.readlink()) == server.path
    for target in (str(file), "/dev/null"):
        link.symlink_to(target)
        with pytest.raises(LinkError, match="arm already exists; remove it or choose another"):
            PtyServer(load_fake(CONFIG), link)
        assert str(link.readlink()) == target
        link.unlink()


def used_until_hung_up(port: serial.Serial) -> None:
    with pytest.raises((OSError, serial.SerialException)):
        for _ in range(1000):
            port.write(PING)
            port.read(14)
            time.sleep(0.01)
    port.close()


def within_five_seconds(holds: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + 5.0
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.02)
    return holds()


def test_a_pulled_cable_hangs_up_and_removes_the_link(serve: Serve, tmp_path: Path) -> None:
    link = tmp_path / "arm"
    serve(Fault(kind="cable_pulled", at=0.3), link=link)  # for good: a slow test cannot miss that the link is gone
    used_until_hung_up(opened(str(link)))
    assert within_five_seconds(lambda: not link.is_symlink())


def test_a_pulled_cable_comes_back(serve: Serve, tmp_path: Path) -> None:
    link = tmp_path / "arm"
    server = serve(Fault(kind="cable_pulled", at=0.3, duration=0.3), link=link)
    used_until_hung_up(opened(str(link)))
    assert within_five_seconds(link.exists)
    with opened(str(link)) as port:
        port.write(PING)
        assert port.read(14) == PONG
    assert server.bus.pulls == 1


# hil fake


def exit_of(*arguments: str) -> int:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", ["hil", "fake", *arguments])
        main()
    return int(left.value.code or 0)


def test_without_pty_it_says_what_the_arm_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_of(str(CONFIG), "--fault", "lost_reply:servo=2,probability=0.1", "--seed", "7") == 0
    said = capsys.readouterr().out
    assert "ID 1: XM430-W350, firmware 48, 1000000 baud" in said
    assert "seed 7" in said
    assert "fault: lost_reply at 0 s for inf s, probability 0.1" in said


def test_list_of_faults(capsys: pytest.CaptureFixture[str]) -> None:
    assert exit_of(str(CONFIG), "--list-faults") == 0
    assert "encoder_jump" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("nowhere.toml", "--pty"), "nowhere.toml cannot be read"),
        ((str(CONFIG), "--pty", "--link", str(CONFIG)), "already exists"),
        ((str(CONFIG), "--pty", "--fault", "gone"), "kinds: lost_reply"),
        ((str(CONFIG), "--pty", "--fault", "overload:servo=9"), "servo = 9, but the IDs in"),
    ],
)
def test_wrong_input_is_one_message(capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str) -> None:
    assert exit_of(*arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("hil: ")
    assert said in captured.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_a_signal_and_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    link = tmp_path / "arm"
    command = ["hil", "fake", str(CONFIG), "--pty", "--link", str(link)]
    options: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "cwd": ROOT}
    options["env"] = {**os.environ, "PYTHONPATH": str(ROOT)}
    with (
        subprocess.Popen([sys.executable, "-m", *command], **options)
        if number == signal.SIGINT
        else forked.start(command, **options)
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().decode().strip() == str(link)
        with opened(str(link)) as port:
            port.write(PING)
            assert port.read(14) == PONG
        process.send_signal(number)
        _, err = process.communicate(timeout=10.0)
    assert process.returncode == 0
    assert err.decode().startswith("1 packets, 0 damaged, 0 collisions, 0 faults")
    assert not link.is_symlink()


# The hand, from another process


@pytest.mark.parametrize("through", ["path", "link"])
def test_a_hand_moves_a_joint_while_the_terminal_is_served(serve: Serve, tmp_path: Path, through: str) -> None:
    link = tmp_path / "arm"
    server = serve(link=link)
    device = str(link if through == "link" else server.path)
    assert hil("hand", device, "1:to=-1.2,duration=0.2", "2:ticks=2500,duration=0.2") == 0
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        with server.lock:
            ticks = server.bus.servos[2].present.ticks(server.bus.plant.position[1])
            held = server.bus.hand.holds
        if abs(ticks - 2500) < 5 and held == {0, 1}:
            break
        time.sleep(0.02)
    assert ticks == pytest.approx(2500, abs=5)
    assert hil("hand", device, "--release", 1, "--release", 2) == 0
    with server.lock:
        assert not server.bus.hand.busy


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("9:to=1",), "no servo has the ID 9"),
        (("1:to=x",), "must be a number"),
        (("1",), "give either `to`"),
    ],
)
def test_a_hand_that_cannot_says_why(
    serve: Serve, arguments: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hil("hand", serve().path, *arguments) == 2
    assert said in capsys.readouterr().err


def test_a_hand_says_that_torque_is_on(serve: Serve, capsys: pytest.CaptureFixture[str]) -> None:
    server = serve()
    with server.lock:
        server.bus.servos[2].write(64, b"\1")
    assert hil("hand", server.path, "1:to=-1.2", "2:ticks=1000") == 2
    assert "the torque of servo 2 is on" in capsys.readouterr().err
    with server.lock:
        assert not server.bus.hand.busy


def test_a_hand_needs_an_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("hand", tmp_path / "arm", "1:to=0") == 2
    assert "hil fake ARM --pty" in capsys.readouterr().err


def test_moves_of_the_command_line_are_described(capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("fake", "koch", "--move", "3:to=0.5,at=2") == 0
    assert "hand: servo 3 to 0.5 rad at 2 s, taking 1 s" in capsys.readouterr().out
    assert hil("fake", "koch", "--move", "7:to=0.5") == 2
    assert "servo = 7" in capsys.readouterr().err
