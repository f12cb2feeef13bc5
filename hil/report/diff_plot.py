"""Plot of the changes between two runs, with confidence intervals; significant changes are marked."""

from pathlib import Path

from hil.errors import MissingExtra, RunFolderError, not_written
from hil.estimation.changes.diff import Change, Difference

_SHOWN_PERCENT = 100.0
_WIDTH_OF_95 = 1.96


def save_diff_plot(difference: Difference, path: Path) -> None:
    """Save a PNG or SVG, depending on the extension of `path`. Raises MissingExtra (no matplotlib), RunFolderError."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("The plot needs matplotlib: pip install 'hil[png]'.") from error
    shown = [change for change in difference.changes if _interval(change) is not None]
    figure = Figure(figsize=(7.0, 0.8 + 0.28 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for row, change in enumerate(reversed(shown)):
        percent, half = _interval(change) or (0.0, 0.0)
        colour = "tab:red" if change.changed else "0.45"
        axes.errorbar(percent, row, xerr=half, fmt="o", color=colour, capsize=3, markersize=4)
    axes.set_yticks(range(len(shown)), [change.name for change in reversed(shown)])
    axes.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    axes.set_xlabel("change, % of the earlier value, with 95 % interval; red: significant")
    try:
        figure.savefig(path, dpi=150)
    except OSError as error:
        raise not_written(path, error) from error
    except ValueError as error:  # an extension that matplotlib does not know
        raise RunFolderError(f"{path} cannot be written: {error}.") from error


def _interval(change: Change) -> tuple[float, float] | None:
    """Change and half-width of its 95 % interval [% of the earlier value]; None if undefined or too wide to show."""
    if change.percent is None or not change.before:
        return None
    half = _WIDTH_OF_95 * 100 * (change.before_std**2 + change.after_std**2) ** 0.5 / abs(change.before)
    hidden = not change.changed and half > _SHOWN_PERCENT
    return None if hidden else (change.percent, half)
