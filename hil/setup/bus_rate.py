"""The rate that a bus can sustain, measured with torque off for every way of sending an exchange."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode

CYCLES = 200
SLOW_EVERY = 10
SHARE = 0.9
"""How much of a period the exchange may take; the rest is the computer's."""


@dataclass(frozen=True)
class Way:
    """One way of sending, measured. median_s, longest_s: round trips, the longest 1 % left out. lost: of CYCLES."""

    one_write: bool
    fast: bool
    median_s: float
    longest_s: float
    lost: int

    @property
    def name(self) -> str:
        return f"{'Fast Sync Read' if self.fast else 'Sync Read'}, {'one write' if self.one_write else 'two writes'}"

    @property
    def sound(self) -> bool:
        return self.lost == 0

    @property
    def rate(self) -> float:
        """Exchanges per second that it can sustain."""
        return SHARE / self.longest_s

    def __str__(self) -> str:
        lost = f", {self.lost} of {CYCLES} replies lost" if self.lost else ""
        return f"{self.median_s * 1e3:.2f} ms, longest {self.longest_s * 1e3:.2f} ms: {self.rate:.0f} Hz{lost}"


@dataclass(frozen=True)
class RateReport:
    """All ways measured; `found` in words what the configured way can hold; `fix` is empty where that is enough."""

    ways: tuple[Way, ...]
    found: str
    fix: str


def check_rate(bus: ServoBus, wanted: float) -> RateReport:
    """Measure every way, on servos whose torque is off and whose goals stay as they are. Raises DriverError.

    Every tenth exchange is one of the slow turns, so that their length counts.
    """
    goals = [servo.read(goal_register(drive)) for drive, servo in bus.drives.items()]
    reads = (True, False) if bus.knows_fast_sync_read() else (False,)
    ways = [_measure(bus, goals, fast=fast, one_write=one_write) for fast in reads for one_write in (True, False)]
    configured = bus.config.one_write, bus.config.fast_sync_read and reads[0]
    used = next(way for way in ways if (way.one_write, way.fast) == configured)
    return RateReport(tuple(ways), f"{used.rate:.0f} Hz possible with {used.name}", _mend(used, ways, wanted))


def goal_register(joint: Joint) -> str:
    """The goal that drives a joint in its mode."""
    return "Goal Current" if joint.mode is Mode.CURRENT else "Goal PWM"


def goals_taken(bus: ServoBus) -> list[Joint]:
    """The joints, one for each servo, that take goals from a Sync Write: each is sent a goal different from its
    present one, read back, and restored. Only with torque off. Raises DriverError.
    """
    before = [servo.read(goal_register(drive)) for drive, servo in bus.drives.items()]
    other = [goal - 1 if goal > 0 else goal + 1 for goal in before]
    taken = []
    try:
        fast = bus.config.fast_sync_read and bus.knows_fast_sync_read()
        bus.make_exchange(fast=fast, one_write=bus.config.one_write).cycle(other)
        for (drive, servo), goal in zip(bus.drives.items(), other, strict=True):
            if servo.read(goal_register(drive)) == goal:
                taken.append(drive)
    finally:
        _give_back(bus, before)
    return taken


def _give_back(bus: ServoBus, goals: Sequence[int]) -> None:
    """To every servo that can still be reached; raises the first DriverError after all were tried."""
    failures: list[DriverError] = []
    for (drive, servo), goal in zip(bus.drives.items(), goals, strict=True):
        try:
            if servo.read(goal_register(drive)) != goal:
                servo.write(goal_register(drive), goal)
        except DriverError as error:
            failures.append(error)
    if failures:
        raise failures[0]


def _measure(bus: ServoBus, goals: Sequence[int], *, fast: bool, one_write: bool) -> Way:
    # A run has its status read only where that fits into the rate: it does not bound the rate that is possible.
    exchange = bus.make_exchange(fast=fast, one_write=one_write, slow_every=SLOW_EVERY, status=False)
    trips = np.empty(CYCLES)
    lost = 0
    for index in range(CYCLES):
        reply = exchange.cycle(goals)
        trips[index] = reply.time_after_read - reply.time_before_write
        lost += None in reply.servos
    return Way(one_write, fast, float(np.median(trips)), float(np.quantile(trips, 0.99)), lost)


def _mend(used: Way, ways: list[Way], wanted: float) -> str:
    if used.sound and used.rate >= wanted:
        return ""
    better = next((way for way in ways if way.sound and way.rate >= wanted), None)
    if better is not None:
        one_write, fast = str(better.one_write).lower(), str(better.fast).lower()
        return f"Set port.one_write = {one_write} and port.fast_sync_read = {fast}."
    if not any(way.sound for way in ways):
        return "Replies are lost with every read method: check cables, supply and termination."
    best = max((way for way in ways if way.sound), key=lambda way: way.rate)
    return (
        f"Set experiment.rate to at most {best.rate:.0f}, or raise the baud, or lower latency timer and return delay."
    )
