"""Looks at every sample and stops the arm when a limit is passed or an answer makes no sense.

Two joints cost 1 to 4 us a sample: plain floats, one pass over the joints, everything known beforehand worked out once.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, NoReturn

from hil.config.schema import Config
from hil.drivers.packet import ALERT
from hil.drivers.state import Slow, State
from hil.errors import Cause, SafetyStop

JUMP_FACTOR = 1.5
"""How much farther than its velocity limit allows a joint may seem to move in one sample."""

JUMP_ALLOWANCE_RAD = 0.01
"""Rounding and a worn encoder's scatter."""

EARLY_MOTION_RAD = 0.05
"""How far a joint may creep in the rest before the start."""

WORK_TOLERANCE_RAD = 0.03
"""Work that a joint may seem to give out before its sign is called wrong: this angle at its largest torque."""


class _Limits(NamedTuple):
    """One joint's limits, in the order of use."""

    low: float
    high: float
    velocity: float
    farthest: float
    current: float
    unfollowed: float
    work_scale: float
    work_least: float


class Guard:
    """Compares each sample with the limits of the configuration. `look` raises SafetyStop.

    passive: whether the arm can give out no more work than was put in; True for an arm that starts from a stable rest
    without stabiliser. Then motors that take work out of it all the time turn the wrong way.
    """

    def __init__(self, config: Config) -> None:
        rate = config.experiment.rate
        safety = config.safety
        self._names = [str(joint.joint) for joint in config.joints]
        self._limits = [
            _Limits(
                joint.position_limit[0],
                joint.position_limit[1],
                joint.velocity_limit,
                JUMP_FACTOR * joint.velocity_limit / rate,
                joint.goal_limit,
                # A sensor in the supply says little of the motor's current.
                math.inf if joint.joint.servo.senses_supply else safety.follow_share * joint.goal_limit,
                joint.torque_per_goal / rate,
                -WORK_TOLERANCE_RAD * joint.goal_limit * joint.torque_per_goal,
            )
            for joint in config.joints
        ]
        count = len(config.joints)
        self._safety = safety
        self._slew = safety.slew / rate
        self._follow_samples = max(2, round(safety.follow_time * rate))
        self._passive = config.stabiliser is None
        self._rate = rate
        self._former_goal = [0.0] * count
        self._position: list[float | None] = [None] * count
        self._unseen = [0] * count
        self._missing = [0] * count
        self._unfollowed = [0] * count
        self._work = [0.0] * count
        self._late = 0
        self._resting: tuple[float, ...] | None = None

    def clamp(self, goal_current: Sequence[float]) -> list[float]:
        """Goals within each joint's current limit and slew [A]; NaN becomes a SafetyStop, never a command."""
        slew = self._slew
        clamped = []
        for index, (goal, former, limits) in enumerate(zip(goal_current, self._former_goal, self._limits, strict=True)):
            if not abs(goal) < float("inf"):
                self._stop(index, Cause.NOT_A_NUMBER, f"was to be given a goal current of {goal}, which is no number.")
            limit = limits.current
            wanted = limit if goal > limit else -limit if goal < -limit else goal
            change = wanted - former
            clamped.append(former + slew if change > slew else former - slew if change < -slew else wanted)
        self._former_goal = clamped
        return clamped

    def late(self) -> None:
        """A deadline passed unused. Raises SafetyStop after too many in a row, and before the watchdogs act."""
        self._late += 1
        silence = self._late / self._rate
        if self._late > self._safety.max_late or silence >= 0.8 * self._safety.watchdog:
            raise SafetyStop(
                f"{self._late} deadlines in a row were missed, {1e3 * silence:.0f} ms without a command; "
                f"safety.max_late allows {self._safety.max_late}. Close other programs, or lower experiment.rate.",
                Cause.LATE,
            )

    def look(self, state: State, watchdog_gap: float = 0.0) -> None:
        """Raise SafetyStop when a limit is passed or an answer makes no sense.

        watchdog_gap: s since the exchange before this one.
        """
        if watchdog_gap >= self._safety.watchdog:
            raise SafetyStop(
                f"{1e3 * watchdog_gap:.0f} ms passed between two commands; the servos' watchdogs act after "
                f"{1e3 * self._safety.watchdog:.0f} ms and then refuse goals. Close other programs on this computer.",
                Cause.LATE,
            )
        self._late = 0
        former_goal = state.goal_current
        for index, limits in enumerate(self._limits):
            if state.missing[index]:
                self._count_missing(index, state.error[index])
                continue
            low, high, fastest, farthest, _, unfollowed, work_scale, work_least = limits
            position = state.position[index]
            velocity = state.velocity[index]
            if state.error[index] & ALERT:
                self._stop(index, Cause.ALERT, "raised its alert: read Hardware Error Status, find the cause, reboot.")
            former = self._position[index]
            if former is not None:
                moved = position - former
                if not -farthest - JUMP_ALLOWANCE_RAD <= moved <= farthest + JUMP_ALLOWANCE_RAD:
                    self._jumped(index, moved)
            if not low <= position <= high:
                self._outside(index, position)
            if not -fastest <= velocity <= fastest:
                self._too_fast(index, velocity)
            self._position[index] = position
            self._missing[index] = self._unseen[index] = 0
            goal = former_goal[index]
            current = state.current[index]
            if -unfollowed <= current - goal <= unfollowed:
                self._unfollowed[index] = 0
            else:
                self._count_unfollowed(index, goal, current)
            work = self._work[index] = self._work[index] + work_scale * goal * velocity
            if work < work_least and self._passive:
                self._judge_work(index)
        if state.slow is not None:
            self._look_slow(state.slow)

    def look_at_rest(self, state: State) -> None:
        """Raise SafetyStop when a joint moves although nothing has been commanded yet."""
        if self._resting is None:
            if not any(state.missing):
                self._resting = state.position
            return
        for index, (first, now) in enumerate(zip(self._resting, state.position, strict=True)):
            if abs(now - first) > EARLY_MOTION_RAD:
                self._stop(
                    index,
                    Cause.EARLY_MOTION,
                    f"moves before the start: {now - first:+.3f} rad without any current, {EARLY_MOTION_RAD} is "
                    "allowed. Let the arm hang still; look for a draught, a pulling cable, a hand.",
                )

    def _count_missing(self, index: int, error: int) -> None:
        if error & ALERT:
            self._stop(index, Cause.ALERT, "raised its alert: read Hardware Error Status, find the cause, reboot.")
        self._missing[index] += 1
        self._unseen[index] += 1
        allowed = self._safety.max_missing
        if self._missing[index] > allowed:
            self._stop(
                index,
                Cause.MISSING,
                f"missed {self._missing[index]} replies in a row; safety.max_missing allows {allowed}. Check its cable "
                "and its supply.",
            )

    def _jumped(self, index: int, moved: float) -> None:
        """Farther than one sample allows; after lost replies there were more of them."""
        most = (1 + self._unseen[index]) * self._limits[index].farthest + JUMP_ALLOWANCE_RAD
        if not abs(moved) <= most:
            self._stop(
                index,
                Cause.JUMP,
                f"seems to have moved {moved:+.3f} rad between two samples, at most {most:.3f} is possible within its "
                "velocity limit. Look at the encoder, its magnet and the supply.",
            )

    def _outside(self, index: int, position: float) -> NoReturn:
        low, high = self._limits[index][:2]
        self._stop(
            index,
            Cause.POSITION,
            f"is at {position:.3f} rad, outside its position limit [{low:g}, {high:g}]. Lower experiment.peak_torque; "
            "`hil dry-run` finds how far.",
        )

    def _too_fast(self, index: int, velocity: float) -> NoReturn:
        self._stop(
            index,
            Cause.VELOCITY,
            f"moves at {velocity:.2f} rad/s, more than its velocity limit {self._limits[index].velocity:g}. Lower "
            "experiment.peak_torque; `hil dry-run` finds how far.",
        )

    def _count_unfollowed(self, index: int, goal: float, current: float) -> None:
        self._unfollowed[index] += 1
        if self._unfollowed[index] >= self._follow_samples:
            self._stop(
                index,
                Cause.NOT_FOLLOWING,
                f"carries {current:.3f} where {goal:.3f} is commanded, for {self._unfollowed[index]} samples. Its "
                "torque is off, it was rebooted, its watchdog acted, or it cannot give this much at its speed and "
                "supply (safety.follow_share).",
            )

    def _judge_work(self, index: int) -> None:
        """Friction takes energy: a joint whose motor has only ever taken energy out turns against its command."""
        others = sum(work for other, work in enumerate(self._work) if other != index and work > 0)
        if self._work[index] < self._limits[index].work_least - 0.5 * others:
            self._stop(
                index,
                Cause.WRONG_SIGN,
                f"moves against its command: its motor has taken {-self._work[index]:.2f} J out of the arm, which "
                "friction forbids. Is the gear reversed, or does something drive the arm?",
            )

    def _look_slow(self, slow: Slow) -> None:
        safety = self._safety
        for index, (celsius, volt) in enumerate(zip(slow.temperature, slow.voltage, strict=True)):
            if celsius > safety.max_temperature:
                self._stop(
                    index,
                    Cause.TEMPERATURE,
                    f"is at {celsius:.0f} degrees C, safety.max_temperature is {safety.max_temperature:g}. Let it "
                    "cool.",
                )
            if volt < safety.min_voltage or volt > safety.max_voltage:
                self._stop(
                    index,
                    Cause.VOLTAGE,
                    f"has {volt:.1f} V; safety.min_voltage and max_voltage allow {safety.min_voltage:g} to "
                    f"{safety.max_voltage:g}. Look at the supply.",
                )

    def _stop(self, index: int, cause: Cause, what: str) -> NoReturn:
        name = self._names[index]
        raise SafetyStop(f"{name[0].upper()}{name[1:]} {what}", cause)
