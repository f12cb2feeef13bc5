"""`hil.dry_run`: simulate the experiment on arms similar to the real one. Nothing moves."""

from concurrent.futures import Executor
from dataclasses import dataclass
from html import escape
from os import PathLike
from pathlib import Path
from typing import Any

from hil.api.configuration import ConfigLike, loaded
from hil.api.progress import OnProgress, Progress, forgiving, ignore
from hil.config.schema import Config
from hil.dry_run.chain_summary import ChainDryRun, chain_dry_run_json
from hil.dry_run.prediction import Prediction, quantities_of
from hil.dry_run.run import ARMS
from hil.dry_run.run import dry_run as simulate
from hil.dry_run.summary import DryRun, dry_run_json
from hil.errors import ConfigError
from hil.estimator.selection.verdict import percent
from hil.pilot.chain_rehearsal import rehearse
from hil.pilot.rehearsal import rehearse_in_steps
from hil.results.display import html_table

__all__ = ["Rehearsal", "dry_run"]


@dataclass(frozen=True, repr=False, eq=False)
class Rehearsal:
    """The outcome of a dry run.

    file: the configuration file, as passed by the caller. found: the complete results of the simulation.
    """

    file: Path
    config: Config
    found: DryRun | ChainDryRun

    @property
    def is_safe(self) -> bool:
        """Whether the configured torque is safe; if none is configured, whether a safe torque exists."""
        return self.found.is_safe(self.config)

    @property
    def stop_chance(self) -> float:
        """Probability that the guard would have to stop the arm, from 0 to 1."""
        return float(self.prediction.stop_chance)

    @property
    def largest_peak_torque(self) -> tuple[float, ...]:
        """The largest safe peak torque of each joint [N m]; empty if the dry run found none and leaves the search to
        the pilot.
        """
        if isinstance(self.found, ChainDryRun):
            return self.found.peak_torque
        largest = self.found.largest
        return () if largest is None else tuple(float(value) for value in largest.peak_torque)

    @property
    def prediction(self) -> Prediction:
        """The prediction for the configured torque. If none is configured, the prediction for the largest safe torque
        or for the pilot's first run.
        """
        return self.found.prediction if isinstance(self.found, ChainDryRun) else self.found.shown

    def to_json(self) -> dict[str, Any]:
        """The object that `hil dry-run --json` prints."""
        if isinstance(self.found, ChainDryRun):
            return chain_dry_run_json(self.found)
        return dry_run_json(self.config, self.found)

    def plot(self) -> Any:
        """Plot the simulated motions against the position limits as a matplotlib figure. Raises MissingExtra."""
        from hil.dry_run.plot import plot

        return plot(self.config, self.prediction)

    def __repr__(self) -> str:
        torque = ", ".join(f"{value:.2f}" for value in self.largest_peak_torque)
        largest = (
            f"largest safe peak_torque = [{torque}] N m" if torque else "the pilot will find the largest safe torque"
        )
        return (
            f"Dry run of {self.file} on {self.found.arms} arms drawn from the {self.found.source}: "
            f"{'safe' if self.is_safe else 'NOT SAFE'}, chance of a guard stop {percent(self.stop_chance)}; "
            f"{largest}"
        )

    def _repr_html_(self) -> str:
        shown = self.prediction
        rows = [
            (
                joint.name,
                name,
                unit,
                *(f"{values[row, index]:.3g}" for values in (shown.median, shown.quantile, shown.limits)),
            )
            for index, joint in enumerate(self.config.joints)
            for row, (name, unit) in enumerate(quantities_of(joint))
        ]
        return f"<p>{escape(repr(self))}</p>" + html_table(("joint", "peak", "unit", "median", "99 %", "limit"), rows)


def dry_run(
    config: ConfigLike,
    *,
    result: str | PathLike[str] | None = None,
    arms: int = ARMS,
    servos: bool = False,
    executor: Executor | None = None,
    on_progress: OnProgress = ignore,
) -> Rehearsal:
    """Simulate the experiment on arms consistent with what is known about the real one (`hil dry-run` as a function).

    Args:
        config: TOML file of the arm, the name of a bundled one, or a loaded configuration.
        result: run folder or result.json of an earlier identification, used instead of [arm.prior].
        arms: number of arms to simulate.
        servos: also read the servos' limits and measure bus timing, with torque off.
        executor: a concurrent.futures executor, or `hil.study.engine.executor`, that simulates the arms. It does not
            change the result.
        on_progress: called with a `Progress` when the simulation begins.

    Raises:
        ConfigError: the configuration is wrong.
        ResultError: `result` holds no result.
        NoSafeTorque: no torque keeps all simulated arms within their limits.
        hil.drivers.errors.DriverError: `servos` is true and the servos do not answer.
    """
    checked, shown = loaded(config)
    report = forgiving(on_progress)
    report(Progress("simulation", "Simulating"))
    former = None if result is None else Path(result)
    if checked.is_chain:
        if former is not None:
            raise ConfigError(
                f"{shown}: --result is for planar arms; a spatial arm's dry run takes its prior from the description."
            )

        def tell(done: int, of: int) -> None:
            if done % max(1, of // 20) == 0:
                report(Progress("simulation", f"Simulated {done} of {of} motions"))

        def designing(done: int, of: int) -> None:
            if done % max(1, of // 4) == 0:
                report(Progress("simulation", f"Designing a path: {done} of {of} steps"))

        return Rehearsal(shown, checked, rehearse(checked, arms, servos, tell, designing))
    rehearsed = rehearse_in_steps if checked.experiment.pilot else simulate
    return Rehearsal(shown, checked, rehearsed(checked, former, arms, servos, executor))
