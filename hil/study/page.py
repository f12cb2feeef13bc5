"""A study as one self-contained HTML page: rates, messages, and quantiles with small histograms."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pyarrow as pa
from jinja2 import Environment, StrictUndefined

from hil import __version__
from hil.study.figures import QUANTILES, Figures, figures
from hil.study.fleet import UNLIKE, fleets
from hil.whole_file import write_whole

FILE_NAME = "study.html"
_BINS = 24
_MOST_ARMS = 200
"""Maximum number of arms listed in a fleet's table on the page; the dataset contains all of them."""
_MANY = 100
"""Minimum number of values for which a histogram leaves out the lowest 1 % and the highest 1 % of them."""


def write_page(table: pa.Table, title: str, path: Path) -> Figures:
    """Write the page and return the figures on it. Raises RunFolderError if it cannot be written."""
    found = figures(table)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.tests["single"] = lambda rates: len(rates) == 1
    template = environment.from_string((files("hil.study") / "page.html.j2").read_text(encoding="utf-8"))
    histograms = {spread.name: _histogram(table, spread.name) for spread in found.spreads}
    text = template.render(
        title=title,
        figures=found,
        fleets=fleets(table) if "recording" in table.column_names else [],
        unlike_from=UNLIKE,
        most_arms=_MOST_ARMS,
        histograms=histograms,
        quantiles=[f"{100 * share:g} %" for share in QUANTILES],
        version=__version__,
        bar=100 / _BINS,
    )
    write_whole(path, text)
    return found


def _histogram(table: pa.Table, name: str) -> list[float]:
    """Heights (0 to 1) of equally wide bins between the 1 % and the 99 % quantile."""
    values = np.array([float(each) for each in table.column(name).to_pylist() if each is not None])
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.01, 0.99] if values.size >= _MANY else [0.0, 1.0])
    if high <= low:
        return [1.0 if index == _BINS // 2 else 0.0 for index in range(_BINS)]
    counted, _ = np.histogram(values, _BINS, (low, high))
    return [float(each) for each in counted / max(1, counted.max())]
