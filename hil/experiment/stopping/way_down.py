"""The way down: exchanges with a spatial arm from the stop until it lies in its rest pose.

`hil.experiment.stopping.lowering` computes the goals and checks the replies; this module sends, receives and records
them in time.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.rate import FixedRate
from hil.drivers.state import State
from hil.drivers.torque.off import TRIP_S
from hil.errors import ExperimentError, SafetyStop, StopRequested
from hil.experiment.chain_watch import ChainWatch
from hil.experiment.guard import Guard
from hil.experiment.stop_request import StopRequest
from hil.experiment.stopping.lowering import Lowering
from hil.plan.plan import Plan
from hil.plan.silence import BRIDGED_S
from hil.runs.recording import Phase, Recorder, missed

LATE_REPLIES_S = 0.008
"""How much longer replies are awaited while the arm is lowered [s]."""


class Stopped(NamedTuple):
    """Where a stream was stopped.

    latest, whole: the latest state, and the latest one with replies of all servos; None if there is none. goal: latest
    goals [A, or V under PWM]. sent_at: when they were sent [s]. segment: number of the multisine.
    """

    latest: State | None
    whole: State | None
    goal: list[float]
    sent_at: float | None
    segment: int

    @property
    def is_blind(self) -> bool:
        """Whether replies were missing in the latest exchange."""
        return self.latest is not None and any(self.latest.missing)


class WayDown:
    """Lowers an arm whose stream has been stopped. Create it before torque is on: it precomputes as much as possible.

    guard, watch: the stream's own checks, which have seen the motion so far. note: called with each event.
    """

    def __init__(
        self,
        bus: ServoBus,
        plan: Plan,
        config: Config,
        recorder: Recorder,
        stop: StopRequest,
        note: Callable[[str], None],
        guard: Guard,
        watch: ChainWatch | None,
    ) -> None:
        self._bus = bus
        self._clock = bus.port.clock
        self._config = config
        self._rate = plan.rate
        self._interval = 1 / plan.rate
        self._turns = bus.exchanges_per_sample
        self._apart = self._interval / self._turns
        self._recorder = recorder
        self._stop = stop
        self._note = note
        self._guard = guard
        self._watch = watch
        self._lowering = Lowering(config, plan, self._apart)
        self._takes = 0.0
        self._goal: list[float] = []
        self._deadline = self._sent_at = 0.0

    def lower(self, error: ExperimentError, stopped: Stopped) -> None:
        """Brake and lower the arm until it is at rest, a check fails, or a second signal arrives. Never raises.

        error: the stop, which is told how this ended.
        """
        state = stopped.whole
        if state is None or stopped.latest is None or any(stopped.latest.error) or self._lowering.lies(state):
            return
        if stopped.is_blind and self._clock.now() - state.time_before_write > BRIDGED_S:
            return
        since = 0.0 if stopped.sent_at is None else self._clock.now() - stopped.sent_at
        if self._bus.is_watched and since >= self._config.safety.watchdog + TRIP_S:
            self._told(error, "The arm could not be lowered: the servos' watchdogs had already acted, so it fell.")
            return
        self._note(f"lowering the arm after: {error}")
        try:
            state = self._follow(state, stopped)
        except (SafetyStop, StopRequested, DriverError) as ended:
            fell = "Torque was cut while the arm was being lowered, so it fell the rest of the way"
            self._told(error, f"{fell}: {ended}")
            return
        elsewhere = self._lowering.lies_elsewhere(state)
        done = f"was lowered, but not to its rest pose: {elsewhere}" if elsewhere else "was lowered to its rest pose"
        self._told(error, f"The arm {done}.")

    def _follow(self, state: State, stopped: Stopped) -> State:
        """Follow the path home; return the last state. Raises SafetyStop, StopRequested, DriverError."""
        lowering, asked = self._lowering, max(1, self._stop.count)
        # The deadlines missed so far are not those of the way down.
        ticks = FixedRate(self._clock, self._rate)
        self._sent_at, self._goal = self._clock.now(), stopped.goal
        # Replies that are merely late are worth a missed deadline: without them, nothing corrects the way down.
        self._bus.prepared.wait_longer(LATE_REPLIES_S)
        # The path begins with the latest state that is known, which may be a few exchanges old.
        old = self._clock.now() - state.time_before_write if stopped.is_blind else 0.0
        passed = round(old / self._interval)
        for index in range(passed, lowering.begin(state, self._goal, self._guard.recent, self._watch)):
            for checked in self._between_samples() if index > passed else ():
                lowering.look(index - 1, checked, checked.time_before_write - state.time_before_write, between=True)
                state = checked
            if index > passed:
                self._look_for_another_master(self._interval)
            deadline, now, late = ticks.wait()
            self._deadline = deadline
            self._stop.check_again(asked)
            if late:
                self._recorder.keep(deadline, Phase.LOWERING, stopped.segment, -1, missed(self._goal, now))
                lowering.late(now - self._sent_at)
                continue
            self._goal = lowering.goals(index, state)
            former, state = state.time_before_write, self._bus.exchange(self._goal)
            self._sent_at = state.time_before_write
            self._recorder.keep(deadline, Phase.LOWERING, stopped.segment, -1, state)
            lowering.look(index, state, state.time_before_write - former)
        return state

    def _between_samples(self) -> Iterator[State]:
        """Exchange the same goals until the next sample is due; yield each state.

        An exchange that might delay the next sample is left out.
        """
        following = self._deadline + self._interval
        for turn in range(1, self._turns):
            due = self._deadline + turn * self._apart
            self._look_for_another_master(turn * self._apart)
            self._clock.wait_until(due)
            now = self._clock.now()
            if now - due < self._apart and now + self._takes < following:
                state = self._bus.exchange(self._goal, between=True)
                self._sent_at = state.time_before_write
                self._takes = max(self._takes, state.time_after_read - state.time_before_write)
                yield state

    def _look_for_another_master(self, later: float) -> None:
        """If a read-back is due, do it just before the exchange that is due `later` [s] after the sample."""
        if self._bus.prepared.read_back_at <= self._deadline + later:
            self._bus.check_not_overruled(self._deadline + later)
            if (lost := self._bus.goals_lost) is not None:
                self._guard.goals_are_lost(*lost)

    def _told(self, error: ExperimentError, what: str) -> None:
        error.add_note(what)
        self._note(what)
