"""Output in narrow terminals: every word and figure is there, and no word is broken."""

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from rich.table import Table

from hil.cli.terminal import rows_below
from hil.printing import print_fitting, say, say_behind

HEADINGS = ("joint", "predicted peak", "unit", "median", "limit")
ROWS = [
    ("shoulder", "lowest position", "rad", "-2.43", "-4.2"),
    ("", "velocity", "rad/s", "5.05", "15"),
    ("elbow", "lowest position", "rad", "-1.06", "-3.1"),
]
WORDS = st.text(st.characters(codec="ascii", categories=("L", "N")), min_size=1, max_size=12)


def shown(width: int, draw: object, *, terminal: bool = True) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=terminal, color_system=None, highlight=False)
    draw(console)  # type: ignore[operator]
    return console.file.getvalue()  # type: ignore[attr-defined]


def table() -> Table:
    made = Table(title="Dry run")
    for heading in HEADINGS:
        made.add_column(heading)
    for row in ROWS:
        made.add_row(*row)
    return made


@pytest.mark.parametrize("width", [30, 40, 60, 80, 200])
def test_a_table_cuts_nothing(width: int) -> None:
    text = shown(width, lambda console: print_fitting(console, table()))
    assert "…" not in text and max(map(len, text.splitlines())) <= width
    words = text.split()
    assert all(word in words or f"{word}," in words for row in ROWS for cell in row for word in cell.split())


def test_a_narrow_terminal_gets_a_paragraph_for_each_row() -> None:
    assert shown(30, lambda console: print_fitting(console, table())).splitlines() == [
        "Dry run",
        "joint shoulder",
        "  predicted peak lowest       ",
        "  position, unit rad, median  ",
        "  -2.43, limit -4.2           ",
        "  predicted peak velocity,    ",
        "  unit rad/s, median 5.05,    ",
        "  limit 15                    ",
        "joint elbow",
        "  predicted peak lowest       ",
        "  position, unit rad, median  ",
        "  -1.06, limit -3.1           ",
    ]


def test_a_file_gets_the_table_whatever_its_width() -> None:
    text = shown(30, lambda console: print_fitting(console, table()), terminal=False)
    assert "shoulder" in text and len(text.splitlines()) < 12


@given(words=st.lists(WORDS, min_size=1, max_size=30), width=st.integers(45, 120))
def test_no_word_is_broken(words: list[str], width: int) -> None:
    text = " ".join(words)
    assert shown(width, lambda console: say(console, text)).split() == words
    behind = shown(width, lambda console: say_behind(console, "warning  ", text))
    assert behind.split() == ["warning", *words]
    assert max(map(len, behind.splitlines())) <= width
    assert all(line.startswith(" " * 9) for line in behind.splitlines()[1:])


PEAKS = (
    "Pilot, peak torque 0.308, 0.162 N m:\n"
    "                           predicted      99 % within    measured\n"
    "  lowest position [rad]    -1.93, -0.27   -2.46, -0.89   -1.95, -0.33\n"
    "  velocity [rad/s]         2.55, 1.38     5.70, 4.28     2.85, 1.89"
)


def test_a_table_of_peaks_becomes_lines_of_their_own_where_it_does_not_fit() -> None:
    assert rows_below(PEAKS, 80) == PEAKS
    narrow = rows_below(PEAKS, 40)
    assert max(map(len, narrow.splitlines())) <= 40
    assert "  lowest position [rad]\n    predicted -1.93, -0.27\n    99 % within -2.46, -0.89\n    measured" in narrow
    sentence = "The estimate is still too uncertain to go straight to the limits: adding an intermediate run."
    assert rows_below(sentence, 40) == sentence
