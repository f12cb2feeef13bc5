"""Fit of a model whose terms are given, with the periods of its ripple and cogging searched twice.

The regression on Fourier lines (`hil.estimator.fit.ripple`) finds a wave's period as long as it explains the rest of
the motion. Encoder errors, cables and narrow Stribeck friction are not linear in its lines, and if they matter, the
search may end at a wrong period, from which no fit returns. The second search starts from a fit of all other terms.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.ripple import WAVES, Wave
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.candidates import candidates
from hil.estimator.selection.waves import ranked_cycles, wave_peaks

DEFAULTS = SelectionOptions()


def fit_given(
    period: SettledPeriod,
    model: Model,
    starts: Sequence[Mapping[str, float]] = (),
    options: SelectionOptions = DEFAULTS,
) -> Estimate:
    """Return the best fit of `model` to `period`.

    starts: additional initial guesses as in `hil.estimator.identify.identify`.
    Raises the errors of `identify`.
    """
    waves = [wave for wave in WAVES if wave in model.options]
    try:
        best = identify(period, model, starts=starts)
    except ConvergenceError:
        if not waves:
            raise
        best = None
    if best is not None and (not waves or _left(period, best) < options.presliding_residual):
        return best
    found = identify(period, model.without(*waves), starts=starts, coarse=True)
    for wave in waves:
        found = _with_wave(period, found, wave, options)
    if best is not None and not _left(period, found) < _left(period, best):
        return best
    return identify(period, model, near=Near(found.parameters, found.start))


def _with_wave(period: SettledPeriod, estimate: Estimate, wave: Wave, options: SelectionOptions) -> Estimate:
    """Return the best fit of the estimate's model with a wave, from its most likely numbers of cycles."""
    model = estimate.model.having(wave)
    peaks = wave_peaks(without_spikes(period), estimate, options.wave_cycles, (wave,))
    fits: list[Estimate] = []
    for known in ranked_cycles(peaks, options.max_wave_peaks):
        values = next(each.values for each in candidates(period, estimate, known) if each.part == wave)
        near = Near({**estimate.parameters, **values}, estimate.start)
        try:
            fits.append(identify(period, model, near=near, coarse=True))
        except ConvergenceError:
            continue
        if _left(period, fits[-1]) < options.explained_residual:
            break
    if not fits:
        raise ConvergenceError(f"no period of the {wave} leads to a minimum: try a simpler model")
    return min(fits, key=lambda each: _left(period, each))


def _left(period: SettledPeriod, estimate: Estimate) -> float:
    """Return the RMS of the residual in units of the noise."""
    return float(np.sqrt(np.nanmean((estimate.residual / period.noise[:, None]) ** 2)))
