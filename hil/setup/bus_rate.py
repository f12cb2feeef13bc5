"""What rate a bus can hold, measured with torque off, in every way in which an exchange can be sent."""

from dataclasses import dataclass

import numpy as np

from hil.drivers.bus import ServoBus

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
        """Exchanges per second that it can hold."""
        return SHARE / self.longest_s

    def __str__(self) -> str:
        lost = f", {self.lost} of {CYCLES} replies lost" if self.lost else ""
        return f"{self.median_s * 1e3:.2f} ms, longest {self.longest_s * 1e3:.2f} ms: {self.rate:.0f} Hz{lost}"


@dataclass(frozen=True)
class RateReport:
    """All ways measured; `found` in words what the configured way can hold; `mend` is empty where that is enough."""

    ways: tuple[Way, ...]
    found: str
    mend: str


def check_rate(bus: ServoBus, wanted: float) -> RateReport:
    """Measure every way with goals of 0, on servos whose torque is off. Raises DriverError.

    Every tenth exchange is one of the slow turns, so that their length counts.
    """
    reads = (True, False) if bus.knows_fast_sync_read() else (False,)
    ways = [_measure(bus, fast=fast, one_write=one_write) for fast in reads for one_write in (True, False)]
    configured = bus.config.one_write, bus.config.fast_sync_read and reads[0]
    used = next(way for way in ways if (way.one_write, way.fast) == configured)
    return RateReport(tuple(ways), f"{used.rate:.0f} Hz possible with {used.name}", _mend(used, ways, wanted))


def _measure(bus: ServoBus, *, fast: bool, one_write: bool) -> Way:
    exchange = bus.make_exchange(fast=fast, one_write=one_write, slow_every=SLOW_EVERY)
    nothing = [0] * len(exchange.ids)
    trips = np.empty(CYCLES)
    lost = 0
    for index in range(CYCLES):
        reply = exchange.cycle(nothing)
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
        return "Replies get lost whichever way they are asked for: check cables, supply and termination."
    best = max((way for way in ways if way.sound), key=lambda way: way.rate)
    return (
        f"Set experiment.rate to at most {best.rate:.0f}, or raise the baud, or lower latency timer and return delay."
    )
