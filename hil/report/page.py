"""The report page: all sections, rendered by one template into a single self-contained file."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup, escape

from hil import __version__
from hil.report.chart import Chart, Figure
from hil.report.run_data import RunData
from hil.report.section import Section
from hil.report.sections.clearance import clearance
from hil.report.sections.correlation import correlation
from hil.report.sections.friction import friction
from hil.report.sections.limits import limits
from hil.report.sections.motion import motion, next_commands
from hil.report.sections.parameters import parameters
from hil.report.sections.prediction import prediction
from hil.report.sections.provenance import provenance
from hil.report.sections.spectra import spectra
from hil.report.sections.stabiliser import stabiliser
from hil.report.sections.steps import steps
from hil.report.sections.timing import timing
from hil.report.sections.verdict import verdict
from hil.report.svg import NARROW, WIDE, draw_svg
from hil.whole_file import write_whole

FILE_NAME = "report.html"
MOST_POINTS = 70_000
"""Largest total number of points in all curves of a page, counted in the wide versions of the figures. The page of a
planar arm has half as many.
"""
FEWEST_POINTS = 600
_CODE = re.compile("`([^`]+)`")
SCRIPTS = ("page.js", "spatial.js")
SECTIONS: tuple[Callable[[RunData], Section | None], ...] = (
    verdict,
    parameters,
    motion,
    prediction,
    friction,
    spectra,
    correlation,
    limits,
    clearance,
    stabiliser,
    steps,
    timing,
    next_commands,
    provenance,
)


def write_report(data: RunData, path: Path) -> None:
    """Write the report of a run; raises RunFolderError when it cannot be written."""
    write_whole(path, make_page(data))


def make_page(data: RunData) -> str:
    return render(Path(data.record.config).stem, data.record.started, sections(data))


def render(title: str, started: str, shown: Sequence[Section], kind: str = "Identified arm") -> str:
    """The HTML document of these sections. started: ISO 8601. kind: what the page shows."""
    folder = files("hil.report")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["prose"] = _prose
    template = environment.from_string(folder.joinpath("page.html.j2").read_text(encoding="utf-8"))
    return template.render(
        title=title,
        kind=kind,
        started=datetime.fromisoformat(started).strftime("%Y-%m-%d %H:%M"),
        version=__version__,
        sections=shown,
        style=Markup(folder.joinpath("page.css").read_text(encoding="utf-8")),
        script=Markup("".join(folder.joinpath(name).read_text(encoding="utf-8") for name in SCRIPTS)),
        draw=partial(_draw, share=_share_of_points(shown)),
    )


def _prose(text: str) -> Markup:
    """Convert text for the terminal to HTML: text in backticks becomes code, "+-" a plus-minus sign."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text)).replace("+-", "±")))


def sections(data: RunData) -> list[Section]:
    """The sections for which the run has data."""
    return [section for make in SECTIONS if (section := make(data)) is not None]


def figures_in(shown: Sequence[Section]) -> list[Figure]:
    """All figures of these sections, in order."""
    return [picture.figure for section in shown for picture in section.pictures]


def _share_of_points(shown: Sequence[Section]) -> float:
    """Fraction of its points that each curve keeps. It is reduced so that a page with many joints stays small."""
    charts = [figure for figure in figures_in(shown) if isinstance(figure, Chart)]
    wanted = sum(min(len(series.x), WIDE.points) for chart in charts for series in chart.series)
    return min(1.0, MOST_POINTS / max(1, wanted))


def _draw(figure: Figure, share: float) -> Markup:
    sizes = (replace(size, points=max(FEWEST_POINTS, int(share * size.points))) for size in (WIDE, NARROW))
    return Markup("".join(draw_svg(figure, size) for size in sizes))
