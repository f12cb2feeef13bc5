"""matplotlib figures, made without pyplot: they need no screen, hold no state, and show themselves in a notebook."""

import io
from typing import TYPE_CHECKING, Any

from hil.errors import MissingExtra

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def new_figure(width: float, height: float, dpi: int = 130) -> "Figure":
    """An empty figure, width and height in inches; raises MissingExtra where matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtra("Drawing needs the package matplotlib: pip install 'hil[png]'.") from error

    class ShownFigure(Figure):
        """A figure that IPython can display without pyplot."""

        def _repr_png_(self) -> bytes:
            data = io.BytesIO()
            self.savefig(data, format="png")
            return data.getvalue()

    figure: Any = ShownFigure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure  # type: ignore[no-any-return]
