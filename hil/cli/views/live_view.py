"""The live display of a running experiment: each joint between its limits, timing, temperature and voltage."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Group
from rich.table import Table
from rich.text import Text

from hil.config.schema import Config
from hil.experiment.stream import Progress

_NEAR = 0.85  # fraction of a limit above which a value is shown in yellow
_WIDEST, _NARROWEST = 22, 8  # largest and smallest width of a gauge, in columns
_TOLD_IN_FULL = 60  # minimum number of columns for showing the timing in full
_VALUE, _LIMITS, _HEALTH = 7, 12, 14  # widths [columns]: a value, a gauge's two limits, temperature and voltage


@dataclass(frozen=True)
class Layout:
    """The parts of the display that fit the terminal. gauge: width of a gauge in columns. gauges: 2 if position and
    goal have a gauge, 1 if only the position has one, or 0.
    """

    gauge: int
    gauges: int
    limits: bool
    health: bool


def layout_for(columns: int, name: int) -> Layout:
    """Return the most detailed layout that fits `columns` without wrapping. name: length of the longest joint name."""
    for gauges, limits, health in ((2, True, True), (2, True, False), (2, False, False), (1, False, False)):
        # A value, a gauge and a unit for position and goal, each followed by a space.
        fixed = name + 1 + 2 * (_VALUE + 1) + gauges * (1 + _LIMITS * limits) + len("rad") + 1 + len("A")
        gauge = (columns - fixed - (1 + _HEALTH) * health) // gauges
        if gauge >= _NARROWEST:
            return Layout(min(gauge, _WIDEST), gauges, limits, health)
    return Layout(0, 0, False, False)


class LiveView:
    """Draws progress reports. If a sample lacks a position, temperature or voltage, the latest known value is shown.

    The timing statistics are reset at the start of each run of a pilot.
    """

    def __init__(self, config: Config, columns: int) -> None:
        self._joints = config.joints
        self._rate = config.experiment.rate
        self._layout = layout_for(columns, max(len(joint.name) for joint in config.joints))
        self._is_narrow = columns < _TOLD_IN_FULL
        self._taken = 0
        self._earliest, self._latest = math.inf, 0.0
        self._position = [math.nan] * len(config.joints)
        self._goal = [math.nan] * len(config.joints)
        self._heat = [math.nan] * len(config.joints)
        self._supply = [math.nan] * len(config.joints)

    def draw(self, progress: Progress) -> Group:
        self._keep(progress)
        table = Table.grid(padding=(0, 1), pad_edge=False)
        for index, joint in enumerate(self._joints):
            low, high = joint.position_limit
            cells = [Text(joint.name), *self._gauge(self._position[index], low, high, 1), Text("rad")]
            cells += self._gauge(self._goal[index], -joint.goal_limit, joint.goal_limit, 2)
            cells.append(Text(joint.drive_mode.goal_unit))
            if self._layout.health:
                cells.append(Text(self._health(index)))
            table.add_row(*cells)
        for column in table.columns:
            column.no_wrap = True
        return Group(table, Text(self._timing(progress), style="dim"))

    def _keep(self, progress: Progress) -> None:
        state = progress.state
        if progress.taken < self._taken:
            self._earliest, self._latest = math.inf, 0.0
        self._taken = progress.taken
        # Deadlines are evenly spaced, so the earliest write relative to its deadline serves as the reference.
        phase = state.time_before_write - progress.taken / self._rate
        self._earliest = min(self._earliest, phase)
        self._latest = max(self._latest, phase - self._earliest)
        _keep_finite(self._position, state.position)
        _keep_finite(self._goal, state.current)
        if state.slow is not None:
            _keep_finite(self._heat, state.slow.temperature)
            _keep_finite(self._supply, state.slow.voltage)

    def _timing(self, progress: Progress) -> str:
        trip = 1e3 * (progress.state.time_after_read - progress.state.time_before_write)
        lost = sum(progress.state.missing)
        silent = f", {lost} servo{'s' if lost > 1 else ''} silent" if lost else ""
        late = f"{1e6 * self._latest:.0f} µs"
        if self._is_narrow:
            return f"round trip {trip:.2f} ms, jitter {late}{silent}"
        return f"round trip {trip:.2f} ms, write jitter at most {late}{silent}"

    def _health(self, index: int) -> str:
        heat, supply = self._heat[index], self._supply[index]
        return f"{heat:.0f} °C {supply:.1f} V" if math.isfinite(heat) and math.isfinite(supply) else ""

    def _gauge(self, value: float, low: float, high: float, place: int) -> list[Text]:
        """Return the value and a gauge that shows it between its limits and turns yellow near either of them."""
        width, outside = self._layout.gauge, not low <= value <= high
        shown = Text(f"{value:+{_VALUE}.2f}" if math.isfinite(value) else " " * _VALUE, style="red" if outside else "")
        if place > self._layout.gauges:
            return [shown]
        if outside:
            return [shown, Text("─" * width, style="red")]
        share = (value - low) / (high - low)
        style = "yellow" if abs(2 * share - 1) > _NEAR else "green"
        at = round(share * (width - 1))
        line = Text("─" * at, style="dim") + Text("●", style=style) + Text("─" * (width - 1 - at), style="dim")
        return [shown, Text(f"{low:+.1f} ") + line + Text(f" {high:+.1f}") if self._layout.limits else line]


def _keep_finite(kept: list[float], seen: Sequence[float]) -> None:
    """Overwrite the stored values with the new ones, except where a servo did not answer."""
    for index, value in enumerate(seen):
        kept[index] = float(value) if math.isfinite(value) else kept[index]
