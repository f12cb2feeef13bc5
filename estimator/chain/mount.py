"""Does a spatial arm's motion agree with its description, or would it if the base were mounted in another way?

If gravity is assumed to act in the wrong direction, the centres of mass come out on the wrong side of the joints. The
motion alone may not show it: an arm with one joint moves in the same way if both gravity and its link are reversed. The
description shows it, since it says on which side the mass is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import kind_of
from hil.estimator.chain.fit.stage1 import fit_lines
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.geometry import directions_of_gravity
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.recordings import regression, relative_residual
from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.errors import EstimationError

MOMENTS = ("moment_x", "moment_y", "moment_z")
SURE = 4.0  # default number of standard errors by which a moment must differ from zero
LIKELY = 1.0  # the same, if another direction of gravity would agree with the description
CLEAR = 0.9
"""Described moment, relative to its uncertainty, above which its sign is taken as known: the described centre of mass
is about 2 cm or more away from the axis.
"""
OPPOSITE = 0.3  # of a described moment: size of a moment of the opposite sign that contradicts it

CLOSER, LESS = 3.0, 2.0
"""Another direction of gravity is preferred if it divides the squared distance to the description by at least `CLOSER`
and reduces it by at least `LESS`, in squares of the description's uncertainty.
"""
AS_GOOD = 0.02  # permitted mean increase of the logarithm of a joint's torque residual under another direction

Fit = Callable[[ChainModel, Prior], tuple[Array, Array]]
"""A regression: values of `ChainModel.linear_names` [SI], and the joints' relative torque residuals."""


@dataclass(frozen=True)
class Opposed:
    """A moment whose sign is opposite to that of the described one. link: counted from 1. All values in kg m."""

    name: str
    value: float
    std: float
    expected: float

    @property
    def link(self) -> int:
        return int(self.name.rpartition("_")[2])


@dataclass(frozen=True)
class Agreement:
    """How one direction of gravity suits the recording and the description.

    gravity: in the base's frame (3,) [m/s^2]. residual: mean logarithm of the joints' relative torque residuals.
    worst: largest of these residuals. distance: sum of squared deviations of the base parameters from the description,
    in units of its uncertainty.
    """

    gravity: Array
    residual: float
    worst: float
    distance: float


def opposed_moments(
    names: tuple[str, ...], value: Array, std: Array, prior: Prior, sure: float = SURE
) -> tuple[Opposed, ...]:
    """Return the moments that contradict the description in sign; `names` begins with the base parameters.

    sure: number of standard errors by which a moment must differ from zero.
    """
    found = []
    expected = prior.value.tolist()
    parts = zip(names, value.tolist(), std.tolist(), expected, prior.std.tolist(), strict=False)
    for name, each, error, described, spread in parts:
        if kind_of(name) not in MOMENTS or abs(described) < CLEAR * spread:
            continue
        if each / described < -OPPOSITE and abs(each) > sure * error:
            found.append(Opposed(name, each, error, described))
    return tuple(found)


def better_gravity(period: SettledPeriod, model: ChainModel, links: Array) -> Array | None:
    """Return the direction of gravity with which a run agrees with the description, although it does not with the
    assumed direction; None if there is no such direction.

    The result is gravity in the base's frame (3,) [m/s^2]: along one of its axes, or opposite to the assumed one.
    links: described link parameters (joints, 10) [SI].
    """
    used = without_spikes(period)

    def fit(tried: ChainModel, prior: Prior) -> tuple[Array, Array]:
        found = fit_lines([used], tried, prior)
        return found.value, found.relative_residual

    better = _better(fit, model, links)
    return None if better is None else better.gravity


def better_gravity_recorded(recordings: Sequence[Recording], model: ChainModel, links: Array) -> Agreement | None:
    """Return the same for recordings of arbitrary motion, and how well it suits them."""

    def fit(tried: ChainModel, prior: Prior) -> tuple[Array, Array]:
        value, _, cutoff = regression(recordings, tried, prior)
        return value, relative_residual(recordings, tried, value, cutoff)

    return _better(fit, model, links)


def _better(fit: Fit, model: ChainModel, links: Array) -> Agreement | None:
    assumed = model.base.chain.gravity
    try:
        here = _agreement(fit, model, links, assumed)
        others = [_agreement(fit, model, links, each) for each in directions_of_gravity(assumed)]
    except EstimationError:
        return None
    as_good = [each for each in others if each.residual <= here.residual + AS_GOOD]
    if not as_good:
        return None
    best = min(as_good, key=lambda each: each.distance)
    nearer = here.distance - best.distance >= LESS and here.distance >= CLOSER * best.distance
    return best if nearer else None


def _agreement(fit: Fit, model: ChainModel, links: Array, gravity: Array) -> Agreement:
    chain = replace(model.base.chain, gravity=gravity)
    base = BaseParameters.of(chain, tilts=model.base_tilt)
    prior = Prior.of(base, links)
    value, relative_residual = fit(replace(model, base=base), prior)
    away = (value[: base.count] - prior.value) / prior.std
    return Agreement(
        gravity, float(np.log(relative_residual).mean()), float(relative_residual.max()), float(away @ away)
    )
