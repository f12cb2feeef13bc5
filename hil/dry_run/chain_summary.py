"""Result of a spatial arm's dry run as a table, text and JSON."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.clearance.doubts import doubts, near_by_design
from hil.clearance.space import Space
from hil.config.schema import Config
from hil.dry_run.chain_prediction import ChainPrediction
from hil.dry_run.chain_stop import LAID_DOWN, ChainStops
from hil.dry_run.prediction import GUARDED, QUANTITIES, Prediction, quantities_of
from hil.dry_run.summary import joints_json
from hil.printing import print_fitting, say


@dataclass(frozen=True)
class ChainDryRun:
    """A dry run of a spatial arm.

    config: configuration with the path and stabiliser that would be used. share: fraction of the designed path's
    amplitude; 1 if [joint_path] gives the path. shapes_guessed: links without readable geometry. as_built: pairs of
    links with parts that are not checked, because they are closer than the margin in nearly every pose. refused: why
    the pilot has no safe first step; "" if it has one; None if there is no pilot. The pilot's decision overrides the
    prediction. on_stops: sentence that names the joints assumed to rest against their end stops; "" if there are none.
    """

    config: Config
    source: str
    arms: int
    share: float
    foreseen: ChainPrediction
    stops: ChainStops
    shapes_guessed: tuple[str, ...]
    as_built: tuple[tuple[str, str], ...]
    servos: tuple[str, ...]
    refused: str | None = None
    on_stops: str = ""

    @property
    def prediction(self) -> Prediction:
        """Predicted peaks of the planned motion and their limits."""
        return self.foreseen.peaks

    @property
    def peak_torque(self) -> tuple[float, ...]:
        """Median over the arms of each joint's largest torque [N m]."""
        return tuple(float(value) for value in self.prediction.median[QUANTITIES.index("torque")])

    def is_safe(self, config: Config) -> bool:
        """Whether every arm keeps its clearance and the guard is unlikely to stop any of them."""
        return not self.why_not(config)

    def why_not(self, config: Config) -> str:
        """Explain why the motion, or stopping during it, is not safe; "" if both are safe."""
        return self.doubt(config) if self.refused is None else self.refused

    def doubt(self, config: Config) -> str:
        """Explain why simulated arms would move or stop unsafely; "" if none would."""
        return unsafe(config, self.foreseen) or ("" if config.safety.stop == "cut" else self.stops.unsafe)


def unsafe(config: Config, foreseen: ChainPrediction) -> str:
    """Explain why a motion is not safe; "" if it is."""
    peaks = foreseen.peaks
    if not foreseen.is_clear:
        return f"too little clearance, {foreseen}"
    if (peaks.shares[:, :GUARDED] >= 1.0).any() or peaks.stop_chance > config.safety.limit_chance:
        row, joint = nearest_limit(peaks)
        chance = config.safety.limit_chance
        reached, limit = peaks.exceeding(chance)[row, joint], peaks.limits[row, joint]
        how_often = f"more often than safety.limit_chance allows ({100 * chance:g} %)"
        if reached == peaks.quantile[row, joint]:
            how_often = "in 1 of 100 arms"
        name = config.joints[joint].name
        return f"joint {name!r} reaches {QUANTITIES[row]} {reached:.3g} (limit {limit:.3g}) {how_often}"
    return ""


def nearest_limit(peaks: Prediction) -> tuple[int, int]:
    """Return the indices of the quantity (in QUANTITIES) and the joint whose limit the arms are most likely to
    reach.
    """
    touched = (peaks.shares[:, :GUARDED] >= 1.0).any(axis=0)
    chance = peaks.limit_chance[:GUARDED]
    row, joint = np.unravel_index(int(np.argmax(touched + chance)), chance.shape)
    return int(row), int(joint)


