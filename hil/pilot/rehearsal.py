"""`hil dry-run` for a planar arm with `pilot = true`: what `hil identify` would do.

The first run and the largest safe torque are simulated, both with the stabiliser that `hil identify` would propose.
"""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from hil.config.chain import only_planar
from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude, largest_amplitude
from hil.dry_run.ensemble import Ensemble, earlier_result
from hil.dry_run.prediction import predict
from hil.dry_run.run import SHOWN, ensemble_of
from hil.dry_run.stopping_distance import stopping_distance
from hil.dry_run.summary import DryRun, FirstRun
from hil.errors import NoSafeTorque
from hil.pilot.search import Search
from hil.pilot.steps import Player
from hil.plan.supply_speed import lowered, within_supply
from hil.runs.run_folder import RunFolder
from hil.setup.idle_bus import quiet_stream


def rehearse_in_steps(
    config: Config, result: Path | None, arms: int, servos: bool = False, executor: Executor | None = None
) -> DryRun:
    """Simulate what `hil identify` would do; `result` is a run folder or result.json of an earlier identification.

    Raises ConfigError, ResultError, RunFolderError, NoSafeTorque (only if `hil identify` would raise it too) and, with
    `servos`, DriverError.
    """
    only_planar(config, "a dry run")
    ensemble = ensemble_of(config, result, arms)
    said = quiet_stream(config) if servos else ()
    given, config = config, within_supply(config)
    said += lowered(given, config)
    earlier = None if result is None else earlier_result(config, result)
    # Nothing is run, so the folder and the player are never used.
    player = Player(config.path, lambda _: None, lambda _: None)
    search = Search.of(config, RunFolder(config.path.parent), player, earlier=earlier)
    held = search.held
    played, first = search.first_run()
    likely = predict(played, first.plan, ensemble, shown=SHOWN, executor=executor)
    start = FirstRun(first.peak_torque, likely, played)
    largest = _largest(held, ensemble, executor)
    shown, plan = (likely, first.plan) if largest is None else (largest.prediction, largest.plan)
    stopping = stopping_distance(held, plan, ensemble, shown.quantile[2].clip(max=shown.limits[2]))
    return DryRun(ensemble.source, ensemble.size, None, largest, stopping, said, start)


def _largest(held: Config, ensemble: Ensemble, executor: Executor | None) -> Amplitude | None:
    """The largest torque that is safe for every arm; None if no torque is, in which case only a pilot can find one."""
    try:
        found = largest_amplitude(held, ensemble, executor=executor)
    except NoSafeTorque:
        return None
    return replace(found, prediction=predict(held, found.plan, ensemble, shown=SHOWN, executor=executor))
