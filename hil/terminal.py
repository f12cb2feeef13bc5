"""What a person sees while the arm moves: a progress bar with each joint's position and current. Quiet when asked."""

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hil.config import Config
from hil.recording import Phase
from hil.stream import Progress as StreamProgress
from hil.stream import Watch

_PHASES = {
    Phase.REST: "resting",
    Phase.RAMP_IN: "ramping in",
    Phase.PERIODIC: "exciting",
    Phase.RAMP_OUT: "ramping out",
    Phase.COMING_TO_REST: "coming to rest",
}
_BAR_WIDTH = 24


class Terminal:
    """Messages on standard error, so that standard output holds results only."""

    def __init__(self, quiet: bool) -> None:
        self.console = Console(stderr=True, quiet=quiet, highlight=False)

    def say(self, text: str) -> None:
        self.console.print(text, markup=False)

    @contextmanager
    def busy(self, text: str) -> Iterator[None]:
        """A spinner beside `text` while the block runs."""
        with self.console.status(f"{text} ..."):
            yield

    @contextmanager
    def streaming(self, config: Config) -> Iterator[Watch]:
        """A live view of the stream; gives the function to call with each progress."""
        if not self.console.is_terminal or self.console.quiet:
            yield lambda _: None
            return
        bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=40),
            TextColumn("{task.completed:.0f} of about {task.total:.0f} s of arm time"),
            TimeRemainingColumn(),
            console=self.console,
        )
        task = bar.add_task("", total=1.0)
        rate = config.experiment.rate

        with Live(bar, console=self.console, refresh_per_second=10) as live:

            def watch(progress: StreamProgress) -> None:
                total = max(progress.expected, progress.taken) / rate
                description = f"{progress.role.replace('_', ' ')}: {_PHASES[progress.phase]}"
                bar.update(task, completed=progress.taken / rate, total=total, description=description)
                live.update(_view(config, bar, progress))

            yield watch


def _view(config: Config, bar: Progress, progress: StreamProgress) -> Table:
    joints = Table.grid(padding=(0, 2))
    state = progress.state
    for index, joint in enumerate(config.joints):
        low, high = joint.position_limit
        joints.add_row(
            joint.name,
            f"{state.position[index]:+7.2f} rad",
            _gauge(state.position[index], low, high),
            f"{low:+.2f} .. {high:+.2f}",
            f"{state.current[index]:+7.3f} {joint.drive_mode.goal_unit}",
            _gauge(state.current[index], -joint.goal_limit, joint.goal_limit),
            f"limit {joint.goal_limit:g}",
        )
    view = Table.grid()
    view.add_row(bar)
    view.add_row(joints)
    return view


def _gauge(value: float, low: float, high: float) -> str:
    """A line with a mark where `value` stands between `low` and `high`."""
    if not low <= value <= high:
        return "·" * _BAR_WIDTH
    at = round((value - low) / (high - low) * (_BAR_WIDTH - 1))
    return "·" * at + "█" + "·" * (_BAR_WIDTH - 1 - at)
