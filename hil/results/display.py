"""Values with error bars, formatted for an interpreter or a notebook."""

from collections.abc import Mapping, Sequence
from html import escape

from hil.results.parts import Quantity


def as_text(title: str, quantities: Mapping[str, Quantity], sentences: Sequence[str]) -> str:
    """Format a title, one line per quantity, and sentences."""
    return "\n".join([title, *(f"  {name:20s} {found}" for name, found in quantities.items()), *sentences])


def as_html(
    title: str, quantities: Mapping[str, Quantity], truth: Mapping[str, float], sentences: Sequence[str]
) -> str:
    """Format a title, quantities and sentences as HTML, with a column of true values if there are any."""
    head = ("parameter", "value", "standard error", "unit", *(("truth",) if truth else ()))
    rows = [
        (
            name,
            f"{found.value:.6g}",
            f"{found.std:.2g}",
            "" if found.unit == "1" else found.unit,
            *((f"{truth[name]:.6g}" if name in truth else "",) if truth else ()),
        )
        for name, found in quantities.items()
    ]
    words = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
    return f"<div><p><b>{escape(title)}</b></p>{html_table(head, rows)}{words}</div>"


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain HTML table with every cell escaped."""
    cells = "".join(f"<th>{escape(each)}</th>" for each in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"
