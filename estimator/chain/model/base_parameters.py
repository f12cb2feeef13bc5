"""Base parameters of a chain: the parameter combinations that torque and motion determine.

The columns of the regressor for random motions are processed one by one, from the base outwards and, within a link, in
the order first moments, inertias, rotor, mass. A column that depends linearly on the previous ones adds no information:
its parameter is lumped into theirs (Gautier, Journal of Robotic Systems 8 (1991) 485). In this order the sums stay
short, such as `moment_x_3 + 0.124 mass_4`, since a link's mass acts like a moment of the previous link.

Columns that are nearly dependent are considered after all others, the least dependent first. Otherwise, the sums would
have large terms that nearly cancel.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.model.dynamics import TERMS, Columns, regressor
from hil.estimator.chain.model.geometry import Chain, parameter_names, unit_of
from hil.estimator.chain.model.tilt import GENERIC, tilted

ORDER = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 0)  # order of a link's parameters: moments, inertias, armature, mass
SAMPLES = 150
KINDS = (slice(1, 4), slice(4, 10), slice(10, 11), slice(0, 1))  # moments, inertias, armature, mass
CLEARLY_INDEPENDENT = 0.1
"""A column is kept immediately if its unexplained part has a norm above this value.

The unexplained part is what remains after the columns kept so far have been fitted to the column. Its norm is relative
to the largest column of the same link and kind.
"""
INDEPENDENT = 2e-3
"""A remaining column is kept if its unexplained part (see CLEARLY_INDEPENDENT) has a norm above this value.

Rounded angles such as 1.57 or 1.5708 in a description give every parameter a tiny separate effect. No recording could
determine a parameter from such an effect.
"""
LEAST_FACTOR = 1e-7  # smaller factors in a sum are taken as 0
NOTHING = 1e-9


@dataclass(frozen=True)
class BaseParameters:
    """The base parameters of a chain.

    Each base parameter is a combination of parameters, and is named after the parameter that remains if all others are
    zero.
    """

    chain: Chain
    columns: Columns
    """Indices of the base parameters in `parameter_names` (base parameters,)."""
    grouping: Array
    """Matrix from all parameters to base parameters (base parameters, all)."""

    @classmethod
    def of(cls, chain: Chain, seed: int = 1, *, tilts: bool = False) -> "BaseParameters":
        """Return the base parameters of this chain.

        tilts: allow for a tilted base, that is, for any direction of gravity. Gravity may then also act on a first
        joint with a vertical axis, so there are more base parameters.
        """
        anywhere = replace(chain, gravity=tilted(chain.gravity, *GENERIC)) if tilts else chain
        Y = _random_regressor(anywhere, seed)
        norm = np.linalg.norm(Y, axis=0)
        order = [TERMS * link + term for link in range(chain.joints) for term in ORDER]
        columns = _independent(Y / np.maximum(_norms_by_kind(norm), NOTHING * norm.max()), order)
        grouping = linalg.lstsq(Y[:, columns] / norm[columns], Y, rcond=None)[0] / norm[columns][:, None]
        grouping[np.abs(grouping) < LEAST_FACTOR] = 0.0
        return cls(chain, columns, np.round(grouping, 13))

    @property
    def count(self) -> int:
        return int(self.columns.size)

    @cached_property
    def names(self) -> tuple[str, ...]:
        every = parameter_names(self.chain.joints)
        return tuple(every[column] for column in self.columns)

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(map(unit_of, self.names))

    @cached_property
    def groups(self) -> tuple[str, ...]:
        """The combination that each base parameter represents, such as `moment_x_3 + 0.124 mass_4`."""
        every = parameter_names(self.chain.joints)
        return tuple(_sum(name, every, row) for name, row in zip(self.names, self.grouping, strict=True))

    def of_all(self, parameters: Array) -> Array:
        """Return the base parameters (base parameters,) for a vector of all parameters (11 joints,)."""
        base: Array = self.grouping @ parameters
        return base

    def as_all(self, base: Array) -> Array:
        """Return a full parameter vector (11 joints,) with the same dynamics, zero except for the base parameters."""
        every = np.zeros(TERMS * self.chain.joints)
        every[self.columns] = base
        return every

    def regressor(self, position: Array, velocity: Array, acceleration: Array) -> Array:
        """Return the regressor of the base parameters (joints, samples, base parameters); see `dynamics.regressor`."""
        return regressor(self.chain, position, velocity, acceleration, self.columns)


def _norms_by_kind(norm: Array) -> Array:
    """Return, for each column, the largest norm of the columns of the same link and kind.

    If a kind has hardly any effect in a link (for example, the moments of the first link if its axis is vertical to
    within rounding), the largest norm of all links is used, so that these columns are not scaled up.
    """
    largest = norm.reshape(-1, TERMS).copy()
    for kind in KINDS:
        of_link = largest[:, kind].max(axis=1, keepdims=True)
        largest[:, kind] = np.where(of_link < INDEPENDENT * of_link.max(), of_link.max(), of_link)
    return largest.reshape(-1)


def _independent(Y: Array, order: list[int]) -> Columns:
    """Return the indices of linearly independent columns of `Y`, which must be scaled by kind of parameter."""
    left = Y[:, order].copy()
    kept: list[int] = []

    def keep(index: int) -> None:
        kept.append(order[index])
        unit = left[:, index] / np.linalg.norm(left[:, index])
        for _ in range(2):  # the second pass removes rounding errors of the first
            left[:, :] -= np.outer(unit, unit @ left)

    for index in range(len(order)):
        if np.linalg.norm(left[:, index]) > CLEARLY_INDEPENDENT:
            keep(index)
    while (size := np.linalg.norm(left, axis=0)).max() > INDEPENDENT:
        keep(int(np.argmax(size)))
    return np.array(sorted(kept))


def _random_regressor(chain: Chain, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    shape = chain.joints, SAMPLES
    position = rng.uniform(-np.pi, np.pi, shape)
    velocity, acceleration = 3.0 * rng.standard_normal(shape), 10.0 * rng.standard_normal(shape)
    Y = regressor(chain, position, velocity, acceleration)
    return Y.reshape(-1, Y.shape[2])


def _sum(name: str, every: tuple[str, ...], row: Array) -> str:
    words = [name]
    for other, factor in zip(every, row.tolist(), strict=True):
        if other != name and factor != 0.0:
            size = "" if abs(abs(factor) - 1.0) < NOTHING else f"{abs(factor):.6g} "
            words.append(f"{'+' if factor > 0.0 else '-'} {size}{other}")
    return " ".join(words)
