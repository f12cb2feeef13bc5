"""Formatting of numbers and lists for readers."""

from collections.abc import Sequence


def listed(words: Sequence[str]) -> str:
    """Join words as in "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}" if words else ""


def percent(share: float) -> str:
    """Format a fraction as a percentage with two significant digits."""
    return f"{float(f'{100 * share:.2g}'):g} %"


def steps(value: float) -> str:
    """Format encoder steps with three significant digits."""
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def number(value: float, digits: int = 5) -> str:
    """Format a value with this many significant digits."""
    return f"{value:.{digits}g}".replace("-", "\u2212")


def plain(name: str) -> str:
    """Format a snake_case word as text."""
    return name.replace("_", " ")
