"""The experiment in time: at each tick one exchange, the guard looks, the recorder keeps.

Played in order: rest; for each multisine a ramp in, periods until two successive ones are alike, the periods that will
be used, a ramp out; then no current until the arm is at rest.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drivers.bus import ServoBus
from drivers.errors import ServoFault
from drivers.rate import FixedRate
from drivers.state import State
from hil.config import Config
from hil.errors import ExperimentError, NotSettled, SafetyStop
from hil.guard import Guard
from hil.plan import Plan, Segment
from hil.recording import Phase, Recorder, missed
from hil.settled import settling_difference
from hil.stop import StopRequest

_WATCH_EVERY_S = 0.05


class Progress(NamedTuple):
    """What a person watches: samples taken, of how many expected, the phase, and the latest state."""

    taken: int
    expected: int
    phase: Phase
    role: str
    state: State


Watch = Callable[[Progress], None]
Note = Callable[[str], None]


class Stream:
    """Plays a plan on a bus whose torque is on. `run` returns when the arm is at rest again.

    watch: called about 20 times a second with the progress. note: called with each event worth keeping.
    """

    def __init__(
        self, bus: ServoBus, plan: Plan, config: Config, recorder: Recorder, stop: StopRequest, watch: Watch, note: Note
    ) -> None:
        self._bus = bus
        self._clock = bus.port.clock
        self._plan = plan
        self._safety = config.safety
        self._guard = Guard(config)
        self._recorder = recorder
        self._stop = stop
        self._watch = watch
        self._note = note
        self._interval = 1 / plan.rate
        self._ticks = FixedRate(bus.port.clock, plan.rate)
        self._index = 0
        self._watch_every = max(1, round(_WATCH_EVERY_S * plan.rate))
        self._goal = [0.0] * len(bus.joints)
        self._segment = 0

    def run(self) -> None:
        """Play the whole plan; raises ExperimentError, SafetyStop, StopRequested, PortLost."""
        self._rest()
        for number, segment in enumerate(self._plan.segments):
            self._segment = number
            self._note(f"{segment.role}: ramp in")
            self._play(segment.ramp_in, Phase.RAMP_IN)
            self._play_periods(segment)
            self._note(f"{segment.role}: ramp out")
            self._play(segment.ramp_out, Phase.RAMP_OUT)
        self._come_to_rest()

    def _rest(self) -> None:
        self._note("rest")
        state = self._play(self._silence(self._plan.rest_samples), Phase.REST)
        moving = self._moving(state)
        if moving:
            raise ExperimentError(f"The arm moves before the start: {moving}. Let it hang still, then start again.")

    def _play_periods(self, segment: Segment) -> None:
        """Periods until one is like the one before it, which then is the first settled one; then the rest of them."""
        samples = len(segment.period_current)
        former = self._play_period(segment, 0)
        for period in range(1, self._plan.max_settling_periods + 1):
            latest = self._play_period(segment, period)
            difference = settling_difference(former, latest)
            if difference <= self._plan.settle_within:
                self._note(f"{segment.role}: period {period} is settled, {difference:.2%} from the one before")
                for further in range(1, self._plan.periods):
                    self._play_period(segment, period + further)
                return
            former = latest
        raise NotSettled(
            f"After {self._plan.max_settling_periods} periods of {samples * self._interval:g} s the motion still "
            f"changes by {difference:.1%} of its RMS from one period to the next; experiment.settle_within allows "
            f"{self._plan.settle_within:.1%}. Look for play, a dragging cable or a slipping joint; or raise "
            "max_settling_periods."
        )

    def _play_period(self, segment: Segment, period: int) -> NDArray[np.float64]:
        """Play one period; its positions, (joints, samples) [rad], NaN where missing."""
        first = self._recorder.count
        self._play(segment.period_current, Phase.PERIODIC, period)
        return np.array(self._recorder.samples["position"][first:].T)

    def _come_to_rest(self) -> None:
        self._note("coming to rest")
        window = max(1, round(0.2 * self._plan.rate))
        for _ in range(0, self._plan.end_samples, window):
            self._play(self._silence(window), Phase.COMING_TO_REST)
            slowest = np.abs(self._recorder.samples["velocity"][-window:]).max()
            if slowest < self._safety.rest_velocity:
                self._note("at rest")
                return
        self._note(f"still moving at {slowest:.2f} rad/s after {self._safety.rest_time:g} s without current")

    def _play(self, goals: NDArray[np.float64], phase: Phase, period: int = -1) -> State:
        """Send goal currents, (samples, joints) [A], one row a tick; the last state."""
        state = missed(self._goal, self._clock.now())
        for goal in goals.tolist():
            state = self._sample(goal, phase, period)
        return state

    def _sample(self, goal: list[float], phase: Phase, period: int) -> State:
        deadline, now, late = self._ticks.wait()
        if late:
            # Skipped, never caught up in a burst: the servos keep the former goal.
            state = missed(self._goal, now)
        else:
            self._goal = self._guard.clamp(goal)
            state = self._bus.exchange(self._goal)
        self._recorder.keep(deadline, phase, self._segment, period, state)
        self._index += 1
        if not late:
            self._look(state)
        self._stop.check()
        if self._index % self._watch_every == 0:
            role = self._plan.segments[self._segment].role
            self._watch(Progress(self._index, self._plan.expected, phase, role, state))
        return state

    def _look(self, state: State) -> None:
        if any(state.error):
            try:
                self._bus.check_alerts(state)
            except ServoFault as fault:
                raise SafetyStop(str(fault)) from fault
        self._guard.look(state)

    def _silence(self, samples: int) -> NDArray[np.float64]:
        return np.zeros((samples, len(self._bus.joints)))

    def _moving(self, state: State) -> str:
        limit = self._safety.rest_velocity
        return ", ".join(
            f"{joint} at {velocity:.2f} rad/s"
            for joint, velocity in zip(self._bus.joints, state.velocity, strict=True)
            if abs(velocity) > limit
        )
