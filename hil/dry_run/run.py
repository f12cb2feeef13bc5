"""Implementation of `hil dry-run`: simulate the experiment on an ensemble and find the largest safe torque."""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

from hil.config.chain import only_planar
from hil.config.schema import Config
from hil.dry_run.amplitude import largest_amplitude
from hil.dry_run.ensemble import Ensemble, earlier_result, prior_ensemble, result_ensemble
from hil.dry_run.prediction import predict
from hil.dry_run.stopping_distance import stopping_distance
from hil.dry_run.summary import DryRun
from hil.plan.plan import make_plan
from hil.plan.supply_speed import lowered, within_supply
from hil.setup.idle_bus import quiet_stream

ARMS = 128
SHOWN = 30
"""Number of arms whose motion is stored for the plot."""


def dry_run(
    config: Config,
    result: Path | None = None,
    arms: int = ARMS,
    servos: bool = False,
    executor: Executor | None = None,
) -> DryRun:
    """Simulate the configured experiment; `result` is a run folder or result.json of an earlier identification.

    Raises ConfigError, ResultError, RunFolderError, ExperimentError and, with `servos`, DriverError.
    """
    only_planar(config, "a dry run")
    ensemble = ensemble_of(config, result, arms)
    said = quiet_stream(config) if servos else ()
    given, config = config, within_supply(config)
    said += lowered(given, config)
    plan = None if config.experiment.peak_torque is None else make_plan(config)
    asked = None if plan is None else predict(config, plan, ensemble, shown=SHOWN, executor=executor)
    largest = largest_amplitude(config, ensemble, executor=executor)
    shown = predict(config, largest.plan, ensemble, shown=SHOWN, executor=executor) if asked is None else asked
    largest = replace(largest, prediction=shown) if asked is None else largest
    stopping = stopping_distance(config, plan or largest.plan, ensemble, shown.quantile[2].clip(max=shown.limits[2]))
    return DryRun(ensemble.source, ensemble.size, asked, largest, stopping, said)


def ensemble_of(config: Config, result: Path | None, arms: int) -> Ensemble:
    """Draw an ensemble from the earlier result, or from the prior if `result` is None.

    Raises ConfigError (also if the result is for another arm) and ResultError.
    """
    return prior_ensemble(config, arms) if result is None else result_ensemble(earlier_result(config, result), arms)
