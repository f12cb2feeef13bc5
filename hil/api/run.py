"""A run folder as an object, and results linked to the run they came from."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hil.arm_model import ArmModel
from hil.config.schema import Config
from hil.errors import ResultError
from hil.model_file import model_of, read_result
from hil.results.display import html_table
from hil.results.parts import StreamTiming
from hil.results.result import Result, SettledResult, ShootingResult
from hil.runs.period_file import PlayedPeriod, load_periods
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder, RunRecord
from hil.runs.timing import timing

if TYPE_CHECKING:
    from hil.export.formats import Written

__all__ = ["Estimation", "Identification", "Run", "load_run"]

_NOT_STORED = {"json": False}  # result.json need not contain its own location
_SHOWN = ("position", "residual")


@dataclass(frozen=True, kw_only=True, repr=False)
class Identification(SettledResult):
    """An identified arm: the contents of its result.json, and its run folder."""

    run: Path = field(metadata=_NOT_STORED)

    @property
    def model(self) -> ArmModel:
        """The identified arm as a model that computes torques and motions."""
        return model_of(self, self.run)

    def plot(self, *names: str) -> Any:
        """Draw figures of the report, stacked in one matplotlib figure that a notebook displays.

        Args:
            names: names of the figures, such as "residual_1", "friction_2" or "correlation", or prefixes of them; by
                default, measured and predicted positions and their residuals.

        Raises:
            MissingExtra: matplotlib is not installed.
            ValueError: no figure has such a name; the message lists the available ones.
        """
        from hil.report.pictures import figures
        from hil.report.png import draw_figures
        from hil.report.run_data import RunData

        found = {figure.name: figure for figure in figures(RunData.load(self.run))}
        wanted = names or _SHOWN
        for name in names:
            if not any(each.startswith(name) for each in found):
                raise ValueError(f"no figure name starts with {name!r}; available: {', '.join(found)}")
        chosen = [figure for each, figure in found.items() if each.startswith(wanted)]
        return draw_figures(chosen or list(found.values()))

    def report(self, out: str | PathLike[str] | None = None) -> Path:
        """Write the HTML report into the run folder, or to the file `out`. Return its path."""
        from hil.report.page import FILE_NAME, write_report
        from hil.report.run_data import RunData

        path = self.run / FILE_NAME if out is None else Path(out)
        write_report(RunData.load(self.run), path)
        return path

    def export(
        self, kind: str, out: str | PathLike[str] | None = None, *, link_length: float | None = None
    ) -> "Written":
        """Write the arm or its recording as "urdf", "mjcf", "toml", "json", "csv", "parquet", "mcap" or "mat".

        Returns:
            The file's path, and one sentence per item that the format cannot represent.

        Raises:
            ExportError: the format cannot hold this arm, or a package for it is not installed.
            ResultError: the run has been estimated again since this result was obtained.
        """
        from hil.export.formats import FORMATS, export
        from hil.model_file import read_result

        if not isinstance(kind, str):
            raise TypeError(f'kind must be the name of one format, such as "urdf", not {kind!r}.')
        if kind in FORMATS and dict(read_result(self.run).quantities) != dict(self.quantities):
            raise ResultError(
                f"{self.run} has been estimated again since this result was obtained, so the file would contain other "
                f"values. To export the new ones: hil.load_run({str(self.run)!r}).result.export({kind!r})."
            )
        return export(self.run, kind, None if out is None else Path(out), link_length)


@dataclass(frozen=True, kw_only=True, repr=False)
class Estimation(ShootingResult):
    """The result of multiple shooting on an arbitrary motion.

    run: the run folder; None for recordings made elsewhere.
    """

    run: Path | None = field(default=None, metadata=_NOT_STORED)

    def plot(self) -> Any:
        """Plot the correlation matrix of the parameters as a matplotlib figure. Raises MissingExtra."""
        from hil.report.chart import Matrix
        from hil.report.png import draw_figures
        from hil.report.sections.correlation import correlations

        names = self.covariance.names
        return draw_figures(
            [Matrix("correlation", "Parameter correlations", names, correlations(self.covariance.array()))]
        )


@dataclass(frozen=True, repr=False, eq=False)
class Run:
    """A recorded run. Because it holds arrays, it is equal only to itself; to compare two runs, compare their `result`.

    config: the configuration, with the experiment that was actually run. record: the contents of run.json. samples:
    every sample taken (dtype: hil.runs.recording.sample_type). events: pairs (time on the port's clock [s], what
    happened).
    periods: after an estimate, the settled periods by the role of their segment (for example "identify"), as measured
    and as predicted by the model. result: None before an estimate.
    """

    path: Path
    config: Config
    record: RunRecord
    samples: NDArray[np.void]
    events: tuple[tuple[float, str], ...]
    periods: Mapping[str, PlayedPeriod]
    result: Identification | Estimation | None

    @property
    def timing(self) -> StreamTiming:
        """How well the stream met its deadlines."""
        return timing(self.samples, self.config.experiment.rate)

    @property
    def model(self) -> ArmModel:
        """The identified arm. Raises ResultError if there is no estimate from settled periods yet."""
        if not isinstance(self.result, Identification):
            raise ResultError(f"{self.path} has no estimate from settled periods yet; run hil.estimate first.")
        return self.result.model

    def plot(self) -> Any:
        """Plot the position and goal of every joint over the whole recording with matplotlib. Raises MissingExtra."""
        from hil.report.chart import BLUE, ORANGE, Chart, Series, thin
        from hil.report.png import draw_figures

        time = self.samples["deadline"] - self.samples["deadline"][0]
        charts = []
        for index, joint in enumerate(self.config.joints):
            unit = "V" if joint.drive_mode.name == "PWM" else "A"
            for key, said, colour in (("position", "position [rad]", BLUE), ("goal_current", f"goal [{unit}]", ORANGE)):
                x, y = thin(time, np.asarray(self.samples[key][:, index], dtype=np.float64), 4000)
                title = f"{said.split(' [')[0].capitalize()} of {joint.name}"
                charts.append(Chart(f"{key}_{index + 1}", title, "time [s]", said, (Series("", x, y, colour),)))
        return draw_figures(charts)

    def __repr__(self) -> str:
        kept = self.timing
        state = "not estimated" if self.result is None else repr(self.result)
        return (
            f"Run {self.path}: {self.record.config}, {kept.samples} samples in {kept.seconds:g} s at "
            f"{kept.rate_held:g} Hz, {kept.lost_replies} replies lost, {kept.missed_ticks} ticks missed\n{state}"
        )

    def _repr_html_(self) -> str:
        kept = self.timing
        rows = [
            ("run folder", str(self.path)),
            ("configuration", self.record.config),
            ("started", self.record.started),
            ("samples", f"{kept.samples} in {kept.seconds:g} s at {kept.rate_held:g} Hz"),
            ("replies lost, ticks missed", f"{kept.lost_replies}, {kept.missed_ticks}"),
        ]
        return html_table(("", ""), rows) + ("" if self.result is None else self.result._repr_html_())


def load_run(path: str | PathLike[str]) -> Run:
    """Read a run folder: configuration, samples, events and, if there is one, the result.

    Raises:
        RunFolderError: the folder holds no readable run.
        ResultError: its result.json is damaged, or was written by a newer version of hil.
        ConfigError: its copy of the configuration is no longer valid.
    """
    run = RunFolder.open(Path(path))
    config = run.load_config()
    return Run(
        run.path,
        config,
        run.load_record(),
        load_samples(run.samples_path, len(config.joints)),
        run.load_events(),
        load_periods(run.path),
        with_run(read_result(run.path), run.path) if run.result_path.is_file() else None,
    )


def with_run(result: Result, run: Path) -> Identification | Estimation:
    if isinstance(result, SettledResult):
        return identification(result, run)
    assert isinstance(result, ShootingResult)
    return estimation(result, run)


def identification(result: SettledResult, run: Path) -> Identification:
    """Return a result from settled periods together with its run folder."""
    return Identification(**_fields(result), run=run)


def estimation(result: ShootingResult, run: Path | None) -> Estimation:
    """Return a result of multiple shooting together with its run folder, which is None for recordings made
    elsewhere.
    """
    return Estimation(**_fields(result), run=run)


def _fields(result: Result) -> dict[str, Any]:
    return {each.name: getattr(result, each.name) for each in fields(result)}
