"""States of an arm at rest, and motion before a state: a brake trusts a velocity only as far as earlier positions
confirm it.
"""

from hil.config.schema import Config
from hil.drivers.state import State
from hil.plan.brake import Brake
from hil.plan.recent_motion import LONG_S, RecentMotion

STILL = State(0.0, 0.001, (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (-1.57, 0.0), (0, 0), (False, False))


def at(number: int, state: State) -> State:
    """The state, in the exchange of this number at 400 Hz."""
    return state._replace(time_before_write=number / 400, time_after_read=number / 400 + 0.001)


def seen_moving(config: Config, state: State, interval: float | None = None) -> RecentMotion:
    """The exchanges before `state`, during which the joints moved at its velocities."""
    interval = 1.0 / config.experiment.rate if interval is None else interval
    recent = RecentMotion(config, interval)
    for number in range(int(LONG_S / interval) + 2, 0, -1):
        before = number * interval
        position = tuple(now - before * speed for now, speed in zip(state.position, state.velocity, strict=True))
        times = state.time_before_write - before, state.time_after_read - before
        recent.add(state._replace(position=position, time_before_write=times[0], time_after_read=times[1]))
    return recent


def brake_of(config: Config, state: State) -> Brake:
    """A brake of an arm that has moved at the velocities of `state`."""
    return Brake(config, recent=seen_moving(config, state))
