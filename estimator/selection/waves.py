"""Periods of torque ripple and cogging: score tests of one number of cycles per turn after the other."""

from collections.abc import Sequence

import numpy as np

from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.fit.ripple import WAVES, Wave
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.selection.candidates import columns_of, simulated_run

COARSE = IntegrationOptions(max_step=2.6e-3, max_substeps=8)


def wave_cycles(
    period: SettledPeriod,
    estimate: Estimate,
    cycles: Sequence[float],
    waves: Sequence[Wave] = WAVES,
    only: Sequence[int] = (),
) -> dict[str, float]:
    """Return the numbers of `cycles` per turn for which each wave of each joint would explain most of the residual.

    What the fitted parameters explain is removed first. The result is by parameter name. Waves that the estimate's
    model includes are left out where they are sought.

    only: joints, from 1, that are considered; by default all.
    """
    used = without_spikes(period)
    run = simulated_run(used).integrated(COARSE)
    weight = np.where(np.isfinite(estimate.residual), 1.0 / period.noise[:, None], 0.0)
    places = [(wave, joint) for wave in waves for joint in only or range(1, period.joints + 1)]
    searched = {f"{wave}_{what}_{joint}": 0.0 for wave, joint in places for what in ("sin", "cos", "cycles")}
    known = estimate.parameters | searched
    fitted = tuple(name for name in estimate.names if name not in searched)
    columns, position = columns_of(run, Physics.of(known), estimate.start, fitted, weight)
    Q = np.linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
    residual = (weight * (run.measured - position)).reshape(-1)
    rest = residual - Q @ (Q.T @ residual)
    best: dict[str, tuple[float, float]] = {}
    names = tuple(f"{wave}_{part}_{joint}" for wave, joint in places for part in ("sin", "cos"))
    for each in cycles:
        given = {f"{wave}_cycles_{joint}": each for wave, joint in places}
        found, _ = columns_of(run, Physics.of({**known, **given}), estimate.start, names, weight)
        found = found[:, : len(names)] - Q @ (Q.T @ found[:, : len(names)])
        for place, name in enumerate(given):
            own = found[:, 2 * place : 2 * place + 2]
            fall = float(np.sum((np.linalg.qr(own)[0].T @ rest) ** 2))
            best[name] = max(best.get(name, (-1.0, 0.0)), (fall, each))
    return {name: most[1] for name, most in best.items()}
