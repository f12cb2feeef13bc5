"""Charts as SVG, in two widths: one for large screens and paper, and one for phones. `data-` attributes describe the
axes.
"""

from dataclasses import dataclass
from html import escape

import numpy as np

from hil.estimator.arrays import Array
from hil.report.chart import Chart, Figure, Series, thin
from hil.report.matrix_svg import draw_matrix
from hil.report.scale import Scale, label, span

FONT = "system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif"
_INK, _GRID = "#30343b", "#e3e6ea"
_ROW = 18.0  # px: height of a row of the legend


@dataclass(frozen=True)
class Size:
    """Size of a figure [px]. points: maximum number of points drawn per curve."""

    name: str
    width: float
    height: float
    points: int


WIDE = Size("wide", 880, 300, 4000)
NARROW = Size("narrow", 360, 270, 900)


def draw_svg(figure: Figure, size: Size) -> str:
    """Draw the figure as one `<svg>` element that is also valid as a file."""
    if not isinstance(figure, Chart):
        return draw_matrix(figure, size.width, FONT)
    legend, rows = _legend(figure.series, size.width)
    right, top, bottom = 10.0, 12.0 + _ROW * rows, 40.0
    x_low, x_high = span(np.concatenate([series.x for series in figure.series]), False, 0.0)
    y_low, y_high = span(_heights(figure), figure.log_y, 0.06)
    y = Scale(y_low, y_high, size.height - bottom, top, figure.log_y, 42)
    left = 34.0 + 7 * max(len(label(tick, y.log)) for tick in y.ticks)
    x = Scale(x_low, x_high, left, size.width - right)
    body = "".join(_series(series, x, y, size.points) for series in figure.series)
    clip = f"{figure.name}-{size.name}"
    box = f'x="{left}" y="{top}" width="{x.end - x.start:.2f}" height="{y.start - y.end:.2f}"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="{size.name}" viewBox="0 0 {size.width:g} {size.height:g}" '
        f'role="img" aria-label="{escape(figure.title, quote=True)}" font-family="{FONT}" font-size="12" '
        f'fill="{_INK}" data-x="{x.low!r} {x.high!r} {x.start} {x.end}" '
        f'data-y="{y.low!r} {y.high!r} {y.start} {y.end}" data-log="{int(y.log)}">'
        f'<clipPath id="{clip}"><rect {box}/></clipPath>'
        f"{_y_axis(figure, x, y, size)}{_x_axis(figure, x, y, size)}"
        f'<g clip-path="url(#{clip})"><g class="plot" fill="none">{body}</g></g>'
        f'<rect {box} fill="none" stroke="#9aa0a8"/>{legend}</svg>'
    )


def _heights(chart: Chart) -> Array:
    return np.concatenate([part for series in chart.series for part in (series.y, series.low) if part is not None])


def _series(series: Series, x: Scale, y: Scale, points: int) -> str:
    shape = {
        "line": 'stroke-width="1.4"',
        "broad": 'stroke-width="5" stroke-opacity="0.35"',
        "dashed": 'stroke-width="1.6" stroke-dasharray="6 4"',
        "points": 'stroke-width="4" stroke-linecap="round"',
        "dots": 'stroke-width="2" stroke-linecap="round"',
        "area": 'stroke="none" fill-opacity="0.18"',
        "steps": 'stroke-width="1.2" fill-opacity="0.25"',
    }[series.kind]
    filled = series.kind in ("area", "steps")
    colour = f'fill="{series.colour}"' if filled else ""
    stroke = "" if series.kind == "area" else f'stroke="{series.colour}"'
    return (
        f'<path data-name="{escape(series.name, quote=True)}" data-kind="{series.kind}" '
        f'vector-effect="non-scaling-stroke" '
        f'stroke-linejoin="round" {shape} {stroke} {colour} d="{_path(series, x, y, points)}"/>'
    )


