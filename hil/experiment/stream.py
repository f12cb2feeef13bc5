"""The real-time loop: one exchange, one guard check and one recorded sample per tick.

If ticks are far apart, the exchange is repeated in between with the same goals, without being recorded. Every check
thus sees an exchange at least every `hil.drivers.bus.CHECK_S`, whatever the rate of the experiment.

The sequence is: rest; for each multisine a ramp in, the warm-up (only before the first), periods until two successive
ones match, the remaining periods to be recorded, and a ramp out; then no current until the arm is at rest. If the cause
of a stop allows it, the arm is braked before `run` raises; the caller, which switched torque on, then switches it off.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusOverheard, DriverError
from hil.drivers.rate import FixedRate
from hil.drivers.state import State
from hil.dry_run.ensemble import Ensemble
from hil.errors import Cause, DidNotMove, ExperimentError, NotSettled, SafetyStop, symptom_of
from hil.estimator.arrays import Array
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.estimator.data.periodicity import WARMEST, correlation_of_changes, decay_of
from hil.experiment.chain_watch import ChainWatch
from hil.experiment.checks.apart import opposed, without_torque
from hil.experiment.guard import Guard
from hil.experiment.model_watch import ModelWatch
from hil.experiment.pace import Pace
from hil.experiment.repetition import Repetition
from hil.experiment.stop_request import StopRequest
from hil.experiment.stopping.way_down import Stopped, WayDown
from hil.plan.brake import Brake, may_brake
from hil.plan.plan import Plan, Segment, rest_window
from hil.plan.stabiliser import Stabiliser, must_balance
from hil.runs.recording import Phase, Recorder, missed
from hil.setup.session.servo_session import has_moved

_WATCH_EVERY_S = 0.05
_LEAST_MOTION_STEPS = 4
_STILL_STEPS, _FALSE_STEPS = 1, 4
"""The first value is the largest change in the reading of a joint at rest, in encoder steps: the joint may rest between
two steps. Reported velocities count as false only if they add up to more than the second value, also in steps.
"""

_BY_OTHER_GOALS = {
    *(Cause.NOT_FOLLOWING, Cause.WRONG_SIGN, Cause.OUT_OF_VOLTAGE, Cause.GOALS_CHANGED, Cause.UNEXPECTED),
    *(Cause.UNLIKE_BEFORE, Cause.POSITION, Cause.VELOCITY),
}
"""A stop for one of these reasons may be due to goals sent by another program."""

_BY_LOST_TORQUE = {
    *(Cause.NOT_FOLLOWING, Cause.FROZEN, Cause.WRONG_SIGN, Cause.OUT_OF_VOLTAGE, Cause.UNEXPECTED),
    *(Cause.UNLIKE_BEFORE, Cause.POSITION, Cause.VELOCITY),
}
"""A stop for one of these reasons may be due to a servo without torque. Torque Enable is then read before torque is
cut.
"""

_BRAKING_WATCHDOG_S = 0.04
"""Timeout of the Bus Watchdog while the arm is braked [s]. It is shorter than during the experiment, which must allow
for late commands: if the cable is unplugged during braking, the current must not continue for long.
"""


class Progress(NamedTuple):
    """What the user is shown: number of samples taken and expected, phase, role of the multisine, latest state, and
    peak torque of the run (joints,) [N m].
    """

    taken: int
    expected: int
    phase: Phase
    role: str
    state: State
    peak_torque: tuple[float, ...] = ()


Watch = Callable[[Progress], None]
Note = Callable[[str], None]


class Stream:
    """Plays a plan on servos whose torque is on. `run` returns when the arm is at rest again.

    watch: called with the progress about 20 times a second. note: called with each event to be logged. Neither may
    block. arms: prior knowledge of the arm; by default, from the configuration. Create the stream before torque is on:
    it precomputes as much as possible.
    """

    def __init__(
        self,
        bus: ServoBus,
        plan: Plan,
        config: Config,
        recorder: Recorder,
        stop: StopRequest,
        watch: Watch,
        note: Note,
        arms: Ensemble | ChainArms | None = None,
    ) -> None:
        self._bus = bus
        self._plan = plan
        self._config = config
        planned = _largest_goals(plan)
        self._left_by_a_run = has_moved()
        apart = 1 / plan.rate / bus.exchanges_per_sample
        self._guard = Guard(
            config,
            planned,
            interval=apart,
            patience=bus.prepared.patience,
            heard_instead=lambda: bus.heard_instead,
            left_by_a_run=self._left_by_a_run,
        )
        self._model: ModelWatch | ChainWatch = (
            ModelWatch(config, planned, arms, apart, self._guard.look_at_supply)
            if not isinstance(arms, ChainArms) and not config.is_chain
            else ChainWatch(
                *(config, planned, arms if isinstance(arms, ChainArms) else None, apart, self._guard.look_at_supply),
                has_moved=self._left_by_a_run,
            )
        )
        self._way_down: WayDown | None = None
        if config.is_chain:
            model = self._model if isinstance(self._model, ChainWatch) else None
            self._way_down = WayDown(bus, plan, config, recorder, stop, note, self._guard, model)
        self._stabiliser = None if config.stabiliser is None else Stabiliser(config)
        self._recorder = recorder
        self._stop = stop
        self._watch = watch
        self._note = note
        self._pace = Pace(bus, plan.rate, self._guard)
        self._peak_torque = tuple(
            peak * joint.torque_per_goal for peak, joint in zip(planned, config.joints, strict=True)
        )
        self._watch_every = max(1, round(_WATCH_EVERY_S * plan.rate))
        self._goal = [0.0] * len(bus.joints)
        self._segment = 0
        self._state: State | None = None
        self._whole: State | None = None
        """The latest state with replies from all servos."""
        self._sampled: State | None = None
        self._is_undriven = True
        """Whether the arm has not been driven yet; a stabiliser cannot drive it before the first sample."""
        self._ramps = [(segment.ramp_in, segment.ramp_out) for segment in plan.segments]
        longest = max(len(segment.period_current) for segment in plan.segments)
        self._repetition = Repetition(longest, len(bus.joints), self._pace.interval)

        self.modes_seen_ago = float("inf")
        """Time from the latest correct read-back of the operating modes until the guard stopped the stream [s]."""

    def begins_at(self, positions: Sequence[float]) -> None:
        """Store the joints' last angles before torque is switched on [rad]; the first sample must agree with them."""
        self._guard.rests_at(positions)

    @property
    def state(self) -> State | None:
        """The latest state read, even if it was read between two samples."""
        return self._state

    def run(self) -> None:
        """Play the whole plan. Raises ExperimentError, SafetyStop, StopRequested, PortLost."""
        try:
            self._play_all()
            if (dead := self._bus.read_torque()) is not None:
                self._guard.torque_is_off(dead)
        except (ExperimentError, BusOverheard) as error:
            self.modes_seen_ago = self._bus.modes_seen_ago
            if isinstance(error, SafetyStop) and error.cause in _BY_OTHER_GOALS and self._bus.commanded_by_another:
                error.add_note(self._bus.commanded_by_another)
                error.overruled = True
            if self._way_down is not None:
                stopped = Stopped(self._state, self._whole, self._goal, self._pace.sent_at, self._segment)
                self._way_down.lower(error, stopped)
            elif may_brake(self._config, error):
                self._brake()
            self._name_lost_torque(error)
            raise

    def _name_lost_torque(self, error: ExperimentError | BusOverheard) -> None:
        """If `error` is due to a servo that has lost its torque, raise a SafetyStop that says so."""
        is_explained = isinstance(error, DidNotMove | NotSettled)
        if not is_explained and not (isinstance(error, SafetyStop) and error.cause in _BY_LOST_TORQUE):
            return
        with suppress(DriverError):
            if (dead := self._bus.read_torque()) is None:
                return
            try:
                self._guard.torque_is_off(dead)
            except SafetyStop as lost:
                lost.args = (f"{lost} Symptom: {symptom_of(error)}.",)
                lost.overruled = True
                for note in getattr(error, "__notes__", ()):
                    lost.add_note(note)
                raise lost from error

    def _play_all(self) -> None:
        self._rest()
        for number, segment in enumerate(self._plan.segments):
            self._segment = number
            self._note(f"{segment.role}: ramp in")
            self._play(self._ramps[number][0], Phase.RAMP_IN)
            if number == 0:
                self._warm_up(segment)
            self._play_periods(segment)
            self._note(f"{segment.role}: ramp out")
            self._play(self._ramps[number][1], Phase.RAMP_OUT)
        self._come_to_rest()
        if self._stabiliser is not None and must_balance(self._config):
            self._balance(self._stabiliser)

    def _rest(self) -> None:
        self._note("rest")
        state = self._play(self._silence(self._plan.rest_samples), Phase.REST)
        moving = self._moving(state)
        window = rest_window(self._plan.rate)
        # The stabiliser may first have to bring the arm back from where the previous run was stopped.
        for _ in range(0, self._plan.end_samples if self._left_by_a_run else 0, window):
            if not moving:
                break
            moving = self._moving(self._play(self._silence(window), Phase.REST))
        if moving:
            self._check_velocity(state, window)
            raise ExperimentError(
                f"The arm is moving before the start: {moving}. Wait until it is at rest, then start again. If it "
                "moved by itself, another program is commanding it, or something is pushing or holding it."
            )
        for noisy in self._guard.noise_is_known():
            self._note(noisy)

    def _check_velocity(self, state: State, window: int) -> None:
        """Raise SafetyStop, with a cause that rules out braking, if a joint reports a velocity although its position
        has not changed in the last `window` samples.

        The last sample alone does not prove this: at a low rate, a joint may have begun to move right before it.
        Therefore the sample before it must report a velocity too, or earlier samples must report velocities that would
        add up to several encoder steps.
        """
        moved = np.ptp(self._recorder.samples["position"][-window:], axis=0)
        speed = np.abs(self._recorder.samples["velocity"][-window:])
        fast = speed > self._config.safety.rest_velocity
        earlier = self._pace.interval * np.where(fast, speed, 0.0)[:-2].sum(axis=0)
        for index, (joint, velocity, way) in enumerate(zip(self._bus.joints, state.velocity, moved, strict=True)):
            step = abs(joint.position_unit)
            is_false = fast[-2:, index].all() or (fast[-1, index] and earlier[index] > _FALSE_STEPS * step)
            if is_false and way <= _STILL_STEPS * step:
                raise SafetyStop(
                    f"{joint.title} reports a velocity of {velocity:.2f} rad/s before the start, but its position has "
                    f"changed by {way:.4f} rad in the last {window * self._pace.interval:.1f} s: one of the two "
                    "readings is wrong. Check the encoder and its magnet; replace the servo if necessary.",
                    Cause.FROZEN,
                )

    def _warm_up(self, segment: Segment) -> None:
        """Play periods that are recorded but not used."""
        for number in range(self._plan.warm_up_periods):
            self._note(f"{segment.role}: warm-up, period {number + 1} of {self._plan.warm_up_periods}")
            self._play(segment.period_current, Phase.WARM_UP)

    def _play_periods(self, segment: Segment) -> None:
        """Play periods until one matches its predecessor, i.e. the motion has settled; then play the remaining periods
        to be recorded.
        """
        samples = len(segment.period_current)
        repetition = self._repetition
        self._play_period(segment, 0)
        self._check_motion(repetition.moved)
        differences = []
        for period in range(1, self._plan.max_settling_periods + 1):
            self._play_period(segment, period)
            self._check_motion(repetition.moved)
            difference = repetition.difference
            differences.append(difference)
            if difference <= self._plan.settle_within:
                self._note(f"{segment.role}: settled; period {period} differs from the one before by {difference:.2%}")
                for further in range(1, self._plan.periods):
                    self._play_period(segment, period + further)
                    self._check_motion(repetition.moved)
                return
        if difference <= self._plan.drift_within:
            self._note(f"{segment.role}: still drifting slowly ({difference:.2%} per period); using the last periods")
            return
        raise NotSettled(
            f"After {self._plan.max_settling_periods} periods of {samples * self._pace.interval:g} s the motion is "
            f"still drifting: {difference:.1%} of its RMS from one period to the next; experiment.settle_within allows "
            f"{self._plan.settle_within:.1%} ({self._plan.drift_within:.1%} if it drifts slowly). "
            + self._advice(differences, samples)
        )

    def _advice(self, differences: Sequence[float], samples: int) -> str:
        """Return advice for motion that has not settled.

        differences: each period's difference from the one before. samples: number of samples per period.
        """
        decay = decay_of(differences, self._plan.settle_within)
        if decay is None:
            return "Check for backlash, a dragging cable or a slipping joint, or raise max_settling_periods."
        listed = ", ".join(f"{each:.1%}" for each in differences)
        played = len(differences) + decay.further
        drifts = decay.is_drift(self._correlation(samples))
        if drifts and differences[-1] <= WARMEST:
            seconds = (self._plan.warm_up_periods + played) * samples * self._pace.interval
            return (
                f"The change decreases slowly from period to period ({listed}), as happens while grease warms up: set "
                f"experiment.warm_up = {math.ceil(seconds / 10) * 10:g}."
            )
        if drifts:
            return (
                f"{self._bus.joints[self._repetition.worst].title} changes most ({listed}): friction may hold it "
                "during part of each period, or its torque may have changed. Raise its peak_torque, or check its "
                "supply, cable and coupling."
            )
        return (
            f"The change decreases from period to period ({listed}), by a factor of {decay.ratio:.2g} each time: the "
            "transient at the start has not died out yet. More periods are needed: set "
            f"experiment.max_settling_periods = {played}."
        )

    def _correlation(self, samples: int) -> float:
        """Correlation of the latest period's change with the previous change; each period has `samples` samples."""
        latest = self._recorder.samples["position"][-3 * samples :]
        return correlation_of_changes(latest.reshape(3, samples, len(self._bus.joints)).transpose(0, 2, 1))

    def _check_motion(self, moved: Sequence[float]) -> None:
        """Detect, after a period, a joint held by friction or an obstacle, before more time is wasted."""
        for index, (joint, way) in enumerate(zip(self._bus.joints, moved, strict=True)):
            if way <= _LEAST_MOTION_STEPS * abs(joint.position_unit):
                against = f" Or {opposed(joint)}" if joint.seconds else ""
                error = DidNotMove(
                    f"{joint.title} moved by only {way:.4f} rad in a whole period: it is stuck, friction holds it, or "
                    f"{without_torque(joint)}.{against} Move it by hand with torque off; if it is free, check its "
                    f"wiring and its gear, or {self._more_torque()}."
                )
                error.joint = index
                raise error

    def _more_torque(self) -> str:
        if self._config.is_chain:
            return "raise experiment.rate, so that a stiffer stabiliser can move it, or widen position_limit"
        if self._config.experiment.pilot:  # the pilot chooses the torque
            return "widen position_limit or raise the lower limit of experiment.band, so that more torque is safe"
        return "raise experiment.peak_torque"

    def _play_period(self, segment: Segment, period: int) -> None:
        """Play one period and compare each sample with that of the previous period."""
        repetition = self._repetition
        repetition.begin(len(segment.period_current), anew=period == 0)
        for index, row in enumerate(segment.period_current):
            state = self._sample(row.tolist(), Phase.PERIODIC, period)
            repetition.add(index, state.position)
            if (joint := repetition.unlike) is not None:
                self._guard.does_not_repeat(joint, state.position[joint])

    def _come_to_rest(self) -> None:
        self._note("coming to rest")
        window = rest_window(self._plan.rate)
        for _ in range(0, self._plan.end_samples, window):
            self._play(self._silence(window), Phase.COMING_TO_REST)
            velocity: Array = self._recorder.samples["velocity"]
            speeds = np.abs(velocity[-window:])
            # Missing replies are ignored; a joint without any reply does not count as being at rest.
            fastest = np.fmax.reduce(speeds, axis=0)
            if (fastest < self._config.safety.rest_velocity).all():
                self._note("at rest")
                return
        told = ", ".join(f"{speed:.2f}" for speed in fastest)
        self._note(f"still moving at {told} rad/s after {self._config.safety.rest_time:g} s without current")

    def _balance(self, stabiliser: Stabiliser) -> None:
        """Bring an upright arm as close to balance as friction allows; otherwise it falls over when torque is cut."""
        window = rest_window(self._plan.rate)
        state = self._play(self._silence(window), Phase.COMING_TO_REST)
        stabiliser.balance()
        for _ in range(window, self._plan.end_samples, window):
            if stabiliser.is_balanced(self._config, state) and not self._moving(state):
                self._note("balanced")
                return
            state = self._play(self._silence(window), Phase.COMING_TO_REST)
        self._note("the arm is not balanced: without torque, friction may not hold it upright")

    def _play(self, goals: Array, phase: Phase, period: int = -1) -> State:
        """Send goal currents (samples, joints) [A], one row per tick; return the last state."""
        state = missed(self._goal, self._bus.port.clock.now())
        for row in goals:  # row by row: converting a long period at once would delay the loop
            state = self._sample(row.tolist(), phase, period)
        return state

    def _sample(self, goal: list[float], phase: Phase, period: int) -> State:
        pace = self._pace
        if pace.turns > 1:
            for state in pace.between(self._goal):
                self._look(state, phase, between=True)
                self._stop.check()
        deadline, now, late = pace.wait()
        if late:
            # A missed tick is skipped, never made up for in a burst: the servos keep the previous goal.
            state = missed(self._goal, now)
        else:
            wanted = goal if self._stabiliser is None else self._stabiliser.add(goal, self._sampled)
            self._goal = self._guard.clamp(wanted)
            self._sampled = state = pace.send(self._goal)
        self._recorder.keep(deadline, phase, self._segment, period, state)
        if late:
            self._guard.late(now - (deadline if pace.sent_at is None else pace.sent_at))
        else:
            self._look(state, phase)
        self._stop.check()
        # Temperature and voltage come with only a few samples, which are always shown.
        taken = self._recorder.count
        if taken % self._watch_every == 0 or state.slow is not None:
            role = self._plan.segments[self._segment].role
            self._watch(Progress(taken, self._plan.expected, phase, role, state, self._peak_torque))
        return state

    def _look(self, state: State, phase: Phase, *, between: bool = False) -> None:
        former, self._state = self._state, state
        if True not in state.missing:
            self._whole = state
        gap = 0.0 if former is None else state.time_before_write - former.time_before_write
        self._guard.look(state, gap, between=between)
        if state.status is not None and self._guard.wants_status:
            self._bus.read_status_next()
        self._model.look(state)
        if phase is not Phase.REST:
            return
        self._guard.measure_noise(state)
        if self._is_undriven:
            self._guard.look_at_rest(state)
            self._is_undriven = self._stabiliser is None or any(state.missing)
        else:
            self._guard.look_while_held(state)

    def _brake(self) -> None:
        """Brake until the arm is slow, a read fails, time is up, or a second signal arrives. Never raises."""
        apart, clock = self._pace.interval / self._pace.turns, self._bus.port.clock
        brake = Brake(self._config, apart, self._guard.recent)
        state = self._state
        ticks = FixedRate(clock, 1 / apart)
        with suppress(DriverError):
            for number in range(round(self._config.safety.damp_time / apart)):
                goals = None if state is None else brake.goals(state)
                if goals is None:
                    return
                # The first braking goals are sent at once: until then, the goals that led to the stop drive the arm.
                deadline, _, late = ticks.wait() if number else (clock.now(), 0.0, False)
                if late or self._stop.insisted:
                    return
                state = self._bus.exchange(goals, between=True)
                if number == 0:
                    self._bus.shorten_watchdogs(_BRAKING_WATCHDOG_S)
                self._recorder.keep(deadline, Phase.BRAKING, self._segment, -1, state)

    def _silence(self, samples: int) -> Array:
        return np.zeros((samples, len(self._bus.joints)))

    def _moving(self, state: State) -> str:
        limit = self._config.safety.rest_velocity
        return ", ".join(
            f"{joint} at {velocity:.2f} rad/s"
            for joint, velocity in zip(self._bus.joints, state.velocity, strict=True)
            if abs(velocity) > limit
        )


def _largest_goals(plan: Plan) -> list[float]:
    """Largest goal of each joint [A, or V in PWM mode]; NaN counts as 0 here, since the guard rejects it."""
    return [float(peak) for peak in np.max([segment.peak_goal for segment in plan.segments], axis=0)]
