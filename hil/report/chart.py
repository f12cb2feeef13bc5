"""Figures as data, independent of the renderer (hil.report.svg, hil.report.png)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array

# Okabe and Ito's colours, distinguishable for colour-blind readers.
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8a8f98"
OF_JOINTS = (BLUE, ORANGE, GREEN, "#CC79A7", "#56B4E9", "#E69F00", GREY)

Kind = Literal["line", "broad", "dashed", "points", "dots", "area", "steps"]


@dataclass(frozen=True)
class Series:
    """One curve.

    x, y: coordinates (n,), with a gap at each NaN. kind: with `area`, the area between y and `low` is filled; with
    `steps`, x holds the n + 1 edges.
    """

    name: str
    x: Array
    y: Array
    colour: str
    kind: Kind = "line"
    low: Array | None = None


@dataclass(frozen=True)
class Chart:
    """A chart with one x and one y axis. name: file name without extension."""

    name: str
    title: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    log_y: bool = False


@dataclass(frozen=True)
class Matrix:
    """A square matrix of values from -1 to 1, with the same labels on both axes. NaN cells are left blank."""

    name: str
    title: str
    labels: tuple[str, ...]
    values: Array


Figure = Chart | Matrix


def thin(x: Array, y: Array, most: int) -> tuple[Array, Array]:
    """Reduce a curve to about `most` points: the lowest and highest of each group of successive points, in order."""
    if len(x) <= most:
        return x, y
    count = len(x) // (most // 2)
    runs = len(x) // count
    rows = y[: runs * count].reshape(runs, count)
    filled = np.where(np.isfinite(rows), rows, np.nanmean(y))
    ends = np.sort(np.stack((filled.argmin(axis=1), filled.argmax(axis=1)), axis=1), axis=1)
    index = np.unique((ends + count * np.arange(runs)[:, None]).reshape(-1))
    index = np.unique(np.concatenate((index, [len(x) - 1])))
    return x[index], y[index]
