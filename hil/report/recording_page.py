"""The report of an estimate from another tool's recordings: the sections that need no bus and no experiment."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.arm_model import ArmModel
from hil.model_file import model_of, read_usable_result
from hil.report.chart import BLUE, GREEN, ORANGE, Chart, Figure, Series, thin
from hil.report.page import FILE_NAME, figures_in, render
from hil.report.section import Folded, Picture, Section, Table
from hil.report.sections.correlation import correlation_of
from hil.report.sections.friction import friction_curve, friction_interval, model_curve
from hil.report.sections.parameters import parameters_of
from hil.report.sections.verdict import TITLES
from hil.report.words import percent
from hil.results.result import Result, ShootingResult
from hil.runs.recording_folder import Predicted, RecordingRecord, load_record, load_recordings
from hil.whole_file import write_whole

MOST_POINTS = 3000
_CURVE = 401


@dataclass(frozen=True)
class _Shown:
    folder: Path
    record: RecordingRecord
    result: Result
    model: ArmModel
    recordings: tuple[Predicted, ...]


def write_recording_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report on a recording folder, by default into that folder. Return the report's path.

    Raises RunFolderError, ResultError.
    """
    shown = _load(folder)
    title = Path(shown.record.config or shown.record.files[0].path).stem
    path = out or folder / FILE_NAME
    write_whole(path, render(title, shown.record.started, _sections(shown)))
    return path


def recording_figures(folder: Path) -> list[Figure]:
    """All figures in the report on a folder of estimates from recordings, in order."""
    return figures_in(_sections(_load(folder)))


def _load(folder: Path) -> _Shown:
    result = read_usable_result(folder)
    return _Shown(folder, load_record(folder), result, model_of(result, folder), load_recordings(folder))


def _sections(shown: _Shown) -> list[Section]:
    sections = (
        *(_verdict(shown), parameters_of(shown.result), _prediction(shown), _friction(shown)),
        *(correlation_of(shown.result), _next(shown), _provenance(shown)),
    )
    return [each for each in sections if each is not None]


def _verdict(shown: _Shown) -> Section:
    judged = shown.result.verdict
    trust, sentences = ("with care", ()) if judged is None else (judged.trust, judged.sentences)
    tone, title = TITLES[trust]
    notes = shown.result.notes if isinstance(shown.result, ShootingResult) else ()
    warnings = [f"Warning: {warning}" for warning in shown.result.warnings]
    return Section("verdict", title, tone=tone, bullets=(*sentences, *warnings, *notes))


def _prediction(shown: _Shown) -> Section | None:
    """The section that shows the longest recording; None if nothing was simulated."""
    longest = max(shown.recordings, key=lambda each: each.time.size)
    if not np.isfinite(longest.predicted).any():
        return None
    pictures = []
    for joint, facts in enumerate(shown.model.joints):
        time, error = longest.time - longest.time[0], longest.position[joint] - longest.predicted[joint]
        series = [
            Series("measured", *thin(time, longest.position[joint], MOST_POINTS), BLUE, "broad"),
            Series("model", *thin(time, longest.predicted[joint], MOST_POINTS), ORANGE),
        ]
        chart = Chart(f"position_{joint + 1}", f"Position of {facts.name}", "time [s]", "position [rad]", tuple(series))
        said = f"{facts.name}: measured, and simulated segment by segment from estimated initial states."
        pictures.append(Picture(chart, said))
        torque = Series("", *thin(time, longest.torque[joint], MOST_POINTS), GREEN)
        chart = Chart(f"torque_{joint + 1}", f"Torque of {facts.name}", "time [s]", "torque [N m]", (torque,))
        pictures.append(Picture(chart, f"{facts.name}: driving torque."))
        left = Series("measured minus model", *thin(time, 1000.0 * error, MOST_POINTS), BLUE, "dots")
        chart = Chart(f"residual_{joint + 1}", f"Residual of {facts.name}", "time [s]", "mrad", (left,))
        rms = 1000.0 * float(np.sqrt(np.nanmean(error**2)))
        pictures.append(Picture(chart, f"{facts.name}: {rms:.3g} mrad RMS remain unexplained."))
    held_out = shown.result.validation.held_out_rms
    words = (
        ()
        if held_out is None
        else (
            "Segments that were not fitted are predicted to within "
            f"{percent(max(held_out))} of the motion's RMS; the plots show the fit to all segments of {longest.name}.",
        )
    )
    return Section("prediction", "Measured and simulated motion", words, pictures=tuple(pictures))


def _friction(shown: _Shown) -> Section:
    pictures = []
    for joint, facts in enumerate(shown.model.joints):
        at = facts.velocity_limit * np.linspace(-1, 1, _CURVE) ** 3
        curve = friction_curve(shown.model, at)[:, joint]
        low, high = friction_interval(shown.model, shown.result.covariance, at, joint)
        series, said = model_curve(at, curve, low, high)
        chart = Chart(f"friction_{joint + 1}", f"Friction of {facts.name}", "speed [rad/s]", "friction [N m]", series)
        pictures.append(Picture(chart, f"{facts.name}: friction versus speed, without the constant offset.{said}"))
    return Section("friction", "Friction", pictures=tuple(pictures))


def _next(shown: _Shown) -> Section:
    folder = shown.folder
    commands = (
        ("the arm for MuJoCo, or as URDF", f"hil export {folder} --format mjcf --format urdf"),
        ("compare with another recording", f"hil diff {folder} OTHER_RUN"),
        ("estimate again after changing config.toml", f"hil estimate {folder}"),
    )
    return Section("next", "What next", tables=(Table(("", ""), commands, 2),))


def _provenance(shown: _Shown) -> Section:
    record = shown.record
    rows = [
        ("configuration", record.config or "none; the column names determined how the file was read"),
        ("estimated", record.started),
        *(("file", f"{file.path}{f', SHA-256 {file.sha256[:16]}' if file.sha256 else ''}") for file in record.files),
        ("method", shown.result.method),
        ("machine", f"{record.machine}, Python {record.python}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in record.versions.items())),
    ]
    text = (shown.folder / "config.toml").read_text(encoding="utf-8")
    return Section(
        *("provenance", "Data used for this estimate", ()),
        tables=(Table(("", ""), tuple(rows), 2),),
        folded=(Folded("Configuration", text),),
    )
