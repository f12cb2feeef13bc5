"""The live display of a running experiment: each joint between its limits, timing, temperature and voltage."""

import math

from rich.console import Group
from rich.table import Table
from rich.text import Text

from hil.config.schema import Config
from hil.experiment.stream import Progress

_NARROW = 100  # terminal width below which short gauges are drawn
_NEAR = 0.85  # fraction of a limit above which a value is shown in yellow


class LiveView:
    """Draws progress reports; stores values that are not in every sample: earliest write, temperatures and voltages."""

    def __init__(self, config: Config, columns: int) -> None:
        self._joints = config.joints
        self._rate = config.experiment.rate
        self._gauge_width = 22 if columns >= _NARROW else 10
        self._earliest = math.inf
        self._latest = 0.0
        self._heat = [math.nan] * len(config.joints)
        self._supply = [math.nan] * len(config.joints)

    def draw(self, progress: Progress) -> Group:
        """Render the display for one progress report."""
        self._keep(progress)
        table = Table.grid(padding=(0, 1))
        state = progress.state
        for index, joint in enumerate(self._joints):
            low, high = joint.position_limit
            unit = joint.drive_mode.goal_unit
            table.add_row(
                Text(joint.name),
                *self._gauge(state.position[index], low, high),
                "rad",
                *self._gauge(state.current[index], -joint.goal_limit, joint.goal_limit),
                unit,
                self._health(index),
            )
        return Group(table, Text(self._timing(progress), style="dim"))

    def _keep(self, progress: Progress) -> None:
        state = progress.state
        # Deadlines are evenly spaced, so the earliest write relative to its deadline serves as the reference.
        phase = state.time_before_write - progress.taken / self._rate
        self._earliest = min(self._earliest, phase)
        self._latest = max(self._latest, phase - self._earliest)
        if state.slow is not None:
            for kept, seen in ((self._heat, state.slow.temperature), (self._supply, state.slow.voltage)):
                for index, value in enumerate(seen):
                    kept[index] = value if math.isfinite(value) else kept[index]

    def _timing(self, progress: Progress) -> str:
        trip = 1e3 * (progress.state.time_after_read - progress.state.time_before_write)
        lost = sum(progress.state.missing)
        silent = f", {lost} servos silent" if lost else ""
        return f"round trip {trip:.2f} ms, latest write {1e6 * self._latest:.0f} µs after the earliest{silent}"

    def _health(self, index: int) -> str:
        heat, supply = self._heat[index], self._supply[index]
        return f"{heat:.0f} °C {supply:.1f} V" if math.isfinite(heat) and math.isfinite(supply) else ""

    def _gauge(self, value: float, low: float, high: float) -> tuple[Text, Text]:
        """The value, and a gauge that shows its position between its limits; yellow near a limit."""
        if not low <= value <= high:
            return Text(f"{value:+7.2f}", style="red"), Text("─" * self._gauge_width, style="red")
        share = (value - low) / (high - low)
        style = "yellow" if abs(2 * share - 1) > _NEAR else "green"
        at = round(share * (self._gauge_width - 1))
        line = (
            Text("─" * at, style="dim") + Text("●", style=style) + Text("─" * (self._gauge_width - 1 - at), style="dim")
        )
        return Text(f"{value:+7.2f}"), Text(f"{low:+.1f} ") + line + Text(f" {high:+.1f}")