def _path(series: Series, x: Scale, y: Scale, points: int) -> str:
    if series.kind == "steps":
        edges, tops = np.repeat(series.x, 2)[1:-1], np.repeat(series.y, 2)
        floor = np.full(1, y.low)
        return _polyline(
            x.pixels(np.concatenate((edges[:1], edges, edges[-1:]))), y.pixels(np.concatenate((floor, tops, floor)))
        )
    if series.low is not None:
        both = np.concatenate((series.y, series.low[::-1]))
        return _polyline(x.pixels(np.concatenate((series.x, series.x[::-1]))), y.pixels(both)) + "Z"
    kept_x, kept_y = thin(series.x, series.y, points)
    if series.kind in ("points", "dots"):
        places = zip(x.pixels(kept_x).tolist(), y.pixels(kept_y).tolist(), strict=True)
        return "".join(f"M{across:.2f},{up:.2f}h0" for across, up in places if np.isfinite(up))
    return _polyline(x.pixels(kept_x), y.pixels(kept_y))


def _polyline(across: Array, up: Array) -> str:
    """A path through the points, interrupted where `up` is not finite."""
    text, pen = [], "M"
    for at, height in zip(across.tolist(), up.tolist(), strict=True):
        if np.isfinite(height):
            text.append(f"{pen}{at:.2f},{height:.2f}")
            pen = "L"
        else:
            pen = "M"
    return "".join(text)


def _x_axis(chart: Chart, x: Scale, y: Scale, size: Size) -> str:
    marks = "".join(
        f'<line x1="{at:.2f}" x2="{at:.2f}" y1="{y.start}" y2="{y.end}" stroke="{_GRID}"/>'
        f'<text x="{at:.2f}" y="{y.start + 16}" text-anchor="middle">{label(tick)}</text>'
        for tick, at in zip(x.ticks, x.pixels(np.array(x.ticks)).tolist(), strict=True)
    )
    middle = (x.start + x.end) / 2
    title = f'<text x="{middle}" y="{size.height - 6}" text-anchor="middle">{escape(chart.x_label)}</text>'
    return f'<g class="x-axis">{marks}</g>{title}'


def _y_axis(chart: Chart, x: Scale, y: Scale, size: Size) -> str:
    marks = "".join(
        f'<line x1="{x.start}" x2="{x.end}" y1="{at:.2f}" y2="{at:.2f}" stroke="{_GRID}"/>'
        f'<text x="{x.start - 6}" y="{at + 4:.2f}" text-anchor="end">{label(tick, y.log)}</text>'
        for tick, at in zip(y.ticks, y.pixels(np.array(y.ticks)).tolist(), strict=True)
    )
    middle = (y.start + y.end) / 2
    turned = f'transform="rotate(-90 13 {middle})"'
    title = f'<text x="13" y="{middle}" text-anchor="middle" {turned}>{escape(chart.y_label)}</text>'
    return f'<g class="y-axis">{marks}</g>{title}'


def _legend(series: tuple[Series, ...], width: float) -> tuple[str, int]:
    named = [one for one in series if one.name]
    across, row, parts = 58.0, 0, []
    for one in named:
        needed = 40 + 6.8 * len(one.name)
        if across + needed > width and across > 58:
            across, row = 58.0, row + 1
        up = 11 + _ROW * row
        dash = ' stroke-dasharray="6 4"' if one.kind == "dashed" else ""
        thick = {"area": 9, "steps": 9, "points": 5, "dots": 4, "broad": 6}.get(one.kind, 2.2)
        faint = ' stroke-opacity="0.3"' if one.kind in ("area", "steps", "broad") else ""
        parts.append(
            f'<line x1="{across:.1f}" x2="{across + 18:.1f}" y1="{up - 4}" y2="{up - 4}" stroke="{one.colour}" '
            f'stroke-width="{thick}"{dash}{faint}/><text x="{across + 23:.1f}" y="{up}">{escape(one.name)}</text>'
        )
        across += needed
    return "".join(parts), row + 1 if named else 0
