"""`hil identify` on the bundled spatial arms, from URDF, limits and rest pose alone, including the pilot.

    python benchmarks/spatial/chain_arms.py [--arm koch] [--json]

For each: trust, residual in encoder steps, held-out error, coverage of the 95 % intervals, arm time and
processor time, least clearance and largest overshoot of a position limit over all recordings, and the ratio of the
worst relative standard error of the designed path to that of random paths.
"""

import argparse
import json
import resource
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import hil
from hil.clearance.space import Space
from hil.config.schema import Config, load_config
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config
from hil.runs.recording import Phase, load_samples

ARMS = ("leg", "open_manipulator_x", "koch", "wx250s", "viperx_300")
PLAIN = 5


def measured(config: Config, run: Path) -> dict[str, float]:
    """Over all recordings in a run folder: duration [s], least clearance outside the rest pose [m], and largest
    overshoot of a position limit [rad]."""
    space = Space.of(config)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    seconds, nearest, excess = 0.0, np.inf, -np.inf
    for path in run.rglob("samples.npy"):
        samples = load_samples(path, len(config.joints))
        q = samples["position"][np.isfinite(samples["position"]).all(axis=1)].T
        seconds += float(samples["deadline"][-1] - samples["deadline"][0])
        away = q[:, ~space.lies(q)][:, ::4]
        if away.shape[1]:
            nearest = min(nearest, space.nearest(away, on_the_way=True).distance)
        excess = max(excess, float(np.maximum(low - q.min(axis=1), q.max(axis=1) - high).max()))
        assert (samples["phase"] != Phase.NOT_RECORDED).all()
    return {"arm_seconds": round(seconds, 1), "least_m": round(float(nearest), 4), "excess_rad": round(excess, 4)}


def over_plain(config: Config) -> float:
    """Ratio of the designed path's worst relative standard error to the median of random ones, same limits and time."""
    config = chain_config(config)
    paths = Paths.of(config, ChainBelief.prior(config).torque)
    return float(
        paths.identify.worst
        / np.median([paths.designer.plain(paths.identify.centre, seed).worst for seed in range(PLAIN)])
    )


def identified(name: str) -> dict[str, Any]:
    """One arm."""
    config = load_config(Path(name))
    before = resource.getrusage(resource.RUSAGE_SELF)
    with tempfile.TemporaryDirectory() as folder:
        found = hil.identify(config, out=Path(folder) / "run")
        after = resource.getrusage(resource.RUSAGE_SELF)
        recorded = measured(config, found.run)
    truth = found.truth or {}
    away = np.array([abs(each.value - truth[key]) / each.std for key, each in found.parameters.items()])
    return {
        "trust": found.verdict.trust,
        "steps": len(found.steps or ()),
        "residual_ticks": round(max(found.fit.residual_rms_ticks), 3),
        "held_out_percent": round(100 * max(found.validation.held_out_rms or (np.nan,)), 3),
        "coverage_95": round(float((away < 1.96).mean()), 3),
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
