"""A fake arm on a terminal device, in real time, for programs in any language.

The host opens `path` like a serial adapter and sets the baud rate on the terminal. Unplugging the cable hangs up the
terminal; replugging it creates a new terminal, to which the symbolic link then points.
"""

import contextlib
import ctypes
import fcntl
import gc
import hashlib
import os
import pty
import select
import socket
import struct
import time
import tty
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from hil.fakes.bus.bus import FakeBus
from hil.fakes.description import FakeArm, make_bus
from hil.fakes.remote_hand import HandSocket

__all__ = ["Counts", "LinkError", "PtyServer", "ServerClock"]

OVERRUN_S = 1e-3
"""A reply delivered more than this long after it was due counts as a real-time overrun [s]."""

TOO_SLOW_S = 5e-3
"""Largest acceptable excess of computing time over simulated time in one pass of the server's loop [s]. If two
consecutive passes exceed this limit, the time beyond the limit is not simulated.
"""

LONGEST_SLEEP_S = 0.05
"""Longest wait before the server checks for faults, watchdog trips and a request to stop [s]."""

MOST_AHEAD_S = 0.02
"""How far ahead of time the server may take bytes from the terminal, measured as their wire time [s].

Further bytes wait in the terminal; once it is full, a host that continues to write blocks, as with a real adapter.
"""

PRIORITY = 10
"""Priority under SCHED_FIFO, if permitted: below that of a control loop on the same computer."""

_TERMINALS = Path("/dev/pts")
_TCGETS2 = 0x802C542A
_PR_SET_TIMERSLACK = 29
_CHUNK = 4096


class LinkError(OSError):
    """The path of the symbolic link cannot be used. The message gives the reason and the remedy."""


class ServerClock:
    """The machine's monotonic clock, minus the time that was not simulated. Only the server itself waits on it."""

    def __init__(self) -> None:
        self.lost_s = 0.0
        """Time that was not simulated because the machine was too slow [s]."""

    def now(self) -> float:
        return time.monotonic() - self.lost_s

    def wait_until(self, deadline: float) -> None:
        """Return immediately: bytes are delivered when they are due."""


class Counts(NamedTuple):
    """Statistics of a server: packets, damaged packets, collisions, overruns, faults; worst delay and time lost [s]."""

    packets: int
    damaged: int
    collisions: int
    overruns: int
    faults: int
    late_max_s: float
    lost_s: float = 0.0


