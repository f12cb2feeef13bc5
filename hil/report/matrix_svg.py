"""A correlation matrix as SVG: red for positive, blue for negative values, with each cell's value as a tooltip."""

from html import escape

import numpy as np

from hil.report.chart import Matrix

LARGE = 30
"""A matrix with more labels than this is drawn without its faint cells, which would make up most of the page."""
FAINT = 0.1


def draw_matrix(matrix: Matrix, width: float, font: str) -> str:
    """Draw the matrix as an `<svg>` element of the given `width` [px]."""
    count = len(matrix.labels)
    letters = max(map(len, matrix.labels))
    size = 12.0 if width > 500 else 8.5
    left = 10 + 0.58 * size * letters
    cell = min(34.0, (width - left - 6) / count)
    top = left - 4
    height = top + cell * count + 8
    parts = []
    for row, name in enumerate(matrix.labels):
        up = top + cell * (row + 0.5) + 0.35 * size
        parts.append(f'<text x="{left - 5:.1f}" y="{up:.1f}" text-anchor="end">{escape(name)}</text>')
        at = left + cell * (row + 0.5) + 0.35 * size
        turned = f'transform="rotate(-90 {at:.1f} {top - 5:.1f})"'
        parts.append(f'<text x="{at:.1f}" y="{top - 5:.1f}" {turned}>{escape(name)}</text>')
        shown = [column for column in range(count) if count <= LARGE or not abs(matrix.values[row, column]) < FAINT]
        parts += [_cell(matrix, row, column, left, top, cell) for column in shown]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="{"wide" if width > 500 else "narrow"} matrix" '
        f'viewBox="0 0 {width:g} {height:.1f}" role="img" aria-label="{escape(matrix.title, quote=True)}" '
        f'font-family="{font}" font-size="{size}" fill="#30343b">{"".join(parts)}</svg>'
    )


def _cell(matrix: Matrix, row: int, column: int, left: float, top: float, cell: float) -> str:
    value = float(matrix.values[row, column])
    said = "not determined" if np.isnan(value) else f"{value:+.2f}"
    names = f"{matrix.labels[row]} and {matrix.labels[column]}: {said}"
    return (
        f'<rect x="{left + cell * column:.1f}" y="{top + cell * row:.1f}" width="{cell - 1:.1f}" '
        f'height="{cell - 1:.1f}" fill="{colour(value)}"><title>{escape(names)}</title></rect>'
    )


def colour(value: float) -> str:
    """Colour from blue at -1 through white at 0 to red at 1; grey for NaN."""
    if np.isnan(value):
        return "#d0d3d8"
    far = min(1.0, abs(value))
    end = (178, 24, 43) if value > 0 else (33, 102, 172)
    return "#" + "".join(f"{round(255 + far * (part - 255)):02x}" for part in end)
