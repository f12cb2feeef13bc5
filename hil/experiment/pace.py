"""Timing of a stream's exchanges: samples, exchanges between samples, and the read-backs before each of them."""

from collections.abc import Iterator, Sequence
from math import inf

from hil.drivers.bus import ServoBus
from hil.drivers.rate import FixedRate, Tick
from hil.drivers.state import State
from hil.experiment.guard import Guard

_FORGETS = 0.98
"""Factor by which the stored longest duration of an exchange decays with each exchange."""


def read_back(bus: ServoBus, guard: Guard, due: float) -> None:
    """Check for goals from another program just before the exchange scheduled for `due` [s]; report lost goals, lost
    torque and changed watchdogs to the guard.
    """
    bus.check_not_overruled(due)
    if (changed := bus.watchdog_changed) is not None:
        guard.watchdog_reads(*changed)
    if (dead := bus.torque_lost) is not None:
        guard.torque_is_off(dead)
    if (lost := bus.goals_lost) is not None:
        guard.goals_are_lost(*lost)


class Pace:
    """Sends goals when they are due. Every method may raise the errors of `ServoBus.exchange`.

    rate: samples per second. guard: is told when this program wakes up, and which goals do not arrive.
    """

    def __init__(self, bus: ServoBus, rate: float, guard: Guard) -> None:
        self._bus = bus
        self._exchange = bus.prepared
        self._clock = bus.port.clock
        self._guard = guard
        self._ticks = FixedRate(bus.port.clock, rate)
        self.interval = 1 / rate
        """Time between two samples [s]."""
        self.turns = bus.exchanges_per_sample
        """Number of exchanges per sample."""
        self._apart = self.interval / self.turns
        self._deadline: float | None = None
        self._takes, self._took = 0.0, inf
        self._awake_at = -inf
        self.sent_at: float | None = None
        """When the latest goals were sent [s]; None before the first ones."""

    def wait(self) -> Tick:
        """Wait until the next sample is due. If a read-back is due, it takes place just before the sample."""
        former = self._deadline
        if former is not None and self._exchange.read_back_at <= former + self.interval:
            read_back(self._bus, self._guard, former + self.interval)
        tick = self._ticks.wait()
        deadline, now, _ = tick
        awake_at = max(self._awake_at, self._exchange.awaited_until)  # a second read-back delays this sample on purpose
        self._guard.woke_up(now, now - (deadline if deadline > awake_at else awake_at))
        self._deadline, self._awake_at = deadline, now
        return tick

    def send(self, goal: Sequence[float]) -> State:
        """Send the goals of a sample [A or V]; return the state."""
        state = self._bus.exchange(goal)
        self.sent_at, self._awake_at = state.time_before_write, state.time_after_read
        return state

    def between(self, goal: Sequence[float]) -> Iterator[State]:
        """Repeat the exchange with the same goals until the next sample is due; yield each state.

        An exchange that might delay the next sample is skipped: the adapter may be slow, or a servo silent. A single
        long exchange, while this computer was busy, is no reason to skip the next ones.
        """
        if self._deadline is None:
            return
        following = self._deadline + self.interval
        for turn in range(1, self.turns):
            due = self._deadline + turn * self._apart
            if self._exchange.read_back_at <= due:
                read_back(self._bus, self._guard, due)
            self._clock.wait_until(due)
            now = self._clock.now()
            if now - due < self._apart and now + self._takes < following:
                state = self._bus.exchange(goal, between=True)
                self.sent_at, self._awake_at = state.time_before_write, state.time_after_read
                took = state.time_after_read - state.time_before_write
                self._takes, self._took = max(_FORGETS * self._takes, min(took, self._took)), took
                yield state
