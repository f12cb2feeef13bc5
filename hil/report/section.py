"""What a section of the report consists of, whatever it is about."""

from dataclasses import dataclass, field

from hil.report.chart import Figure


@dataclass(frozen=True)
class Table:
    """Rows of text under column heads. Columns after the first `left` ones hold numbers, set to the right.

    aside: a column that a phone has no room for.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1
    caption: str = ""
    aside: int | None = None


@dataclass(frozen=True)
class Picture:
    """A figure and what to see in it."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Folded:
    """Long text that opens on a click."""

    title: str
    text: str


@dataclass(frozen=True)
class Section:
    """One section: words, then tables, then pictures, then what is folded away. `tone` colours the verdict's."""

    key: str
    title: str
    words: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    folded: tuple[Folded, ...] = ()
    bullets: tuple[str, ...] = field(default=())
    tone: str = ""
