"""The sample rate that a bus can sustain in each exchange mode, measured with torque off.

The sustainable rate depends on servos, cables and adapter. A computer that other programs keep busy delays individual
exchanges. An experiment tolerates this (`hil.experiment.deadlines`), so such outliers are reported but do not limit the
rate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import floor, isinf

import numpy as np

from hil.config.experiment import MIN_RATE
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.drivers.others.heard import MOST_STRANGERS
from hil.drivers.read_back_exchange import ReadBackExchange
from hil.setup.realtime import on_time

CYCLES = 200
MOST_LOST = 2
"""Number of lost replies, out of CYCLES, that do not speak against an exchange mode."""
SLOW_EVERY = 10
USUAL = 0.9
"""Fraction of the exchanges that must be fast enough for the reported rate; an experiment needs 80 % of its
exchanges on time.
"""
PATIENCE_S = 0.05
"""Time after which a reply counts as lost [s]. On a busy computer, the kernel may deliver a reply 10 to 20 ms late."""
AGAIN_AFTER_S = 0.5
"""If the configured rate seems too high for the bus, the bus is measured again after this time [s]."""
SHARE = 0.9
"""Fraction of a period that the exchange may take; the remainder is left for the computer."""
RATE_MARGIN = 1.2
"""Minimum ratio of the measured rate to the rate chosen from it, so that a later measurement confirms the choice."""


@dataclass(frozen=True)
class ExchangeMode:
    """Measured timing of one exchange mode.

    median_s, longest_s: median and maximum of the round trips [s]. slowest_s: median of the round trips with the
    slowest kind of read [s]. usual_s: `slowest_s` plus the 90 % quantile of how much each round trip exceeds the median
    for its kind of read [s]. lost: number of exchanges, out of CYCLES, with replies that were lost, not just late.
    strangers: number of packets heard that another program sent or requested.
    """

    one_write: bool
    fast: bool
    median_s: float
    usual_s: float
    slowest_s: float
    longest_s: float
    lost: int
    strangers: int = 0

    @property
    def name(self) -> str:
        return f"{'Fast Sync Read' if self.fast else 'Sync Read'}, {'one write' if self.one_write else 'two writes'}"

    @property
    def sound(self) -> bool:
        """Whether so few replies were lost that an experiment tolerates it."""
        return self.lost <= MOST_LOST

    @property
    def rate(self) -> float:
        """Exchanges per second that leave time for the computer [Hz]."""
        return SHARE / self.usual_s

    @property
    def highest_rate(self) -> float:
        """Exchanges per second that leave no time for the computer [Hz]."""
        return 1.0 / self.usual_s

    @property
    def whole_rate(self) -> int:
        """`rate` in whole Hz, rounded down, so that a later check accepts it."""
        return floor(self.rate + 1e-6)

    def __str__(self) -> str:
        lost = f", {self.lost} of {CYCLES} replies lost" if self.lost else ""
        times = f"{self.median_s * 1e3:.2f} ms, 90 % within {self.usual_s * 1e3:.2f} ms"
        return f"{times}, longest {self.longest_s * 1e3:.2f} ms: {self.whole_rate} Hz{lost}"


@dataclass(frozen=True)
class RateReport:
    """Measurements of all exchange modes.

    found: what the configured mode can sustain, as text. fix: what to change; empty if the exchanges are fast enough.
    doubt: why deadlines may nevertheless be missed, and what to do about it; empty if nothing suggests this.
    """

    modes: tuple[ExchangeMode, ...]
    found: str
    fix: str
    doubt: str = ""


def check_rate(bus: ServoBus, wanted: float) -> RateReport:
    """Measure every exchange mode, and check whether the configured one sustains `wanted` [Hz]; see `measure_modes`."""
    modes = measure_modes(bus)
    if _configured(bus, modes).rate < wanted:
        # A busy computer delays exchanges only for a while, a slow bus always.
        bus.port.clock.wait_until(bus.port.clock.now() + AGAIN_AFTER_S)
        modes = [_faster(*pair) for pair in zip(modes, measure_modes(bus), strict=True)]
    used = _configured(bus, modes)
    found, fix = f"{used.whole_rate} Hz possible with {used.name}", _fix(used, modes, wanted)
    if shared := shared_with_another(modes):
        return RateReport(tuple(modes), found, shared)
    if fix and used.sound and used.highest_rate >= wanted:
        # `hil identify` would run at this rate, and only a busy computer would miss deadlines.
        found = f"{floor(used.highest_rate)} Hz possible with {used.name}, or {used.whole_rate} Hz with some margin"
        left = max(0.0, 1.0 - used.usual_s * wanted)
        tight = (
            f"The exchanges leave only {100 * left:.0f} % of a period for the computer, which may then be late. {fix}"
        )
        return RateReport(tuple(modes), found, "", tight)
    return RateReport(tuple(modes), found, fix, "" if fix else _delayed(used, wanted))


def shared_with_another(modes: Sequence[ExchangeMode]) -> str:
    """Name another program that was heard while these modes were measured; "" if there was none."""
    if (strangers := max(mode.strangers for mode in modes)) <= MOST_STRANGERS:
        return ""
    return (
        f"Another program uses this bus: {strangers} packets that it sent or requested were heard during {CYCLES} "
        "exchanges, and they collide with replies. Stop that program, or unplug its controller."
    )


def seldom_as_measured(bus: ServoBus, modes: Sequence[ExchangeMode]) -> str:
    """Return the warning of `seldom_read_back` for the measured timing of the configured exchange mode. Raises
    DriverError.
    """
    used = _configured(bus, modes)
    exchange = bus.make_exchange(fast=used.fast, one_write=used.one_write)
    bus.add_read_back(exchange)
    return seldom_read_back(bus, exchange, max(0.0, used.median_s - exchange.usual_wire_s))


def seldom_read_back(bus: ServoBus, exchange: ReadBackExchange, off_wire: float) -> str:
    """Return a warning if cycles leave too little time to read back goals and torque regularly, otherwise "".

    off_wire: duration of an exchange in addition to its wire time [s].
    """
    every, shortest = exchange.read_back_every(off_wire)
    if not every:
        return ""
    often = "never read back" if isinf(every) else f"read back only about every {1e3 * every:.0f} ms"
    return (
        f"At {1 / bus.config.interval:g} Hz and {bus.port.baud} baud, cycles leave too little time to read back what "
        f"the servos hold: their goals are {often}, so another program that writes goals, or a servo that "
        f"has lost its torque, may be noticed late or never. There is enough time at {floor(1 / shortest)} Hz or less, "
        "or at a higher baud rate."
    )


def _faster(first: ExchangeMode, second: ExchangeMode) -> ExchangeMode:
    """Return the faster of two measurements of one mode, but with the larger of their numbers of lost replies."""
    return replace(min(first, second, key=lambda mode: mode.usual_s), lost=max(first.lost, second.lost))


def measure_modes(bus: ServoBus) -> list[ExchangeMode]:
    """Measure every exchange mode on servos whose torque is off, without changing their goals. Raises DriverError.

    Every tenth exchange includes the slow reads, so that their duration is taken into account.
    """
    goals = [servo.read(drive.mode.goal_register) for drive, servo in bus.drives.items()]
    reads = (True, False) if bus.knows_fast_sync_read() else (False,)
    with on_time(bus.port.clock):  # as in an experiment
        return [_measure(bus, goals, fast=fast, one_write=one_write) for fast in reads for one_write in (True, False)]


def choose_mode(bus: ServoBus, modes: Sequence[ExchangeMode], rates: Sequence[float]) -> tuple[ExchangeMode, float]:
    """Return the exchange mode to configure, and the highest of `rates` [Hz] that it sustains with a margin.

    The configured mode is kept unless another one loses fewer replies or sustains a higher rate. If no mode sustains
    even the lowest of `rates`, that rate is returned.
    """

    def highest(mode: ExchangeMode) -> float:
        return max((rate for rate in rates if RATE_MARGIN * rate <= mode.rate), default=min(rates))

    configured = _configured(bus, modes)
    best = max(modes, key=lambda mode: (0 if mode.sound else -mode.lost, highest(mode), mode is configured))
    return best, highest(best)


def _configured(bus: ServoBus, modes: Sequence[ExchangeMode]) -> ExchangeMode:
    """The mode that a run would use. Servos that do not support Fast Sync Read are read with Sync Read."""
    fast = bus.config.fast_sync_read and any(mode.fast for mode in modes)
    return next(mode for mode in modes if (mode.one_write, mode.fast) == (bus.config.one_write, fast))


def goals_taken(bus: ServoBus) -> list[Joint]:
    """Return the servos (as single-servo joints) that accept goals from a Sync Write. Torque must be off. Raises
    DriverError.

    Each servo is sent a goal that differs from its current one. The goal is read back, then the previous one is
    restored.
    """
    before = [servo.read(drive.mode.goal_register) for drive, servo in bus.drives.items()]
    other = [goal - 1 if goal > 0 else goal + 1 for goal in before]
    taken = []
    try:
        fast = bus.config.fast_sync_read and bus.knows_fast_sync_read()
        bus.make_exchange(fast=fast, one_write=bus.config.one_write).cycle(other)
        for (drive, servo), goal in zip(bus.drives.items(), other, strict=True):
            if servo.read(drive.mode.goal_register) == goal:
                taken.append(drive)
    finally:
        _give_back(bus, before)
    return taken


def _give_back(bus: ServoBus, goals: Sequence[int]) -> None:
    """Try to restore the goals of all servos, then raise the first DriverError, if there was one."""
    failures: list[DriverError] = []
    for (drive, servo), goal in zip(bus.drives.items(), goals, strict=True):
        try:
            if servo.read(drive.mode.goal_register) != goal:
                servo.write(drive.mode.goal_register, goal)
        except DriverError as error:
            failures.append(error)
    if failures:
        raise failures[0]


def _measure(bus: ServoBus, goals: Sequence[int], *, fast: bool, one_write: bool) -> ExchangeMode:
    # A run reads the status registers only if the rate leaves time for it, so they do not limit the rate.
    exchange = bus.make_exchange(
        fast=fast, one_write=one_write, slow_every=SLOW_EVERY, status=False, patience=PATIENCE_S
    )
    replies = [exchange.cycle(goals) for _ in range(CYCLES)]
    trips = np.array([reply.time_after_read - reply.time_before_write for reply in replies])
    lost = np.array([None in reply.servos for reply in replies])
    kinds = np.array([reply.span for reply in replies])
    median = {int(kind): float(np.median(trips[kinds == kind])) for kind in np.unique(kinds)}
    excess = trips - np.array([median[kind] for kind in kinds.tolist()])
    slowest = max(median.values())
    usual = slowest + float(np.quantile(excess, USUAL))
    longest = float(trips[~lost].max()) if not lost.all() else PATIENCE_S
    median_s, strangers = float(np.median(trips)), int(max(0.0, exchange.heard.strangers))
    return ExchangeMode(one_write, fast, median_s, usual, slowest, longest, int(lost.sum()), strangers)


def _delayed(used: ExchangeMode, wanted: float) -> str:
    if used.lost:
        return (
            f"{used.lost} of {CYCLES} replies were lost. An experiment tolerates isolated losses, but stops if several "
            "replies in a row are missing: check cables, supply and termination."
        )
    if used.longest_s <= 1 / wanted:
        return ""
    return (
        f"Some exchanges took up to {used.longest_s * 1e3:.0f} ms: other programs are keeping this computer busy, "
        "or the adapter pauses. An experiment tolerates isolated delays, but stops after a long one: close other "
        "programs."
    )


def _fix(used: ExchangeMode, modes: list[ExchangeMode], wanted: float) -> str:
    if used.sound and used.rate >= wanted:
        return ""
    better = next((mode for mode in modes if mode.sound and mode.rate >= wanted), None)
    if better is not None:
        one_write, fast = str(better.one_write).lower(), str(better.fast).lower()
        return f"Set port.one_write = {one_write} and port.fast_sync_read = {fast}."
    if not any(mode.sound for mode in modes):
        return "Replies are lost with every read method: check cables, supply and termination."
    best = max((mode for mode in modes if mode.sound), key=lambda mode: mode.rate)
    busy = (
        "Half of the exchanges are fast enough, so other programs may be keeping this computer busy: close them and "
        "check again. Otherwise: "
        if wanted * best.slowest_s <= SHARE
        else ""
    )
    faster = "raise the baud rate, or lower the latency timer and the return delay."
    if best.rate < MIN_RATE:
        return f"{busy}An experiment needs at least {MIN_RATE} Hz: {faster}"
    return f"{busy}Set experiment.rate to at most {best.whole_rate}, or {faster}"
