"""Figures as PNG, drawn by matplotlib from the same description as the SVG."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hil.drawing import new_figure
from hil.report.chart import Chart, Figure, Matrix, Series

_LABEL = 0.24  # in, height of a row of a matrix with a legible label


def save_png(figure: Figure, path: Path) -> None:
    """Save one figure. Raises MissingExtra if matplotlib is not installed, and OSError if writing fails."""
    draw_figures([figure], dpi=150).savefig(path)


def draw_figures(figures: Sequence[Figure], dpi: int = 90) -> Any:
    """Draw the figures one below the other in a matplotlib figure. Raises MissingExtra."""
    heights = [max(8.2, _LABEL * len(figure.labels)) if isinstance(figure, Matrix) else 3.6 for figure in figures]
    canvas = new_figure(max(8.8, *heights), sum(heights), dpi)
    rows = canvas.subplots(len(figures), 1, squeeze=False, height_ratios=heights)
    for axes, figure in zip(rows[:, 0], figures, strict=True):
        axes.set_title(figure.title, fontsize=11)
        if isinstance(figure, Chart):
            _draw_chart(axes, figure)
        else:
            _draw_matrix(axes, figure)
    return canvas


def _draw_chart(axes: Any, chart: Chart) -> None:
    for series in chart.series:
        _draw_series(axes, series)
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    axes.set_yscale("log" if chart.log_y else "linear")
    axes.grid(color="#e3e6ea")
    if any(series.name for series in chart.series):  # beside the axes, so that the legend hides no curve
        legend = axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for handle in legend.legend_handles:
            if hasattr(handle, "set_markersize"):
                handle.set_markersize(7)  # dots as small as in the plot would be invisible


def _draw_series(axes: Any, series: Series) -> None:
    name = series.name or None
    if series.kind == "steps":
        axes.stairs(series.y, series.x, fill=True, alpha=0.4, color=series.colour, label=name)
    elif series.low is not None:
        axes.fill_between(series.x, series.low, series.y, alpha=0.18, color=series.colour, label=name, linewidth=0)
    elif series.kind in ("points", "dots"):
        axes.plot(
            series.x, series.y, ".", markersize=4 if series.kind == "points" else 1.5, color=series.colour, label=name
        )
    elif series.kind == "broad":
        axes.plot(series.x, series.y, linewidth=4, alpha=0.35, color=series.colour, label=name)
    else:
        style = "--" if series.kind == "dashed" else "-"
        axes.plot(series.x, series.y, style, linewidth=1.1, color=series.colour, label=name)


def _draw_matrix(axes: Any, matrix: Matrix) -> None:
    places = np.arange(len(matrix.labels))
    image = axes.imshow(matrix.values, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.set_xticks(places, matrix.labels, rotation=90, fontsize=8)
    axes.set_yticks(places, matrix.labels, fontsize=8)
    axes.figure.colorbar(image, ax=axes, shrink=0.7)
