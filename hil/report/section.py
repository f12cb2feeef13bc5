"""The parts of a report section."""

from dataclasses import dataclass, field
from typing import Any

from hil.report.chart import Figure


@dataclass(frozen=True)
class Table:
    """Rows of text with column headings.

    left: number of left-aligned text columns; the others hold right-aligned numbers. aside: columns that are hidden on
    narrow screens.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    left: int = 1
    caption: str = ""
    aside: tuple[int, ...] = ()


@dataclass(frozen=True)
class Picture:
    """A figure and its caption."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Folded:
    """Long text that is shown only after a click."""

    title: str
    text: str


@dataclass(frozen=True)
class Motion:
    """An animated planar arm. interval: time between frames [s]. angles: each joint's angles, frame by frame [rad].

    lengths: link lengths in any unit. hangs: whether gravity acts in the arm's plane (downwards in the animation).
    caption: text below the animation.
    """

    interval: float
    angles: tuple[tuple[float, ...], ...]
    lengths: tuple[float, ...]
    hangs: bool
    caption: str


@dataclass(frozen=True)
class SpatialMotion:
    """An animated spatial arm that can be rotated. caption: what is shown. scene: data for the page's script (JSON
    types).
    """

    caption: str
    scene: dict[str, Any]


@dataclass(frozen=True)
class Section:
    """One section: text, tables, figures, then collapsed text. `tone` sets the colour of the verdict."""

    key: str
    title: str
    words: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    folded: tuple[Folded, ...] = ()
    bullets: tuple[str, ...] = field(default=())
    tone: str = ""
    motion: Motion | SpatialMotion | None = None
