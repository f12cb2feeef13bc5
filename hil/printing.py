"""Print text and tables on standard output, without truncating them in a narrow terminal."""

from collections.abc import Iterator

from rich.console import Console
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

_INDENT = 2


class ResultConsole(Console):
    """Standard output without rich's own handling of a closed pipe (see `hil.cli.output`)."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


def result_console() -> Console:
    return ResultConsole(highlight=False)


def say(console: Console, text: str) -> None:
    """Print a sentence: wrapped between words on a terminal, on one line in a file or a pipe."""
    console.print(text, soft_wrap=not console.is_terminal, markup=False)


def say_behind(console: Console, label: str, text: str, style: str = "") -> None:
    """Print a sentence after a label; on a terminal, continuation lines are aligned with the start of the sentence."""
    line = Text(label, style=style) + Text(text)
    if not console.is_terminal or line.cell_len <= console.width or len(label) > console.width // 3:
        console.print(line, soft_wrap=not console.is_terminal)
        return
    grid = Table.grid()
    grid.add_column(width=len(label))
    grid.add_row(Text(label, style=style), Text(text, overflow="fold"))
    console.print(grid)


def natural_width(console: Console, table: Table) -> int:
    """Width required to show all values of the table in full."""
    wide = Console(file=console.file, width=10_000)
    return Measurement.get(wide, wide.options, table).maximum


def print_table(console: Console, table: Table) -> None:
    """Print a table without truncating values: a terminal that is too narrow wraps its lines."""
    width = max(console.width, natural_width(console, table))
    ResultConsole(file=console.file, highlight=False, width=width).print(table)


def print_fitting(console: Console, table: Table) -> None:
    """Print a table; if the terminal is too narrow, print each row as a paragraph that names its columns."""
    if not console.is_terminal or natural_width(console, table) <= console.width:
        print_table(console, table)
        return
    if table.title:
        console.print(table.title)
    former = None
    for title, cells in _paragraphs(table):
        if title != former:
            console.print(title)
            former = title
        console.print(Padding(", ".join(cells), (0, 0, 0, _INDENT)))


def _paragraphs(table: Table) -> Iterator[tuple[str, list[str]]]:
    """For each row, yield the first cell (if empty, that of the row above) and the other cells with their headings."""
    headings = [str(column.header) for column in table.columns]
    title = ""
    for row in zip(*(column.cells for column in table.columns), strict=True):
        first, *others = map(str, row)
        if not any((first, *others)):  # an empty row only separates two parts of a table
            continue
        title = f"{headings[0]} {first}".strip() if first else title
        yield title, [f"{heading} {cell}".strip() for heading, cell in zip(headings[1:], others, strict=True) if cell]