def chain_dry_run_json(run: ChainDryRun) -> dict[str, Any]:
    """Return the JSON object: verdict, clearance, stops, and every predicted quantity per joint."""
    config, peaks, fall, lowering = run.config, run.prediction, run.stops.fall, run.stops.lowering
    return {
        "schema": 1,
        "config": str(config.path),
        "source": run.source,
        "arms": run.arms,
        "safe": run.is_safe(config),
        "why_not": run.why_not(config) or None,
        "limit_chance": config.safety.limit_chance,
        "share_of_designed_path": run.share,
        "guard_stop_chance": peaks.stop_chance,
        "clearance": {
            "least_m": round(run.foreseen.nearest.distance, 4),
            "needed_m": round(run.foreseen.nearest.needed, 4),
            "between": list(run.foreseen.nearest.pair),
            "role": run.foreseen.role,
            "time_s": round(run.foreseen.moment, 2),
            "shapes_guessed": list(run.shapes_guessed),
            "touch_as_built": [list(pair) for pair in run.as_built],
            "near_as_built": [list(pair) for pair in Space.of(config).near],
        },
        "lowering": {
            "longest_s": round(lowering.seconds, 2),
            "least_m": round(min(lowering.nearest.distance, 1e3), 4),
            "between": list(lowering.nearest.pair),
            "lies_share": lowering.lies,
        },
        "fall": {
            "from_s": round(fall.moment, 2),
            "after_s": round(fall.seconds, 2),
            "hits": None if fall.hits is None else list(fall.hits),
            "height_m": round(fall.height, 3),
            "speed_m_s": round(fall.speed, 2),
            "beyond_limits_rad": [round(float(value), 3) for value in fall.beyond],
        },
        "joints": joints_json(config, peaks),
        "assumed_on_own_stops": run.on_stops or None,
        "servos": list(run.servos),
    }


def print_chain_dry_run(run: ChainDryRun, console: Console) -> None:
    print_fitting(console, _table(run))
    for line in (*run.servos, *chain_dry_run_lines(run)):
        say(console, line)


def _table(run: ChainDryRun) -> Table:
    peaks = run.prediction
    table = Table(
        title=f"Dry run of {escape(run.config.path.name)}, {run.arms} arms drawn from the {run.source}",
        title_justify="left",
    )
    for heading in ("joint", "predicted peak", "unit"):
        table.add_column(heading)
    for heading in ("median", "99 %", "limit"):
        table.add_column(heading, justify="right")
    median, quantile = peaks.median, peaks.quantile
    for index, joint in enumerate(run.config.joints):
        for row, (name, unit) in enumerate(quantities_of(joint)):
            numbers = (median[row, index], quantile[row, index], peaks.limits[row, index])
            table.add_row(escape(joint.name) if row == 0 else "", name, unit, *(f"{value:.3g}" for value in numbers))
        table.add_section()
    return table


def chain_dry_run_lines(run: ChainDryRun) -> list[str]:
    """Explain the result in sentences, ending with the verdict."""
    fall, lowering, why = run.stops.fall, run.stops.lowering, run.why_not(run.config)
    hit = "it hits nothing" if fall.hits is None else f"{fall.hits[0]} hits {fall.hits[1]}"
    when = "within" if fall.hits is None else "after"
    lines = [
        "99 %: in 99 of 100 arms, all peaks stay within these values.",
        f"Least clearance: {run.foreseen}.",
        f"When stopped, the arm is lowered within {lowering.seconds:.1f} s; {100 * lowering.lies:.0f} % of the "
        f"simulated stops reach the rest pose (at least {100 * LAID_DOWN:.0f} % are required); smallest clearance on "
        f"the way: {lowering.nearest}.",
        f"Without commands (cable unplugged, program killed, servo failed) the arm falls. Worst fall, starting "
        f"{fall.moment:.1f} s into the path: {hit} {when} {fall.seconds:.2f} s; largest drop "
        f"{100 * fall.height:.0f} cm, final speed {fall.speed:.1f} m/s.",
    ]
    lines += near_by_design(Space.of(run.config))
    if run.on_stops:
        lines.append(run.on_stops)
    lines += [f"Warning: {doubt}" for doubt in doubts(run.config)]
    if run.share < 1.0:
        lines.append(
            f"The pilot would start with the designed path at {100 * run.share:.0f} % of its amplitude, as shown here."
        )
    if run.refused == "" and (doubt := run.doubt(run.config)):
        lines.append(
            f"hil identify bases its decision on fewer arms. With all {run.arms}, the experiment is not safe: {doubt}."
        )
    return [*lines, f"NOT SAFE: {why.rstrip('.')}." if why else "SAFE. Not tested on hardware."]
