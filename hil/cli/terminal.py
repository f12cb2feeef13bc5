"""Progress shown while the arm moves: a bar and each joint's position and current. Disabled by -q."""

import re
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.spinner import Spinner

from hil.api.progress import OnProgress
from hil.api.progress import Progress as Report
from hil.cli.verbosity import is_quiet
from hil.cli.views.live_view import LiveView
from hil.config.schema import Config, load_config
from hil.experiment.stream import Progress as StreamProgress
from hil.experiment.stream import Watch
from hil.runs.recording import Phase
from hil.setup.scan import Asking
from hil.setup.scan import Watch as ScanWatch

_PHASES = {
    Phase.REST: "resting",
    Phase.RAMP_IN: "ramping in",
    Phase.PERIODIC: "exciting",
    Phase.WARM_UP: "warming up",
    Phase.RAMP_OUT: "ramping out",
    Phase.COMING_TO_REST: "coming to rest",
    Phase.BRAKING: "braking",
}

_NARROW = 76
"""Minimum width of a terminal in which the bar is shown [columns]."""

_QUIET_S = 0.7
"""If the arm is at rest and no report has arrived for this time [s], the display says what is being computed."""

_CELLS = 3
"""A line counts as a table row if it has at least this many cells."""


class Terminal:
    """Messages on standard error; standard output is reserved for results."""

    def __init__(self, quiet: bool) -> None:
        self.console = Console(stderr=True, quiet=quiet or is_quiet(), highlight=False)

    def say(self, text: str) -> None:
        self.console.print(rows_below(text, self.console.width) if self.console.is_terminal else text, markup=False)

    @contextmanager
    def busy(self, text: str) -> Iterator[None]:
        """Show a spinner next to `text` while the block runs."""
        with self.console.status(f"{text} ..."):
            yield

    @contextmanager
    def following(self, config: Path | None) -> Iterator[OnProgress]:
        """Show the progress of a long call: a live view of the arm while it moves, otherwise a message or a spinner."""
        with ExitStack() as showing:
            watch: Watch | None = None
            showing.enter_context(self.busy("Preparing"))

            def follow(report: Report) -> None:
                nonlocal watch
                if report.stream is not None and config is not None:
                    if watch is None:
                        showing.close()
                        watch = showing.enter_context(self.streaming(load_config(config)))
                    watch(report.stream)
                elif report.stage == "experiment":
                    self.say(report.message)
                else:
                    showing.close()
                    watch = None
                    showing.enter_context(self.busy(report.message))

            yield follow

    @contextmanager
    def scanning(self) -> Iterator[ScanWatch]:
        """Show servos as they answer and, on a terminal, the current baud rate and the remaining time."""
        if self.console.quiet:
            yield lambda _: None
            return
        with self.console.status("Scanning ...") as status:

            def watch(asking: Asking) -> None:
                if asking.servo is not None:
                    servo_id, model = asking.servo
                    self.say(f"{'' if asking.baud is None else f'{asking.baud} baud, '}ID {servo_id}: {model}")
                at = "" if asking.baud is None else f" at {asking.baud} baud"
                status.update(f"Scanning{at}, about {asking.left_s:.0f} s left")

            yield watch

    @contextmanager
    def streaming(self, config: Config) -> Iterator[Watch]:
        """Show a live view of the stream. Yields the function to call with each progress report."""
        if not self.console.is_terminal or self.console.quiet:
            yield lambda _: None
            return
        bar = _bar(self.console)
        task = bar.add_task("", total=1.0)
        rate = config.experiment.rate
        view = LiveView(config, self.console.width)
        computing = Spinner("dots", "Processing the recording ...")
        shown: Group | Progress = bar
        told_at, is_over = 0.0, False

        def current() -> Group | Progress | Spinner:
            return computing if is_over and time.monotonic() - told_at > _QUIET_S else shown

        with Live(get_renderable=current, console=self.console, refresh_per_second=10):

            def watch(progress: StreamProgress) -> None:
                nonlocal shown, told_at, is_over
                total = max(progress.expected, progress.taken) / rate
                description = f"{progress.role.replace('_', ' ')}: {_PHASES[progress.phase]}"
                bar.update(task, completed=progress.taken / rate, total=total, description=description)
                shown = Group(bar, view.draw(progress))
                told_at, is_over = time.monotonic(), progress.phase is Phase.COMING_TO_REST

            yield watch


def _bar(console: Console) -> Progress:
    if console.width < _NARROW:
        return Progress(
            TextColumn("{task.description}"),
            TextColumn("{task.completed:.0f}/{task.total:.0f} s"),
            console=console,
        )
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=20),
        TextColumn("{task.completed:.0f} of about {task.total:.0f} s of experiment time,"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=console,
    )


def rows_below(text: str, width: int) -> str:
    """Return the text; if its table is wider than `width`, each row is split over several lines.

    A row's cells are separated by two or more spaces; the first row holds the headings.
    """
    lines = text.split("\n")
    rows = [re.split(r" {2,}", line.strip()) for line in lines]
    if max(map(len, lines)) <= width or max(map(len, rows)) < _CELLS:
        return text
    shown: list[str] = []
    headings: list[str] = []
    for line, cells in zip(lines, rows, strict=True):
        if len(cells) < _CELLS:
            shown.append(line)
        elif not headings:
            headings = cells
        else:
            shown.append(f"  {cells[0]}")
            shown += [f"    {heading} {cell}" for heading, cell in zip(headings, cells[1:], strict=False)]
    return "\n".join(shown)
