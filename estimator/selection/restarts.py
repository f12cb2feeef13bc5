"""Other initial guesses for an estimate that may be at a local minimum.

The likelihood has several minima in parameters that matter only in a narrow range: the width of the Coulomb step, the
stiffness of bristles, and the periods of torque ripple and cogging.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.reparametrisation import LEAST_RISE
from hil.estimator.fit.ripple import WAVES, Wave
from hil.estimator.identify import Estimate
from hil.estimator.models.terms import term_of
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.waves import ranked_cycles, wave_peaks, without_height

ALIKE_STIFFNESS = 3.0  # ratio of two stiffnesses below which no minimum is expected between them
WIDE = 0.5  # ratio of Coulomb step width to Stribeck velocity above which the two cannot be separated
NARROW = 1e-3  # rad/s: initial width of a step that replaces a Stribeck rise
ALIKE_CYCLES = 0.3  # difference in cycles per turn below which no other minimum is expected


def left_over(period: SettledPeriod, estimate: Estimate) -> float:
    """Return the mean square of the residual, in units of the noise."""
    return float(np.nanmean((estimate.residual / period.noise[:, None]) ** 2))


def left_per_joint(period: SettledPeriod, estimate: Estimate) -> Array:
    """Return the mean square of each joint's residual (joints,), in units of the noise."""
    left: Array = np.nanmean((estimate.residual / period.noise[:, None]) ** 2, axis=1)
    return left


def restarts(period: SettledPeriod, estimate: Estimate, options: SelectionOptions) -> Iterator[Mapping[str, float]]:
    """Yield modified parameters, by name, from which another minimum may be reached, those of the worst joint first.

    Only joints whose residual exceeds `options.presliding_residual` are changed.
    """
    left = left_per_joint(period, estimate)
    for joint in np.argsort(-left) + 1:
        if left[joint - 1] > options.presliding_residual**2:
            for wave in WAVES:
                yield from _other_wave(period, estimate, int(joint), options, wave)
            yield from _standstill(estimate, int(joint), options)


def undisguised(estimate: Estimate) -> dict[str, float]:
    """Return modified parameters, by name, for joints whose Stribeck rise may really be a narrow Coulomb step.

    A rise that fades within a wide step resembles a narrow step without a rise, but a fit started from one does not
    reach the other.
    """
    values: dict[str, float] = estimate.parameters
    changed: dict[str, float] = {}
    for joint in range(1, estimate.model.joints + 1):
        rise, velocity, width = (f"{name}_{joint}" for name in ("stribeck_rise", "stribeck_velocity", "coulomb_width"))
        if {rise, width} <= values.keys() and values[rise] > LEAST_RISE and values[width] > WIDE * values[velocity]:
            changed |= {rise: LEAST_RISE, velocity: term_of(velocity).initial, width: NARROW}
    return changed


def _other_wave(
    period: SettledPeriod, estimate: Estimate, joint: int, options: SelectionOptions, wave: Wave
) -> Iterator[Mapping[str, float]]:
    name = f"{wave}_cycles_{joint}"
    if name not in estimate.names:
        return
    (found,) = ranked_cycles(wave_peaks(period, estimate, options.wave_cycles, (wave,), (joint,)), 1)
    if abs(found[name] - estimate.parameters[name]) > ALIKE_CYCLES:
        yield found | without_height(wave, (joint,))


def bristles(estimate: Estimate, bend: float) -> list[dict[str, float]]:
    """Return presliding parameters of each joint, by name, for bristles that slip when deflected by `bend` [rad]."""
    parameters = estimate.parameters
    return [
        {
            f"presliding_stiffness_{joint}": parameters[f"coulomb_{joint}"] / bend,
            f"presliding_damping_{joint}": parameters[f"viscous_{joint}"],
        }
        for joint in range(1, estimate.model.joints + 1)
    ]


def _standstill(estimate: Estimate, joint: int, options: SelectionOptions) -> Iterator[Mapping[str, float]]:
    parameters = estimate.parameters
    stiffness, width = f"presliding_stiffness_{joint}", f"coulomb_width_{joint}"
    if stiffness in estimate.names:
        for bend in options.initial_bends:
            guess = bristles(estimate, bend)[joint - 1]
            if abs(np.log(guess[stiffness] / parameters[stiffness])) > np.log(ALIKE_STIFFNESS):
                yield guess
    elif width in estimate.names:
        for initial in options.initial_widths:
            yield {width: initial}
