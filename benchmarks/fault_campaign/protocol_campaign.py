"""The pyserial URL `campaign://`: the arm under test behind a man in the middle. pyserial finds this module by name.

To the program it is an ordinary port: nothing in its name reveals that the arm is a fake.
"""

from typing import Any

from benchmarks.fault_campaign.middle import Middle, Opened
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import FakeArm


class Bench:
    """The single arm under test, its port, and a callback for the first time that the port is opened."""

    arm: FakeArm | None = None
    port: Middle | None = None
    opened: Opened = staticmethod(lambda port: None)

    @classmethod
    def lay(cls, arm: FakeArm, opened: Opened) -> None:
        """Replace the arm; the new one is switched on when its port is first opened."""
        cls.arm, cls.port, cls.opened = arm, None, staticmethod(opened)


class BenchPort(Middle):
    """A port of the arm under test; ports opened later find the arm in its current state."""

    def __init__(self, port: str | None = None, *args: Any, **kwargs: Any) -> None:
        kwargs["description"] = Bench.arm
        kwargs["clock"] = VirtualClock() if Bench.port is None else Bench.port.clock
        super().__init__(port, *args, **kwargs)

    def open(self) -> None:
        before = Bench.port
        if before is not None and before is not self:
            self._bus = before._bus
            self.traffic, self.over = before.traffic, before.over
        super().open()
        if before is None:
            Bench.port = self
            Bench.opened(self)


def serial_class_for_url(url: str) -> tuple[str, type[BenchPort]]:
    """Entry point for pyserial: the port's name and class for a URL."""
    return url, BenchPort
