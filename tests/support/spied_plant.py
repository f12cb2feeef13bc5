"""A plant wrapper that records current and motion, and can reverse a motor."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Spy:
    """live_until: time of the last current [s]; low, high: extreme positions [rad]; turned: reversed motors."""

    live_until: float = 0.0
    low: list[float] = field(default_factory=lambda: [np.inf, np.inf])
    high: list[float] = field(default_factory=lambda: [-np.inf, -np.inf])
    turned: int | None = None


class SpiedPlant:
    """A plant that reports current and motion to a spy; a reversed motor gets the opposite current."""

    def __init__(self, plant: Any, spy: Spy) -> None:
        self._plant = plant
        self._spy = spy
        self.joints = plant.joints
        self.jam = plant.jam

    @property
    def position(self) -> Sequence[float]:
        return self._plant.position

    @property
    def velocity(self) -> Sequence[float]:
        return self._plant.velocity

    @property
    def current(self) -> Sequence[float]:
        return self._turned(self._plant.current)

    def advance(self, until: float, current: Sequence[float]) -> None:
        self._plant.advance(until, self._turned(current))
        spy = self._spy
        if any(current):
            spy.live_until = until
        for joint, angle in enumerate(self._plant.position):
            spy.low[joint] = min(spy.low[joint], angle)
            spy.high[joint] = max(spy.high[joint], angle)

    def _turned(self, current: Sequence[float]) -> list[float]:
        return [-each if joint == self._spy.turned else each for joint, each in enumerate(current)]


def call_at(port: Any, when: float, action: Callable[[], None]) -> None:
    """Call `action` once, in the first wait that ends after `when` on the port's clock."""
    clock = port.clock
    wait = clock.wait_until
    todo = [action]

    def waiting(deadline: float) -> None:
        wait(deadline)
        if todo and clock.now() >= when:
            todo.pop()()

    clock.wait_until = waiting
