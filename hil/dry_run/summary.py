"""The outcome of a dry run as text, as a table and as a JSON object."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude
from hil.dry_run.prediction import Prediction, quantities_of
from hil.dry_run.stopping_distance import Stopping, Way
from hil.printing import print_fitting, say


@dataclass(frozen=True)
class DryRun:
    """The outcome of a dry run.

    source: "prior" or "result". arms: number of simulated arms. asked: prediction for the configured
    experiment.peak_torque, None if not configured. largest: the largest safe torque with its prediction. servos:
    messages from reading the servos.
    """

    source: str
    arms: int
    asked: Prediction | None
    largest: Amplitude
    stopping: Stopping
    servos: tuple[str, ...]

    def is_safe(self, config: Config) -> bool:
        """Whether the configured torque is safe; if none is configured, whether a safe torque exists."""
        return self.asked is None or self.asked.stop_chance <= config.safety.limit_chance


def dry_run_json(config: Config, run: DryRun) -> dict[str, Any]:
    """One JSON object: verdict, largest safe torque, and every predicted quantity of each joint."""
    return {
        "schema": 1,
        "config": str(config.path),
        "source": run.source,
        "arms": run.arms,
        "safe": run.is_safe(config),
        "limit_chance": config.safety.limit_chance,
        "largest_peak_torque": [round(float(value), 4) for value in run.largest.peak_torque],
        "asked": None if run.asked is None else _prediction_json(config, run.asked),
        "largest": _prediction_json(config, run.largest.prediction),
        "stopping_distance_rad": {
            "planned": _ways_json(run.stopping.planned),
            "passed": _ways_json(run.stopping.passed),
        },
        "servos": list(run.servos),
    }


def _ways_json(ways: dict[Way, NDArray[np.float64]]) -> dict[str, list[float]]:
    return {str(way): [round(float(value), 3) for value in beyond] for way, beyond in ways.items()}


def print_dry_run(config: Config, run: DryRun, console: Console) -> None:
    """Print the table and the verdict."""
    shown = run.largest.prediction if run.asked is None else run.asked
    print_fitting(console, _table(config, shown, run))
    for line in (*run.servos, *dry_run_lines(config, shown, run)):
        say(console, line)


def settling_text(config: Config, prediction: Prediction) -> str:
    """One sentence about how many of the simulated arms settled, and when."""
    settled = prediction.settled_after > 0
    if not settled.any():
        return f"No simulated arm settled within {config.experiment.max_settling_periods} periods."
    seconds = config.experiment.ramp + config.experiment.period * float(
        np.quantile(prediction.settled_after[settled], 0.99)
    )
    return f"{100 * settled.mean():.0f} % of the simulated arms settle, 99 % of them within {seconds:g} s of the start."


def joints_json(config: Config, prediction: Prediction) -> dict[str, Any]:
    """Return each joint's predicted peaks, their limits and the probability of exceeding them, by joint and
    quantity.
    """
    median, quantile, chance = prediction.median, prediction.quantile, prediction.limit_chance
    return {
        joint.name: {
            name: {
                "unit": unit,
                "median": float(median[row, index]),
                "quantile_99": float(quantile[row, index]),
                "limit": float(prediction.limits[row, index]),
                "chance": float(chance[row, index]),
            }
            for row, (name, unit) in enumerate(quantities_of(config))
        }
        for index, joint in enumerate(config.joints)
    }


def _prediction_json(config: Config, prediction: Prediction) -> dict[str, Any]:
    return {"guard_stop_chance": prediction.stop_chance, "joints": joints_json(config, prediction)}


def _table(config: Config, prediction: Prediction, run: DryRun) -> Table:
    table = Table(
        title=f"Dry run of {escape(config.path.name)}, {run.arms} arms drawn from the {run.source}",
        title_justify="left",
    )
    for heading in ("joint", "predicted peak", "unit"):
        table.add_column(heading)
    for heading in ("median", "99 %", "limit", "chance"):
        table.add_column(heading, justify="right")
    median, quantile, chance = prediction.median, prediction.quantile, prediction.limit_chance
    for index, joint in enumerate(config.joints):
        for row, (name, unit) in enumerate(quantities_of(config)):
            numbers = (median[row, index], quantile[row, index], prediction.limits[row, index])
            cells = [f"{value:.3g}" for value in numbers] + [_percent(chance[row, index])]
            table.add_row(escape(joint.name) if row == 0 else "", name, unit, *cells)
        table.add_section()
    return table


def dry_run_lines(config: Config, shown: Prediction, run: DryRun) -> list[str]:
    """Explain the result in sentences, the verdict last."""
    torque = ", ".join(f"{value:.2f}" for value in run.largest.peak_torque)
    planned, passed = run.stopping.planned, run.stopping.passed
    stopped = np.maximum(planned[Way.BRAKED], planned[Way.CUT])
    lines = [
        "99 %: in 99 of 100 arms, all peaks stay within these values.",
        settling_text(config, shown),
        f"If stopped at any moment, they overshoot their limits by up to {_each(config, stopped)}; if the program is "
        f"killed or the cable unplugged, by up to {_each(config, planned[Way.SILENT])}.",
        "If something drives them past a limit at these speeds, they overshoot it by up to "
        f"{_each(config, passed[Way.BRAKED])} when braked and {_each(config, passed[Way.CUT])} when torque is cut. "
        "Keep that much space clear.",
        f"Largest safe torque: peak_torque = [{torque}] N m.",
    ]
    allowed = f"safety.limit_chance allows {100 * config.safety.limit_chance:g} %"
    if run.asked is None:
        return [
            *lines,
            f"Safe at that torque: probability of a guard stop: {_percent(shown.stop_chance)}; {allowed}.",
        ]
    word = "SAFE" if run.is_safe(config) else "NOT SAFE as configured"
    return [*lines, f"{word}: probability of a guard stop: {_percent(shown.stop_chance)}; {allowed}."]


def _percent(chance: float) -> str:
    """A percentage; below a millionth of a percent, the tail of a few hundred arms is meaningless."""
    return "0 %" if chance < 1e-8 else f"{100 * chance:.2g} %"


def _each(config: Config, beyond: NDArray[np.float64]) -> str:
    each = ["a turn or more" if value >= 2 * np.pi else f"{value:.2f} rad" for value in beyond]
    return ", ".join(f"{joint.name} {far}" for joint, far in zip(config.joints, each, strict=True))
