"""Exchanges with a spatial arm from the moment it is stopped until it lies in its rest pose.

`hil.experiment.stopping.lowering` computes the goals and checks the replies; this module sends, receives and records
them in time.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusOverheard, DriverError
from hil.drivers.packet import ALERT
from hil.drivers.state import State
from hil.drivers.torque.off import TRIP_S
from hil.errors import Cause, ExperimentError, SafetyStop, StopRequested
from hil.experiment.chain_watch import ChainWatch
from hil.experiment.guard import Guard
from hil.experiment.pace import read_back
from hil.experiment.stop_request import StopRequest
from hil.experiment.stopping.lowering import Lowering, may_lower
from hil.experiment.stopping.pace import LONGER_S, Pace
from hil.experiment.stopping.position_steps import PositionSteps
from hil.plan.plan import Plan
from hil.plan.silence import BRIDGED_ALONE_S, BRIDGED_S
from hil.runs.recording import Phase, Recorder, missed

_RECENT_S = 0.1
"""Time after a late or damaged reply during which further ones are expected [s]."""


class Stopped(NamedTuple):
    """State of a stream when it was stopped.

    latest, whole: the latest state, and the latest one with replies from all servos; None if there is none. goal:
    latest goals [A, or V in PWM mode]. sent_at: when they were sent [s]. segment: index of the multisine being played.
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
        self._interval = 1 / plan.rate
        self._turns = bus.exchanges_per_sample
        self._apart = self._interval / self._turns
        self._recorder = recorder
        self._stop = stop
        self._note = note
        self._guard = guard
        self._watch = watch
        self._lowering = Lowering(config, plan, self._apart)
        self._pace: Pace
        self._takes = 0.0
        self._alerts: list[bool] = []
        self._goal: list[float] = []
        self._deadline = self._sent_at = self._heard_at = 0.0
        self._was_silent = self._is_shared = False

    def lower(self, error: ExperimentError | BusOverheard, stopped: Stopped) -> None:
        """Brake and lower the arm, if that may be done after `error`, until it is at rest, a check fails, or a second
        signal arrives. Never raises.

        error: the exception that stopped the stream; a note that says how lowering ended is added to it.
        """
        state = stopped.whole
        if state is None or stopped.latest is None or self._lowering.lies(state):
            return
        if not may_lower(self._config, error):
            why = 'safety.stop = "cut"' if self._config.safety.stop == "cut" else "its servos could not be relied on"
            self._told(error, f"The arm was not lowered, so it fell: {why}.")
            return
        self._alerts = [bool(each & ALERT) for each in stopped.latest.error]
        if prevented := self._why_not(error, stopped, stopped.latest, state):
            self._told(error, f"The arm could not be lowered, so it fell: {prevented}.")
            return
        self._note(f"lowering the arm after: {error}")
        if isinstance(error, SafetyStop) and error.cause is Cause.WATCHDOG:
            self._bus.rearm_watchdogs()
        try:
            state = self._follow(state, stopped)
        except (SafetyStop, StopRequested, DriverError) as ended:
            fell = "Torque was cut while the arm was being lowered, so it fell the rest of the way"
            self._told(error, f"{fell}: {ended}")
            return
        elsewhere = self._lowering.lies_elsewhere(state)
        done = f"was lowered, but not to its rest pose: {elsewhere}" if elsewhere else "was lowered to its rest pose"
        self._told(error, f"The arm {done}.")

    def _why_not(
        self, error: ExperimentError | BusOverheard, stopped: Stopped, latest: State, whole: State
    ) -> str | None:
        """Say what prevents lowering, or return None."""
        if any(each & ~ALERT for each in latest.error):
            return "a servo answered with an error instead of its position"
        is_alert = isinstance(error, SafetyStop) and error.cause is Cause.ALERT
        if (is_alert or any(self._alerts)) and not self._bus.has_torque():
            return "a servo had lost its torque"
        if stopped.is_blind and self._is_silent_too_long(latest, whole):
            return "replies had been missing for too long"
        since = 0.0 if stopped.sent_at is None else self._clock.now() - stopped.sent_at
        if self._bus.is_watched and since >= self._config.safety.watchdog + TRIP_S:
            return "the servos' watchdogs had already tripped"
        return None

    def _is_silent_too_long(self, latest: State, whole: State) -> bool:
        """Whether replies have been missing for longer than lowering can tolerate.

        At most one packet is sent to find this out, because every packet also resets the watchdog of a servo whose ID
        has changed.
        """
        since = self._clock.now() - whole.time_before_write
        asked = latest.time_before_write - whole.time_before_write
        if asked <= BRIDGED_ALONE_S and since <= BRIDGED_ALONE_S + LONGER_S:
            return False
        if since > BRIDGED_S or not all(latest.missing):
            return True
        return len(latest.missing) > 1 and self._bus.first_hides_others(LONGER_S)

    def _follow(self, state: State, stopped: Stopped) -> State:
        """Follow the path to the rest pose; return the last complete state.

        Raises SafetyStop, StopRequested, DriverError.
        """
        lowering, asked, self._whole = self._lowering, max(1, self._stop.count), state
        self._is_shared = self._bus.prepared.heard.strangers >= 1.0
        self._bus.bear_others()
        self._bus.prepared.accept_any_order()
        self._pace = Pace(self._interval, self._bus.prepared.patience, self._bus.prepared.quickest)
        self._sent_at, self._heard_at, self._goal = self._clock.now(), state.time_before_write, stopped.goal
        # The path begins with the latest state that is known, which may be a few exchanges old.
        old = self._clock.now() - state.time_before_write if stopped.is_blind else 0.0
        index = first = round(old / self._interval)
        self._steps = PositionSteps(state)
        count = lowering.begin(state, self._goal, self._guard.recent, self._watch, self._guard.current_noise)
        # The first goals are sent at once: until then, those that led to the stop drive the arm.
        begun = start = self._clock.now() - first * self._interval
        while index < count:
            if lowering.needs_another_path:
                index, first, start = 0, 0, self._clock.now()
                count = lowering.begin_again(state, self._goal)
                lowering.check_time(start - begun + count * self._interval)
            self._deadline = start + index * self._interval
            if index > first:
                self._look_for_another_master(self._deadline)
            self._clock.wait_until(self._deadline)
            now = self._clock.now()
            self._stop.check_again(asked)
            if index > first and now - self._deadline >= self._interval:
                self._recorder.keep(self._deadline, Phase.LOWERING, stopped.segment, -1, missed(self._goal, now))
                lowering.late(now - self._sent_at)
                index += 1
                continue
            self._goal = lowering.goals(index, state)
            former, state = state.time_before_write, self._exchange(between=False)
            self._recorder.keep(self._deadline, Phase.LOWERING, stopped.segment, -1, state)
            self._look_at_alerts(state)
            lowering.look(index, state, state.time_before_write - former)
            for checked in self._between_samples(state) if index + 1 < count else ():
                lowering.look(index, checked, checked.time_before_write - state.time_before_write, between=True)
                state = checked
            index += self._pace.every
        return self._whole

    def _exchange(self, *, between: bool) -> State:
        """Exchange the latest goals with the servos, and adapt the pace to the duration of the exchange."""
        pace, former = self._pace, self._pace.every
        now = self._clock.now()
        heard = self._bus.prepared.heard
        # Another master's replies look like late ones, and its packets destroy those to this program.
        are_late = now - heard.late_at < _RECENT_S and not self._is_shared
        are_damaged = now - heard.damaged_at < _RECENT_S or self._is_shared
        awaited = pace.patience(now - self._heard_at, are_late=are_late, are_damaged=are_damaged)
        longer = awaited - self._bus.prepared.patience
        if longer != 0.0:
            self._bus.prepared.wait_longer(longer)
        state = self._steps.corrected(self._bus.exchange(self._goal, between=between))
        self._sent_at = state.time_before_write
        took, is_missed = state.time_after_read - state.time_before_write, any(state.missing)
        self._takes = max(self._takes, took)
        if not is_missed:
            self._whole, self._heard_at = state, state.time_before_write
        pace.took(took, missed=is_missed)
        self._look_behind_silence(state)
        if pace.every != former:
            self._lowering.slow_down(pace.every)
        return state

    def _look_behind_silence(self, state: State) -> None:
        """When no servo is heard any more, check once whether a single silent servo hides all others."""
        is_silent = all(state.missing) and len(state.missing) > 1
        if is_silent and not self._was_silent and self._bus.first_hides_others(LONGER_S):
            self._lowering.others_answer()
        self._was_silent = is_silent

    def _between_samples(self, state: State) -> Iterator[State]:
        """Repeat the exchange with the same goals until the next sample is due; yield each state.

        Missing replies are asked for again at once. An exchange that might delay the next sample is skipped.
        """
        following, turns = self._deadline + self._interval, self._turns if self._pace.every == 1 else 1
        for turn in range(1, turns + 1):
            due = following if turn == turns else self._deadline + turn * self._apart
            while any(state.missing) and self._clock.now() + self._bus.prepared.patience < due:
                state = self._exchange(between=True)
                yield state
            if turn == turns:
                return
            self._look_for_another_master(due)
            self._clock.wait_until(due)
            now = self._clock.now()
            if now - due < self._apart and now + self._takes < following:
                state = self._exchange(between=True)
                yield state

    def _look_at_alerts(self, state: State) -> None:
        """Raise SafetyStop if a servo has raised its alert since the last exchange and any servo has lost torque."""
        alerts = [bool(error & ALERT) for error in state.error]
        new = [joint for joint, now, before in zip(self._bus.joints, alerts, self._alerts, strict=True) if now > before]
        if not new:
            return
        self._alerts = [now or before for now, before in zip(alerts, self._alerts, strict=True)]
        if not self._bus.has_torque():
            raise SafetyStop(f"{new[0].title} raised its alert, and a servo has lost its torque.", Cause.ALERT)

    def _look_for_another_master(self, due: float) -> None:
        """If a read-back is due, perform it just before the exchange due at `due` [s]."""
        if self._bus.prepared.read_back_at <= due:
            read_back(self._bus, self._guard, due)

    def _told(self, error: ExperimentError | BusOverheard, what: str) -> None:
        error.add_note(what)
        self._note(what)