class PtyServer:
    """Serves one fake arm on a pseudo-terminal; `serve` runs until `stop` is called from a thread or signal handler.

    link: symbolic link to create for the terminal. A link left behind by a killed server is replaced; LinkError is
    raised if anything else is at that path, or if a running server uses the link. Another thread that holds `lock` may
    inspect `bus` and use its hand; another process can use the hand with `hil hand`.
    """

    def __init__(self, description: FakeArm, link: Path | None = None) -> None:
        self.lock = Lock()
        self._clock = ServerClock()
        self.bus: FakeBus = make_bus(description, self._clock)
        self.path = ""
        self._link = link
        self._master = self._slave = -1
        self._hand: HandSocket | None = None
        self._claim = None if link is None else _claim(link)
        self._wake_read, self._wake_write = os.pipe()
        self._stopped = False
        self._overruns = 0
        self._late_max_s = 0.0
        self._plug_in()

    def __enter__(self) -> "PtyServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def counts(self) -> Counts:
        bus = self.bus
        return Counts(
            bus.packets,
            bus.damaged_packets,
            bus.collisions,
            self._overruns,
            bus.faults.count,
            self._late_max_s,
            self._clock.lost_s,
        )

    def serve(self, watch: Callable[[Counts], None] | None = None, watch_every_s: float = 0.5) -> None:
        """Serve until stopped. `watch` is called periodically with the statistics."""
        _wake_up_in_time()
        gc.collect()
        gc.freeze()  # otherwise, a full garbage collection scans everything imported, for 10 ms or more
        now = self._clock.now
        next_watch = now() + watch_every_s
        behind = 0.0
        while not self._stopped:
            due = self.bus.next_reply_by
            wait = min(due - now(), LONGEST_SLEEP_S)
            readable: list[int | HandSocket] = [self._wake_read]
            wire_is_free_in = self.bus.sent_by - MOST_AHEAD_S - now()
            if wire_is_free_in > 0.0:
                wait = min(wait, wire_is_free_in)
            elif self._master >= 0:
                readable.append(self._master)
            if self._hand is not None:
                readable.append(self._hand)
            ready, _, _ = select.select(readable, [], [], max(0.0, wait))
            with self.lock:
                began, reached = time.monotonic(), self.bus.advanced_to
                if self._hand is not None and self._hand in ready:
                    self._hand.answer(self.bus)
                if self._master in ready:
                    self._take()
                if now() >= due:
                    self._hand_over(due)
                elif not ready:
                    self.bus.advance(now())
                self._mind_the_cable()
                # On a machine too slow for the arm, the delay would keep growing; instead, the arm's time slows down.
                taken = time.monotonic() - began
                lived = self.bus.advanced_to - reached
                excess = taken - lived
                self._clock.lost_s += max(0.0, min(excess, behind) - TOO_SLOW_S)
                behind = excess
            if watch is not None and now() >= next_watch:
                watch(self.counts)
                next_watch = now() + watch_every_s

    def stop(self) -> None:
        """Make `serve` return. Safe in a signal handler."""
        self._stopped = True
        os.write(self._wake_write, b"x")

    def close(self) -> None:
        """Remove the terminal and the link. May be called twice."""
        self._unplug()
        self._close_wake()
        if self._claim is not None:
            self._claim.close()

    def _take(self) -> None:
        try:
            data = os.read(self._master, _CHUNK)
        except OSError:
            return  # the terminal is being hung up
        self.bus.baud = _baud_of(self._master) or self.bus.baud
        self.bus.write(data)

    def _hand_over(self, due: float) -> None:
        data = self.bus.read(self.bus.in_waiting, 0.0)
        late = self._clock.now() - due
        self._late_max_s = max(self._late_max_s, late)
        self._overruns += late > OVERRUN_S
        if data and self._master >= 0:
            try:
                os.write(self._master, data)
            except BlockingIOError:
                self._overruns += 1  # nobody reads, so the bytes are lost, as with a full adapter buffer

    def _mind_the_cable(self) -> None:
        self.bus.notice_faults()
        if self.bus.cable_is_out and self._master >= 0:
            self._unplug()
        elif not self.bus.cable_is_out and self._master < 0:
            self._plug_in()

    def _plug_in(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)  # kept open, so that the terminal survives when a host closes it
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._hand = HandSocket(self.path)
        if self._link is not None:
            try:
                self._link.symlink_to(self.path)
            except FileExistsError:
                self._link, taken = (
                    None,
                    self._link,
                )  # created by another program, so `close` must not remove it
                self.close()
                raise LinkError(
                    f"{taken} was created by another program while the cable was unplugged and is left as it is. "
                    "Remove it or choose another --link"
                ) from None
            except OSError as error:
                self.close()
                raise LinkError(f"{self._link} cannot be created: {error.strerror}") from error

    def _unplug(self) -> None:
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1
        if self._hand is not None:
            self._hand.close()
            self._hand = None
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.path:
            self._link.unlink()

    def _close_wake(self) -> None:
        for descriptor in (self._wake_read, self._wake_write):
            if descriptor >= 0:
                os.close(descriptor)
        self._wake_read = self._wake_write = -1


def _claim(link: Path) -> socket.socket:
    """Claim a link, and remove it if a killed server left it behind. Raises LinkError if it cannot be used.

    The claim is an abstract Unix socket. It ends when this socket is closed or the process dies.
    """
    path = os.fsencode(link.parent.resolve() / link.name)
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(b"\0hil-fake-link:" + hashlib.sha256(path).hexdigest().encode())  # a name has at most 107 bytes
    except OSError:
        claim.close()
        raise LinkError(
            f"{link} is the link of a fake that is still running; stop it or choose another --link"
        ) from None
    try:
        if link.is_symlink() and (not link.exists() or link.resolve().parent == _TERMINALS):
            link.unlink()
        elif link.exists():
            raise LinkError(f"{link} already exists; remove it or choose another --link")
    except OSError:
        claim.close()
        raise
    return claim


def _baud_of(master: int) -> int:
    """Return the baud rate that the host has set at the other end; 0 if it cannot be determined.

    termios only returns standard rates; the Linux-specific call used here also returns others, such as 4.5 MBd.
    """
    try:
        settings = fcntl.ioctl(master, _TCGETS2, bytes(44))
    except OSError:
        return 0
    return int(struct.unpack_from("<I", settings, 40)[0])


def _wake_up_in_time() -> None:
    """Ask Linux for microsecond timers and real-time scheduling for the server's thread.

    Without them, the servos would fall silent for many milliseconds on a busy computer.
    """
    with contextlib.suppress(OSError):  # not permitted: the server then competes with all other programs
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    try:
        ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    except (OSError, AttributeError):
        return
