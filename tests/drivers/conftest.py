"""The fake arm in two forms: in virtual time through fake://, and on a pty in real time, with a cable to unplug."""

import contextlib
import os
import select
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from hil import fakes
from hil.drivers.bus import BusConfig
from hil.drivers.clock import WallClock
from hil.drivers.joint import Joint
from hil.drivers.servo_model import servo_model
from hil.fakes.bus.bus import FakeBus
from hil.fakes.description import load_fake, make_bus
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link_ideal.toml"

JOINTS = (
    Joint("shoulder", 1, servo_model("XM430-W350"), zero_ticks=3072),
    Joint("elbow", 2, servo_model("XM430-W350"), zero_ticks=2048),
)


class ServedPty:
    """A pty whose far end is the fake bus, served by a thread in real time. `pull` removes the far end."""

    def __init__(self) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        os.close(slave)
        self.bus: FakeBus = make_bus(load_fake(CONFIG), WallClock())
        self.bus.baud = 1_000_000
        self._stop, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """Remove the far end; has no effect if it is already gone."""
        if self._thread.is_alive():
            os.write(self._wake, b"x")
            self._thread.join()
            for descriptor in (self._master, self._stop, self._wake):
                os.close(descriptor)

    def _serve(self) -> None:
        while True:
            ready, _, _ = select.select([self._master, self._stop], [], [], 5.0)
            if self._stop in ready or not ready:
                return
            # The other end may be closed for a while, between two clients.
            with contextlib.suppress(OSError):
                self.bus.write(os.read(self._master, 4096))
                while (count := self.bus.on_the_way) > 0:
                    os.write(self._master, self.bus.read(count, 0.1))


@pytest.fixture
def served_pty() -> Iterator[Callable[[], ServedPty]]:
    """Return a function that serves fakes on ptys, all of which are removed after the test."""
    made = []

    def make() -> ServedPty:
        made.append(ServedPty())
        return made[-1]

    yield make
    for each in made:
        each.pull()


@pytest.fixture
def fake_config() -> Callable[..., BusConfig]:
    """Return the bus configuration of the fake arm in virtual time; keyword arguments override its settings."""
    fakes.register()

    def make(url: str = f"fake://{CONFIG}", joints: tuple[Joint, ...] = JOINTS, **settings: object) -> BusConfig:
        return BusConfig(url, 1_000_000, joints, **settings)  # type: ignore[arg-type]

    return make


@pytest.fixture
def fake_file(tmp_path: Path) -> Callable[..., str]:
    """Return the URL of the fake arm with changes to its TOML, given as pairs (old, new)."""

    def write(*changes: tuple[str, str]) -> str:
        text = CONFIG.read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text, f"{old!r} is not in {CONFIG.name}"
            text = text.replace(old, new)
        path = tmp_path / "arm.toml"
        path.write_text(text, encoding="utf-8")
        return f"fake://{path}"

    return write
