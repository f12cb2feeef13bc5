"""`hil identify`, including the pilot, on the bundled spatial arms, given only URDF, limits and rest pose.

    python benchmarks/spatial/chain_arms.py [--arm koch] [--json]

Figures for each arm: trust, residual in encoder steps, held-out error, torque error and coverage of the 95 % intervals
(see chain_population.py; both in units of joint 1's torque), arm time, processor time, and least clearance and largest
overshoot of a position limit over all recordings. The last figure is the worst relative standard error of the designed
path, divided by that of random paths.
"""

import argparse
import json
import resource
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

import hil
from benchmarks.spatial.judgement import judged, measured
from hil.config.schema import Config, load_config
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config

ARMS = ("leg", "open_manipulator_x", "koch", "wx250s", "viperx_300")
PLAIN = 5


def over_plain(config: Config) -> float:
    """Worst relative standard error of the designed path, divided by the median for random paths with equal limits."""
    config = chain_config(config)
    paths = Paths.of(config, ChainBelief.prior(config).torque)
    return float(
        paths.identify.worst
        / np.median([paths.designer.plain(paths.identify.centre, seed).worst for seed in range(PLAIN)])
    )


def identified(name: str) -> dict[str, Any]:
    """Identify one bundled arm; return its figures."""
    config = load_config(Path(name))
    before = resource.getrusage(resource.RUSAGE_SELF)
    with tempfile.TemporaryDirectory() as folder:
        found = hil.identify(config, out=Path(folder) / "run")
        after = resource.getrusage(resource.RUSAGE_SELF)
        recorded = measured(config, found.run)
    return {
        "trust": found.verdict.trust,
        "steps": len(found.steps or ()),
        "residual_ticks": round(max(found.fit.residual_rms_ticks), 3),
        "held_out_percent": round(100 * max(found.validation.held_out_rms or (np.nan,)), 3),
        **judged(config, found),
        "cpu_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        **recorded,
        "optimised_over_plain": round(over_plain(config), 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--arm", choices=ARMS, action="append")
    parser.add_argument("--json", action="store_true", help="print only one JSON object for all arms, at the end")
    options = parser.parse_args()
    rows = {}
    for name in options.arm or ARMS:
        rows[name] = identified(name)
        if not options.json:
            print(name, *(f"{key} {value}" for key, value in rows[name].items()), sep="  ", flush=True)
    if options.json:
        print(json.dumps({"arms": rows}))


if __name__ == "__main__":
    main()
