"""The outcome of a dry run as text, as a table and as a JSON object."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude
from hil.dry_run.prediction import Prediction, quantities_of
from hil.dry_run.stopping_distance import Stopping, Way
from hil.estimator.arrays import Array
from hil.estimator.selection.verdict import percent
from hil.printing import print_fitting, say

_NOTHING_RAD = 0.005  # two decimals would show 0.00 rad


@dataclass(frozen=True)
class FirstRun:
    """The first run of a pilot.

    peak_torque: peak torques (joints,) [N m]. prediction: peaks of the simulated arms, with the limits of that run.
    played: configuration of that run. It contains the proposed stabiliser if the arm needs one; if no torque is safe
    over the whole range, it has position limits closer to the rest pose.
    """

    peak_torque: Array
    prediction: Prediction
    played: Config

    def is_narrowed(self, config: Config) -> bool:
        """Whether the position limits of this run are narrower than those of `config`."""
        pairs = zip(self.played.joints, config.joints, strict=True)
        return any(tuple(mine.position_limit) != tuple(whole.position_limit) for mine, whole in pairs)


@dataclass(frozen=True)
class DryRun:
    """The outcome of a dry run.

    source: "prior" or "result". arms: number of simulated arms. asked: prediction for the configured
    experiment.peak_torque, None if not configured. largest: the largest safe torque with its prediction; None if no
    torque is safe for all arms, in which case only a pilot can find a safe torque. servos: messages from reading the
    servos. first: the first run of the pilot, None if the torque is configured.
    """

    source: str
    arms: int
    asked: Prediction | None
    largest: Amplitude | None
    stopping: Stopping
    servos: tuple[str, ...]
    first: FirstRun | None = None

    @property
    def shown(self) -> Prediction:
        """The prediction for the configured torque; if none is set, for the largest safe torque or the first run."""
        if self.asked is not None:
            return self.asked
        if self.largest is not None:
            return self.largest.prediction
        assert self.first is not None
        return self.first.prediction

    def is_safe(self, config: Config) -> bool:
        """Whether the configured torque is safe; if none is configured, whether there is a safe torque or a safe first
        run.
        """
        return self.asked is None or self.asked.stop_chance <= config.safety.limit_chance


def dry_run_json(config: Config, run: DryRun) -> dict[str, Any]:
    """Return the JSON object: verdict, largest safe torque, and every predicted quantity per joint."""
    return {
        "schema": 1,
        "config": str(config.path),
        "source": run.source,
        "arms": run.arms,
        "safe": run.is_safe(config),
        "limit_chance": config.safety.limit_chance,
        "largest_peak_torque": None if run.largest is None else _rounded(run.largest.peak_torque),
        "asked": None if run.asked is None else _prediction_json(config, run.asked),
        "largest": None if run.largest is None else _prediction_json(config, run.largest.prediction),
        "first_run": None if run.first is None else _first_json(run.first),
        "stopping_distance_rad": {
            "planned": _ways_json(run.stopping.planned),
            "passed": _ways_json(run.stopping.passed),
        },
        "servos": list(run.servos),
    }


def _rounded(values: Array) -> list[float]:
    return [round(float(value), 4) for value in values]


def _first_json(first: FirstRun) -> dict[str, Any]:
    held = first.played.stabiliser
    return {
        "peak_torque": _rounded(first.peak_torque),
        "position_limit": [list(joint.position_limit) for joint in first.played.joints],
        "stabiliser": None if held is None else {"stiffness": list(held.stiffness), "damping": list(held.damping)},
        **_prediction_json(first.played, first.prediction),
    }


def _ways_json(ways: dict[Way, Array]) -> dict[str, list[float]]:
    return {str(way): [round(float(value), 3) for value in beyond] for way, beyond in ways.items()}


def print_dry_run(config: Config, run: DryRun, console: Console) -> None:
    print_fitting(console, _table(config, run.shown, run))
    for line in (*run.servos, *dry_run_lines(config, run.shown, run)):
        say(console, line)


def settling_text(config: Config, prediction: Prediction) -> str:
    """One sentence about how many of the simulated arms settled, and when."""
    settled = prediction.settled_after > 0
    if not settled.any():
        return (
            f"No simulated arm settled within {config.experiment.max_settling_periods} periods: such a run records no "
            "settled period to estimate from, even if it is safe. A longer period, higher frequencies, another torque "
            "or a larger experiment.max_settling_periods may help."
        )
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
            for row, (name, unit) in enumerate(quantities_of(joint))
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
        for row, (name, unit) in enumerate(quantities_of(joint)):
            numbers = (median[row, index], quantile[row, index], prediction.limits[row, index])
            cells = [f"{value:.3g}" for value in numbers] + [_percent(chance[row, index])]
            table.add_row(escape(joint.name) if row == 0 else "", name, unit, *cells)
        table.add_section()
    return table


def dry_run_lines(config: Config, shown: Prediction, run: DryRun) -> list[str]:
    """Explain the result in sentences, ending with the verdict."""
    lines = [
        "99 %: in 99 of 100 arms, all peaks stay within these values. Chance: probability that this quantity, taken "
        "alone, exceeds its limit; at a position or velocity limit the guard stops the arm, whereas current is only "
        "clamped.",
        settling_text(config, shown),
        *_stops(config, run.stopping),
        *(
            []
            if run.largest is None
            else [f"Largest safe torque: peak_torque = [{_list(run.largest.peak_torque)}] N m."]
        ),
    ]
    allowed = f"safety.limit_chance allows {100 * config.safety.limit_chance:g} %"
    if run.first is not None:
        return [*lines, *_first_lines(config, run.first, run.largest)]
    if run.asked is None:
        return [
            *lines,
            f"Safe at that torque: the probability of a guard stop is {_percent(shown.stop_chance)}; {allowed}.",
        ]
    word = "SAFE" if run.is_safe(config) else "NOT SAFE as configured"
    return [*lines, f"{word}: the probability of a guard stop is {_percent(shown.stop_chance)}; {allowed}."]


def _first_lines(config: Config, first: FirstRun, largest: Amplitude | None) -> list[str]:
    lines = []
    held = first.played.stabiliser
    if held is not None and config.stabiliser is None:
        lines.append(
            "The arm does not return to its rest pose by itself. The pilot proposes a stabiliser, simulated here: "
            f"stiffness = [{_list(np.array(held.stiffness), 3)}] N m/rad, damping = "
            f"[{_list(np.array(held.damping), 3)}] N m s/rad."
        )
    chance = _percent(first.prediction.stop_chance)
    starts = f"the first run of the pilot starts with peak_torque = [{_list(first.peak_torque, 3)}] N m"
    limits = "; ".join(
        f"{joint.name} {joint.position_limit[0]:.2f} to {joint.position_limit[1]:.2f}" for joint in first.played.joints
    )
    closer = f" and with narrower position limits ({limits} rad)" if first.is_narrowed(config) else ""
    if largest is None:
        return [
            *lines,
            "No torque is yet known to be safe for every arm throughout the experiment; the pilot will find one.",
            f"SAFE: {starts}{closer}. The guard would stop and brake {chance} of the simulated arms at these limits, "
            "and the pilot also learns from such stops.",
        ]
    return [
        *lines,
        f"SAFE: {starts}{closer}. Probability of a guard stop: {chance}. The pilot then raises the torque from run to "
        "run.",
    ]


def _list(values: Array, digits: int = 2) -> str:
    """Format values with `digits` decimals, small ones with two significant digits."""
    return ", ".join(f"{value:.{digits}f}" if value > 10.0 ** (1 - digits) else f"{value:.2g}" for value in values)


def _percent(chance: float) -> str:
    """Format a probability as a percentage. Positive values too small to be estimated from these arms become "below
    0.01 %".
    """
    if chance < 1e-8:
        return "0 %"
    return "below 0.01 %" if chance < 1e-4 else percent(chance)


def _stops(config: Config, stopping: Stopping) -> list[str]:
    planned, passed = stopping.planned, stopping.passed
    stopped, silent = np.maximum(planned[Way.BRAKED], planned[Way.CUT]), planned[Way.SILENT]
    lines = []
    if max(stopped.max(), silent.max()) < _NOTHING_RAD:
        lines.append(
            "Whenever the arm is stopped, no joint overshoots its limits, even if the program is killed or the cable "
            "unplugged."
        )
    else:
        lines += [
            f"Whenever the arm is stopped, {joint.name} overshoots its limits by {_far(stopped[index])}; if the "
            f"program is killed or the cable unplugged, by {_far(silent[index])}."
            for index, joint in enumerate(config.joints)
        ]
    lines += [
        f"If something drives {joint.name} past a limit at its predicted speed (99 %), the joint overshoots by "
        f"{_far(passed[Way.BRAKED][index])} when braked and by {_far(passed[Way.CUT][index])} when torque is cut."
        for index, joint in enumerate(config.joints)
    ]
    return [*lines, "Keep that much space clear."]


def _far(beyond: float) -> str:
    if beyond < _NOTHING_RAD:
        return "less than 0.01 rad"
    return "a turn or more" if beyond >= 2 * np.pi else f"up to {beyond:.2f} rad"
