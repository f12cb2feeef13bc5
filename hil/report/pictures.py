"""The report's figures as separate files."""

from collections.abc import Sequence
from pathlib import Path

from hil.errors import not_written
from hil.report.chart import Figure
from hil.report.page import figures_in, sections
from hil.report.png import save_png
from hil.report.recording_page import recording_figures
from hil.report.run_data import RunData
from hil.report.svg import WIDE, draw_svg
from hil.runs.recording_folder import is_recording_folder


def save_pictures(shown: Sequence[Figure], folder: Path, kind: str) -> list[Path]:
    """Save these figures in `folder` as "png" or "svg"; return the paths. Raises MissingExtra, RunFolderError."""
    saved = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for figure in shown:
            path = folder / f"{figure.name}.{kind}"
            if kind == "png":
                save_png(figure, path)
            else:
                path.write_text(draw_svg(figure, WIDE), encoding="utf-8")
            saved.append(path)
    except OSError as error:
        raise not_written(folder, error) from error
    return saved


def figures(data: RunData) -> list[Figure]:
    """All figures of the report, in order."""
    return figures_in(sections(data))


def figures_of(run: Path) -> list[Figure]:
    """All figures of the report of a run, or of an estimate from other tools' recordings."""
    return recording_figures(run) if is_recording_folder(run) else figures(RunData.load(run))
