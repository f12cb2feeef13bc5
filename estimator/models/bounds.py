"""Parameters at a bound of their range, although the data favour values beyond it.

A fit cannot leave the physical range. If the best value lies outside, the fit stops at the bound, the other parameters
absorb the difference, and the standard errors do not show this. A parameter whose true value is zero, such as the
Stribeck term of a joint without Stribeck friction, also ends at its bound but does no harm. The undamped step of the
normal equations, expressed in the parameters themselves, distinguishes the two cases.
"""

from collections.abc import Sequence

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.models.terms import kind_of, term_of

SURE = 3.0  # standard errors by which the best value must lie outside the range
NEAR = 0.1  # distance from the bound, relative to the step beyond it, within which a fit counts as at the bound
FAINTEST = 1e-140  # the square of any smaller influence of a coordinate underflows
MOVED = 1.0  # standard errors by which the bound must shift another parameter for that parameter to count as affected


def scaled_inverse(normal: Array) -> tuple[Array, Array]:
    """Return the pseudo-inverse of a normal matrix (coordinates, coordinates) in which each coordinate is divided by
    its own scale, and these scales (coordinates,).

    The scale of a parameter that has fallen to zero is many orders of magnitude smaller than those of the others.
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 0.0))
    scale = np.where(scale > FAINTEST, scale, 1.0)
    return linalg.pinv(normal / np.outer(scale, scale), rcond=1e-13, hermitian=True), scale


def step_beyond(normal: Array, gradient: Array, slopes: Array) -> tuple[Array, Array]:
    """Return the undamped step of the parameters (parameters,) [SI] without bounds, and its standard errors.

    The standard errors are those for independent errors with variance 1. normal (coordinates, coordinates), gradient
    (coordinates,): normal matrix and gradient of the sum of squares. slopes: derivatives of the parameters with respect
    to their coordinates (parameters, parameters); these come before all other coordinates.
    """
    inverse, scale = scaled_inverse(normal)
    count = len(slopes)
    step = -(inverse @ (gradient / scale))[:count] / scale[:count]
    covariance = (inverse / np.outer(scale, scale))[:count, :count]
    std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", slopes, covariance, slopes), 0.0))
    return np.asarray(slopes @ step), np.asarray(std)


def beyond_range(value: Array, step: Array, std: Array, lower: Array, upper: Array) -> Mask:
    """Return which parameters (parameters,) are at a bound, `lower` or `upper`, although the data favour values beyond
    it.

    std: standard errors for independent errors. If they were widened for the misfit, a parameter whose bound causes the
    misfit would go unnoticed.
    """
    best, near = value + step, NEAR * np.abs(step)
    below: Mask = (best < lower - SURE * std) & (value - lower <= near)
    above: Mask = (best > upper + SURE * std) & (upper - value <= near)
    return below | above


def finite_std(std: Array, white: Array) -> Array:
    """Return the standard errors `std` (parameters,), with infinite values (as at a bound) replaced by finite ones.

    white: standard errors for independent errors. They replace infinite ones after being widened by the median factor
    of the other parameters.
    """
    known = np.isfinite(std) & (white > 0.0)
    wider = float(np.median(std[known] / white[known])) if known.any() else 1.0
    finite: Array = np.where(np.isfinite(std), std, wider * white)
    return finite


def matters(names: tuple[str, ...], beyond: Mask, step: Array, std: Array) -> bool:
    """Return whether parameters at their bounds affect the base parameters.

    They do if a base parameter other than an offset is at its bound (`beyond`), or would change by more than its
    standard error `std` without the bounds. `std` includes the misfit, which a bound may itself have caused.
    """
    base = np.array([term_of(name).part == "base" and kind_of(name) != "offset" for name in names])
    return bool(beyond[base].any() or np.any(np.abs(step[base]) > MOVED * std[base]))


def bound_sentence(names: Sequence[str]) -> str:
    """Return a sentence about parameters at a bound; empty if there are none."""
    if not names:
        return ""
    late = any(kind_of(name) == "back_emf" for name in names)
    cause = (
        "The lagging back-EMF already cancels as much of the joint's inertia as is physically possible, so the inertia "
        "and the lag may be wrong: check the joint's mode and servo model, and whether anything else delays its torque"
        if late
        else "This is due to an effect missing from the model or to too little motion, and it distorts other values: "
        "use wider and faster motion, and look for a cause among the findings above"
    )
    it, its = ("are", "their") if len(names) > 1 else ("is", "its")
    return f"{', '.join(names)} {it} at {its} bound, although the data favour values beyond it. {cause}."
