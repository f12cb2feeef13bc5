"""Fit of a model with given terms, including two searches for the periods of its ripple and cogging.

The regression on Fourier coefficients (`hil.estimator.fit.ripple`) finds a wave's period if all other effects are
modelled well. The linear regression cannot represent encoder errors, cables or narrow Stribeck friction. If these
matter, the search may end at a wrong period. Therefore a second search starts from a fit of all other terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.ripple import WAVES, Wave
from hil.estimator.fit.stage2 import Near
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.models.terms import FRICTIONS
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.candidates import SMOOTH
from hil.estimator.selection.restarts import left_over
from hil.estimator.selection.waves import ranked_cycles, wave_peaks, without_height

DEFAULTS = SelectionOptions()


def fit_given(
    period: SettledPeriod,
    model: Model,
    starts: Sequence[Mapping[str, float]] = (),
    options: SelectionOptions = DEFAULTS,
) -> Estimate:
    """Return the best fit of `model` to `period`.

    starts: additional initial guesses as in `hil.estimator.identify.identify`.
    Raises the same errors as `identify`.
    """
    waves = [wave for wave in WAVES if wave in model.options]
    try:
        best = identify(period, model, starts=starts)
    except ConvergenceError:
        if not waves:
            raise
        best = None
    if best is not None and (not waves or left_over(period, best) < options.presliding_residual**2):
        return best
    found = identify(period, model.without(*waves), starts=starts, coarse=True)
    for wave in waves:
        found = _with_wave(period, found, wave, starts, options)
    if best is not None and not left_over(period, found) < left_over(period, best):
        return best
    return identify(period, model, near=Near(found.parameters, found.start))


def _with_wave(
    period: SettledPeriod,
    estimate: Estimate,
    wave: Wave,
    starts: Sequence[Mapping[str, float]],
    options: SelectionOptions,
) -> Estimate:
    """Return the best fit of the estimate's model with `wave` added, starting from the most likely numbers of cycles
    per turn.

    A wave is most visible in the residual of the fit that explains the most, even if the terms of that fit partly
    imitate the wave; such a fit is used only for the search.
    """
    model, joints = estimate.model.having(wave), range(1, estimate.model.joints + 1)
    rich = replace(estimate.model, friction=FRICTIONS[-1]).having("zeros", *SMOOTH)
    about = identify(period, rich, starts=starts, coarse=True)
    peaks = wave_peaks(without_spikes(period), about, options.wave_cycles, (wave,))
    fits: list[Estimate] = []
    for known in ranked_cycles(peaks, options.max_wave_peaks):
        near = Near({**estimate.parameters, **without_height(wave, joints), **known}, estimate.start)
        try:
            fits.append(identify(period, model, near=near, coarse=True))
        except ConvergenceError:
            continue
        if left_over(period, fits[-1]) < options.presliding_residual**2:
            break
    if not fits:
        raise ConvergenceError(f"the fit did not converge for any period of the {wave}: try a simpler model")
    return min(fits, key=lambda each: left_over(period, each))
