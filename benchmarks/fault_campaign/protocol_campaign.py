"""The pyserial URL `campaign://`: the arm under test behind a man in the middle. pyserial finds this module by name.

To the program it is a port as any other: nothing in its name says that the arm is a fake.
"""

from typing import Any

from benchmarks.fault_campaign.middle import Middle, Opened
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import FakeArm


class Bench:
    """The one arm on the bench: what it is, since when, and whom to tell when its port is opened for the first time."""

    arm: FakeArm | None = None
    port: Middle | None = None
    opened: Opened = staticmethod(lambda port: None)

    @classmethod
    def lay(cls, arm: FakeArm, opened: Opened) -> None:
        """Put another arm there, switched on at its first opening."""
        cls.arm, cls.port, cls.opened = arm, None, staticmethod(opened)


class BenchPort(Middle):
    """A port onto the arm on the bench. Ports opened later find the arm as it was left."""

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
    """What pyserial asks of a module that handles a URL: the port's name and its class."""
    return url, BenchPort
