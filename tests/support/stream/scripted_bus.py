"""A scripted bus on a virtual clock, and checks that only note what they are given."""

import math
from types import SimpleNamespace
from typing import Any

from hil.config.schema import Config
from hil.drivers.state import Slow, State
from hil.fakes.bus.clock import VirtualClock

JOINTS = 2
NOTHING = (0.0,) * JOINTS
TAKES_S = 1e-3
Call = tuple[Any, ...]
HELD = -0.3
"""Position of the joints [rad]."""


class Bus:
    """Answers every exchange after `takes` [s], the last of which is used again; notes every call."""

    def __init__(self, config: Config, turns: int, takes: list[float]) -> None:
        self.joints = config.bus.joints
        self.port = self.prepared = self
        self.clock = VirtualClock()
        self.exchanges_per_sample = turns
        self.patience = 0.02
        self.quickest = math.inf
        self.read_back_at = math.inf
        self.awaited_until = -math.inf
        self.heard_instead = self.commanded_by_another = ""
        self.is_watched = True
        self.modes_seen_ago = math.inf
        self.goals_lost: tuple[int, str] | None = None
        self.watchdog_changed: tuple[int, int] | None = None
        self.torque_lost: int | None = None
        self.takes = takes
        self.unanswered: list[int] = []
        """Numbers of the exchanges to which the second servo does not reply, counted from the first."""
        self.silent: list[int] = []
        """Numbers of the exchanges to which no servo replies."""
        self.exchanges = 0
        self.calls: list[Call] = []
        self.velocity = NOTHING
        self.moves_every = 1
        """Number of exchanges of which the last one shows a velocity."""
        self.wobble = 0.0
        """Difference of two successive positions [rad]."""
        self.keeps_torque = True
        self.first_hides = False
        self.heard = SimpleNamespace(late_at=-math.inf, damaged_at=-math.inf, strangers=0.0)
        self.error = (0,) * JOINTS
        self.slow: Slow | None = None
        self.status: Any = None

    def wait_longer(self, seconds: float) -> None:
        self.patience += seconds

    def bear_others(self) -> None:
        self.calls.append(("others",))

    def accept_any_order(self) -> None:
        self.calls.append(("any order",))

    def has_torque(self) -> bool:
        self.calls.append(("torque",))
        return self.keeps_torque

    def first_hides_others(self, _patience: float) -> bool:
        return self.first_hides

    def exchange(self, goals: list[float], *, between: bool = False) -> State:
        now = self.clock.now()
        self.calls.append(("between" if between else "sample", round(now, 6), *goals))
        self.clock.wait_until(now + (self.takes.pop(0) if len(self.takes) > 1 else self.takes[0]))
        is_silent = self.exchanges in self.silent
        missing = (is_silent, is_silent or self.exchanges in self.unanswered)
        self.exchanges += 1
        position = tuple(math.nan if each else HELD + self.wobble * (len(self.calls) % 2) for each in missing)
        after, sent = self.clock.now(), tuple(goals)
        velocity = NOTHING if len(self.calls) % self.moves_every else self.velocity
        return State(now, after, sent, sent, velocity, position, self.error, missing, self.slow, self.status)

    def read_torque(self) -> int | None:
        return self.torque_lost

    def check_not_overruled(self, due: float) -> None:
        self.calls.append(("read back", round(due, 6)))

    def read_status_next(self) -> None:
        self.calls.append(("status",))

    def rearm_watchdogs(self) -> None:
        self.calls.append(("rearmed",))

    def shorten_watchdogs(self, seconds: float) -> None:
        self.calls.append(("watchdogs", seconds))

    def times(self, kind: str) -> list[float]:
        return [call[1] for call in self.calls if call[0] == kind]


class Checks:
    """In place of the guard and the model: notes what they are given."""

    recent = current_noise = None

    def __init__(self, *_: Any, **__: Any) -> None:
        self.calls: list[Call] = []
        self.wants_status = False

    def clamp(self, wanted: list[float]) -> list[float]:
        return list(wanted)

    def look_at_supply(self, *_: Any) -> None:
        pass

    def woke_up(self, now: float, late: float) -> None:
        self.calls.append(("woke up", round(now, 6), round(late, 6)))

    def late(self, seconds: float) -> None:
        self.calls.append(("late", round(seconds, 6)))

    def look(self, _state: State, gap: float = 0.0, *, between: bool = False) -> None:
        self.calls.append(("look", round(gap, 6), between))

    def goals_are_lost(self, joint: int, held: str) -> None:
        self.calls.append(("lost", joint, held))

    def watchdog_reads(self, joint: int, ticks: int) -> None:
        self.calls.append(("watchdog", joint, ticks))

    def look_at_rest(self, _state: State) -> None:
        self.calls.append(("at rest",))

    def look_while_held(self, _state: State) -> None:
        self.calls.append(("while held",))

    def measure_noise(self, _state: State) -> None:
        self.calls.append(("noise",))

    def noise_is_known(self) -> list[str]:
        self.calls.append(("known",))
        return ["noisy"]

    def of(self, kind: str) -> list[Call]:
        return [call[1:] for call in self.calls if call[0] == kind]
