"""Text and tables on standard output that lose nothing in a narrow terminal."""

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table


class ResultConsole(Console):
    """Standard output, without rich's own colours and its own idea of a closed pipe (`hil.cli.output` has another)."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def result_console() -> Console:
    """A console for results."""
    return ResultConsole(highlight=False)


def say(console: Console, text: str) -> None:
    """Print a sentence: a terminal gets it wrapped between words, a file or a pipe in one line."""
    console.print(text, soft_wrap=not console.is_terminal, markup=False)


def natural_width(console: Console, table: Table) -> int:
    """Columns that the table needs for all its figures."""
    wide = Console(file=console.file, width=10_000)
    return Measurement.get(wide, wide.options, table).maximum


def print_table(console: Console, table: Table) -> None:
    """Print a table without cutting a figure: where the terminal is too narrow, the terminal wraps its lines."""
    width = max(console.width, natural_width(console, table))
    ResultConsole(file=console.file, highlight=False, width=width).print(table)
