"""matplotlib figures created without pyplot: they need no display, keep no global state, and render in notebooks."""

import io
from typing import TYPE_CHECKING, Any

from hil.errors import MissingExtra

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float, dpi: int = 130) -> "Figure":
    """Create an empty figure; width and height in inches. Raises MissingExtra if matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("Plotting needs the package matplotlib: pip install 'hil[png]'.") from error

    class ShownFigure(Figure):
        """A figure that IPython can display without pyplot."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png")
            return data.getvalue()

    figure: Any = ShownFigure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure  # type: ignore[no-any-return]
