"""Range of velocities that each joint's change of position allows: no brake may rely on a reported velocity alone.

A brake that trusted a false velocity would drive the joint. The brake therefore opposes the reported velocity only
once it is limited to the range that the change of position allows over two spans of time: a short one, which soon shows
a reversal, and a long one, in which a slow motion is visible despite the encoder's steps. Each range includes zero, but
excludes the direction opposite to a visible motion.
"""

from collections import deque
from copy import copy
from itertools import pairwise
from math import ceil, isnan
from typing import NamedTuple

from hil.config.schema import Config
from hil.drivers.servo_model import ServoModel
from hil.drivers.state import State

__all__ = ["RecentMotion", "Travel"]

SHORT_S, LONG_S = 0.004, 0.02
"""The two spans over which motion is evaluated [s]; each begins at the newest exchange that is at least that old."""

_OLDEST_S = 0.05
_LONGER = 1.5
"""Largest age of a position that is used: the longer of `_OLDEST_S` [s] and `_LONGER` times the time between two
exchanges.
"""

_STEPS = 2.0
"""Uncertainty of a change of position, in encoder steps."""

_MORE = 1.25
"""Factor applied to the mean velocity over a span, to allow for a velocity that increases within it."""

CONTRADICTS = 2.0
"""A velocity contradicts the position if it is beyond this multiple of the range that the position allows: at constant
acceleration from standstill, the final velocity is twice the mean.
"""

UNREACHABLE = 3.0
"""Lowest velocity that no servo can reach, relative to the servo's no-load speed at its highest published voltage."""


class Travel(NamedTuple):
    """Change of a joint's position [rad] in `seconds` [s], and the range of velocities that it allows [rad/s]."""

    moved: float
    seconds: float
    low: float
    high: float


class RecentMotion:
    """The latest exchanges. interval: time between two of them [s]; by default, the sample period."""

    def __init__(self, config: Config, interval: float | None = None) -> None:
        interval = 1.0 / config.experiment.rate if interval is None else interval
        self._oldest = max(_OLDEST_S, _LONGER * interval)
        self._states: deque[State] = deque(maxlen=ceil(LONG_S / interval) + 3)
        self._steps = [_STEPS * abs(joint.joint.position_unit) for joint in config.joints]
        self._fastest = [_fastest(joint.joint.servo) for joint in config.joints]

    def add(self, state: State) -> None:
        """Store an exchange, unless it is already stored as the latest one."""
        if not self._states or self._states[-1] is not state:
            self._states.append(state)

    def previous(self, joint: int) -> State | None:
        """Return the latest exchange that the joint answered, not counting the newest one; None if there is none."""
        earlier = (state for state in reversed(self._states) if state is not self._states[-1])
        return next((state for state in earlier if not isnan(state.position[joint])), None)

    def until(self, state: State) -> "RecentMotion":
        """Return the motion up to `state`, an earlier exchange."""
        then = copy(self)
        at = state.time_before_write
        then._states = deque((each for each in self._states if each.time_before_write <= at), self._states.maxlen)
        return then

    def believed(self, state: State) -> list[float]:
        """The reported velocities, confined to the range that the positions allow [rad/s]; 0 if no change of position
        is known.

        state: the latest exchange.
        """
        self.add(state)
        return [self._confined(joint, velocity) for joint, velocity in enumerate(state.velocity)]

    def speeds(self) -> list[float]:
        """Speed of each joint over the longer span, derived from its change of position [rad/s]; 0 if unknown."""
        found = []
        for joint, step in enumerate(self._steps):
            travels = self.travels(joint)
            found.append(max(0.0, abs(travels[-1].moved) - step) / travels[-1].seconds if travels else 0.0)
        return found

    def contradicts(self, joint: int, velocity: float) -> bool:
        """Whether a velocity is impossible for the joint: every known change of its position rules it out or, if no
        change is known, no servo of this model turns that fast.
        """
        travels = self.travels(joint)
        if not travels:
            return self.is_unreachable(joint, velocity)
        return all(not CONTRADICTS * each.low <= velocity <= CONTRADICTS * each.high for each in travels)

    def currents(self, joint: int) -> list[tuple[float, float]]:
        """Return the goals and currents of the latest exchanges that the joint answered; each current belongs to the
        goal of the previous exchange.
        """
        return [
            (before.goal_current[joint], state.current[joint])
            for before, state in pairwise(self._states)
            if not isnan(state.current[joint])
        ]

    def is_old(self, joint: int) -> bool:
        """Whether the joint's readings have stayed exactly the same for longer than the reported velocity allows."""
        last = self._states[-1] if self._states else None
        if last is None:
            return False
        same = last
        for state in reversed(self._states):
            if _readings(state, joint) != _readings(last, joint):
                break
            same = state
        seconds = last.time_before_write - same.time_before_write
        return abs(last.velocity[joint]) * seconds > self._steps[joint]

    def is_unreachable(self, joint: int, velocity: float) -> bool:
        """Whether this velocity [rad/s] is higher than any servo of the joint's model can reach."""
        return abs(velocity) > self._fastest[joint]

    def travels(self, joint: int) -> list[Travel]:
        """The changes of a joint's position over the short and the long span; empty if it has replied only once."""
        states = [state for state in self._states if not isnan(state.position[joint])]
        if len(states) < 2 or isnan(self._states[-1].position[joint]):
            return []
        last = states.pop()
        known = [state for state in states if 0.0 < last.time_before_write - state.time_before_write <= self._oldest]
        if not known:
            return []
        return [self._travel(joint, _since(known, last, span), last) for span in (SHORT_S, LONG_S)]

    def _travel(self, joint: int, first: State, last: State) -> Travel:
        moved, step = last.position[joint] - first.position[joint], self._steps[joint]
        seconds = last.time_before_write - first.time_before_write
        # A servo may measure at any time during its exchange.
        unsure = abs(_took(last) - _took(first))
        least = max(seconds - unsure, 0.5 * seconds)
        low, high = min(0.0, moved - step), max(0.0, moved + step)
        return Travel(moved, seconds, _MORE * low / least, _MORE * high / least)

    def _confined(self, joint: int, velocity: float) -> float:
        if isnan(velocity):
            return velocity
        travels = self.travels(joint)
        low = max((each.low for each in travels), default=0.0)
        high = min((each.high for each in travels), default=0.0)
        return min(max(velocity, low), high)


def _since(known: list[State], last: State, span: float) -> State:
    """The newest state that is at least `span` [s] older than `last`; if there is none, the oldest known one."""
    now = last.time_before_write
    return next((state for state in reversed(known) if now - state.time_before_write >= span), known[0])


def _readings(state: State, joint: int) -> tuple[float, float, float]:
    return state.current[joint], state.velocity[joint], state.position[joint]


def _took(state: State) -> float:
    return state.time_after_read - state.time_before_write


def _fastest(model: ServoModel) -> float:
    voltage = max(stall.voltage for stall in model.stalls)
    return UNREACHABLE * model.no_load.speed * voltage / model.no_load.voltage
