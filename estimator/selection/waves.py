"""Periods of torque ripple and cogging, found by score tests of each number of cycles per turn."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.fit.ripple import WAVES, Wave
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.selection.candidates import columns_of, simulated_run

COARSE = IntegrationOptions(max_step=2.6e-3, max_substeps=8)
COMPARABLE = 0.3
"""Minimum decrease in the sum of squares, as a fraction of the largest, for other numbers of cycles to be tried too."""


@np.errstate(over="ignore", invalid="ignore")  # if the motion diverges with coarse steps
def wave_peaks(
    period: SettledPeriod,
    estimate: Estimate,
    cycles: Sequence[float],
    waves: Sequence[Wave] = WAVES,
    only: Sequence[int] = (),
) -> dict[str, tuple[float, ...]]:
    """Return the numbers of `cycles` per turn at which a wave explains more of the residual than at neighbouring
    numbers, best first.

    First, the components that the fitted parameters can explain are removed from the residual and the waves. The result
    is keyed by parameter name. If other terms have absorbed part of a wave, the best number may be wrong. Therefore
    other numbers are returned as well if they reduce the sum of squares by at least the fraction `COMPARABLE` of the
    best number's reduction.

    only: joints (from 1) to consider; by default all.
    """
    used = without_spikes(period)
    run = simulated_run(used).integrated(COARSE)
    weight = np.where(np.isfinite(estimate.residual), 1.0 / period.noise[:, None], 0.0)
    places = [(wave, joint) for wave in waves for joint in only or range(1, period.joints + 1)]
    searched = {f"{wave}_{what}_{joint}": 0.0 for wave, joint in places for what in ("sin", "cos", "cycles")}
    known = estimate.parameters | searched
    fitted = tuple(name for name in estimate.names if name not in searched)
    columns, position = columns_of(run, Physics.of(known), estimate.start, fitted, weight)
    Q = linalg.qr(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))[0]
    residual = (weight * (run.measured - position)).reshape(-1)
    rest = residual - Q @ (Q.T @ residual)
    falls: dict[str, list[float]] = {f"{wave}_cycles_{joint}": [] for wave, joint in places}
    names = tuple(f"{wave}_{part}_{joint}" for wave, joint in places for part in ("sin", "cos"))
    for each in cycles:
        given = {f"{wave}_cycles_{joint}": each for wave, joint in places}
        found, _ = columns_of(run, Physics.of({**known, **given}), estimate.start, names, weight)
        found = found[:, : len(names)] - Q @ (Q.T @ found[:, : len(names)])
        for place, name in enumerate(given):
            own = found[:, 2 * place : 2 * place + 2]
            falls[name].append(float(np.sum((linalg.qr(own)[0].T @ rest) ** 2)))
    return {name: _peaks(cycles, np.nan_to_num(fall)) for name, fall in falls.items()}


def ranked_cycles(peaks: Mapping[str, Sequence[float]], most: int) -> list[dict[str, float]]:
    """Return at most `most` combinations of cycles per turn, keyed by parameter name, best first.

    For each wave in `peaks`, the result of `wave_peaks`, the n-th combination takes the n-th best candidate or, if
    there are fewer, the last one.
    """
    ranks = min(most, max(map(len, peaks.values()), default=0))
    return [{name: each[min(rank, len(each) - 1)] for name, each in peaks.items()} for rank in range(ranks)]


def without_height(wave: Wave, joints: Iterable[int]) -> dict[str, float]:
    """Return zero amplitudes of a wave for `joints` (from 1), by parameter name."""
    return {f"{wave}_{part}_{joint}": 0.0 for part in ("sin", "cos") for joint in joints}


def _peaks(cycles: Sequence[float], falls: Array) -> tuple[float, ...]:
    """Return those `cycles` at which the decrease in the sum of squares has a local maximum, the largest first."""
    order = np.argsort(cycles)
    padded = np.concatenate(([-1.0], falls[order], [-1.0]))
    is_peak = (padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:])
    found = sorted(((float(falls[i]), float(cycles[i])) for i in order[is_peak]), reverse=True)
    return tuple(number for fall, number in found if fall >= COMPARABLE * found[0][0])
