"""One joint in the guard's compiled checks, only one of which is given something to find, and its readings."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from hil.config.joint import JointConfig
from hil.drivers.state import State
from hil.experiment.checks import following
from hil.experiment.checks.current_noise import CurrentNoise
from hil.experiment.checks.joint_checks import CONSISTENCY, FINE, FOLLOWING, FROZEN, JOINT, JointChecks

ANY = 1e9
"""A limit that is never reached."""


def _joint() -> np.ndarray:
    joint = np.zeros(1, JOINT)
    joint["low"], joint["high"], joint["fastest"], joint["farthest"] = -ANY, ANY, ANY, ANY
    return joint


def _state(now: float, position: float = 0.0, velocity: float = 0.0, goal: float = 0.0, current: float = 0.0) -> State:
    return State(now, now, (goal,), (current,), (velocity,), (position,), (0,), (False,))


class Consistency:
    """Compares one joint's position [rad] with its velocity [rad/s]."""

    def __init__(self) -> None:
        self._joint = _joint()
        self._checks = JointChecks(self._joint, ANY)
        self.memory = self._joint[0]["consistency"]

    def look(self, position: float, velocity: float, seconds: float, unsure: float = 0.0) -> bool:
        """Process a sample, `seconds` after the previous one; return whether it is inconsistent."""
        self._joint["seen_at"] = 0.0
        found = self._checks.look(_state(seconds, position, velocity), unsure)
        self._checks.interval = ANY
        assert found in (FINE, CONSISTENCY)
        return found == CONSISTENCY

    def lost(self) -> None:
        """Let the next sample follow a gap that is too long."""
        self._checks.interval = 0.0


class Following:
    """Compares one joint's current with its goals."""

    def __init__(self, config: JointConfig, planned: float, follow_share: float, follow_time: float) -> None:
        self._joint = _joint()
        self._joint["is_followed"] = True
        following.begin(
            self._joint[0]["following"], self._joint[0]["goals"], config, planned, follow_share, follow_time
        )
        self._checks = JointChecks(self._joint, ANY)

    def look(self, goal: float, carried: float, seconds: float) -> float | None:
        """Process a reply, `seconds` after the previous one; return the duration of a deviation [s] if too long."""
        self._joint["seen_at"] = 0.0
        self._checks.interval = seconds
        found = self._checks.look(_state(0.0, goal=goal, current=carried), 0.0)
        assert found in (FINE, FOLLOWING)
        return float(self._joint["found"][0]) if found == FOLLOWING else None

    def froze(self, goal: float, carried: float, seconds: float, position: float = 0.0) -> bool:
        """Process a reply, `seconds` after the previous one; return whether its readings are frozen."""
        self._joint["seen_at"] = 0.0
        self._checks.interval = seconds
        return self._checks.look(_state(0.0, position, goal=goal, current=carried), 0.0) == FROZEN

    @property
    def most_under_same(self) -> float:
        """Largest change of the goal under which all readings may stay the same [A or V]."""
        return float(self._joint["goals"]["most"][0])

    def rest(self, config: JointConfig, carried: Sequence[float], seconds: float, planned: float) -> bool:
        """Process replies at goal 0 with these currents and learn their noise; return whether all were accepted."""
        noise, (record,) = CurrentNoise([config]), self._joint
        record["following"]["allowed"] = ANY
        for current in carried:
            if self.look(0.0, current, seconds) is not None:
                return False
            if noise.add(_state(0.0, current=current)):
                self._allow(config, planned, noise.measured()[1][0])
        self._allow(config, planned, noise.measured()[1][0])
        return True

    def seen_above(self, interval: float) -> float:
        """Smallest goal at which lost torque is found in 0.1 s [A or V]. interval: time between two replies [s]."""
        return following.seen_above(self._joint[0]["following"], interval)

    def _allow(self, config: JointConfig, planned: float, noise: float) -> None:
        record = self._joint[0]
        following.allow_noise(
            record["following"], record["goals"], config, planned, float(record["following"]["share"]), noise
        )


STEP, TICK = math.tau / 4096, 0.229 * math.tau / 60
"""Resolution of position and velocity [rad, rad/s]."""


def quantised(value: float, step: float) -> float:
    return round(value / step) * step


def seen_after(
    rate: int, position: Callable[[float], float], velocity: Callable[[float], float], start: float = 0.0
) -> float:
    """Time of detection [s]; infinite if nothing is detected within six seconds."""
    look = Consistency()
    for index in range(6 * rate):
        now = start + index / rate
        if look.look(quantised(position(now), STEP), quantised(velocity(now), TICK), 1 / rate):
            return now
    return math.inf


def learnt_motion(now: float) -> tuple[float, float]:
    """Position and velocity of a swinging joint whose servo filters the velocity with a lag of 5 ms."""
    late = now - 0.005
    return (
        0.4 * math.sin(math.tau * now) + 0.2 * math.sin(5.3 * now),
        0.4 * math.tau * math.cos(math.tau * late) + 0.2 * 5.3 * math.cos(5.3 * late),
    )
