"""Physically consistent links that have the identified base parameters and are close to those of a description.

Each link is described by ten log-Cholesky coordinates (Rucker and Wensing, IEEE Robotics and Automation Letters 7
(2022) 8250): its pseudo-inertia is U U', where U is upper triangular with a positive diagonal, so that every point
corresponds to a possible mass distribution. Quantities that the base parameters do not determine are weakly regularised
towards the description.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS

PULL = 0.03  # default weight of a unit change in a coordinate, relative to one standard error of a base parameter
LEAST_MASS = 1e-4  # kg
LEAST_SPREAD = 1e-3  # m: minimum radius of gyration, for links described as point masses
STEP = 1e-4  # step of the central differences, relative to a coordinate's typical step
LEAST_ROTOR = 1e-7  # kg m^2
_UPPER = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


@dataclass(frozen=True)
class PhysicalLinks:
    """Physically consistent parameters of the links and rotors, and how well they match the base parameters."""

    links: Array
    """Link parameters in the order of LINK_TERMS (joints, 10) [SI]."""
    armature: Array
    """Reflected rotor inertias (joints,) [kg m^2]."""
    misfit: float
    """Largest deviation of a base parameter from its identified value, in standard errors."""


@one_blas_thread
def nearest_links(
    base: BaseParameters, value: Array, std: Array, described: Array, armature: Array, pull: float = PULL
) -> PhysicalLinks:
    """Return the links and rotors that agree with the identified base parameters and are nearest to the described ones.

    Args:
        base: base parameters of the chain.
        value: identified values (base parameters,) [SI].
        std: their standard errors (base parameters,) [SI].
        described: link parameters of the description (joints, 10) [SI].
        armature: described reflected rotor inertias (joints,) [kg m^2].
        pull: weight of the description.
    """
    joints = base.chain.joints
    floor = np.maximum(std, 1e-6 * np.abs(value).max())
    start = np.concatenate((*(_coordinates(row) for row in described), np.log(np.maximum(armature, LEAST_ROTOR))))

    def parameters(x: Array) -> Array:
        links = _links(x[: 10 * joints].reshape(joints, 10))
        return np.column_stack((links, np.exp(x[10 * joints :])))

    def misfit(x: Array) -> Array:
        away: Array = (base.of_all(parameters(x).reshape(-1)) - value) / floor
        return away

    def residual(x: Array) -> Array:
        return np.concatenate((misfit(x), pull * (x - start) / scale))

    def slopes(x: Array) -> Array:
        # A coordinate changes one link's parameters only, so the blocks are differentiated one by one.
        by_x, own_slopes = np.zeros((TERMS * joints, x.size)), _link_slopes(x[: 10 * joints].reshape(joints, 10))
        for link in range(joints):
            own = slice(10 * link, 10 * link + 10)
            by_x[TERMS * link : TERMS * link + 10, own] = own_slopes[link]
            by_x[TERMS * link + 10, 10 * joints + link] = np.exp(x[10 * joints + link])
        return np.concatenate((base.grouping @ by_x / floor[:, None], np.diag(pull / scale)))

    scale = np.concatenate((np.tile(_scales(), joints), np.ones(joints)))
    found = linalg.least_squares(residual, start, slopes, x_scale=scale, max_nfev=200)
    table = parameters(found.x)
    assert table.shape == (joints, TERMS)
    return PhysicalLinks(table[:, :-1], table[:, -1], float(np.abs(misfit(found.x)).max()))


def _links(x: Array) -> Array:
    """Return the parameters (links, 10) for coordinates (links, 10): log diagonal of U, then the elements above it."""
    U = np.zeros((len(x), 4, 4))
    U[:, np.arange(4), np.arange(4)] = np.exp(x[:, :4])
    for k, (row, column) in enumerate(_UPPER):
        # The last column is scaled by the root of the mass, so that these coordinates are in metres.
        U[:, row, column] = x[:, 4 + k] * (U[:, 3, 3] if column == 3 else 1.0)
    pseudo = U @ np.swapaxes(U, 1, 2)
    second, moment, mass = pseudo[:, :3, :3], pseudo[:, :3, 3], pseudo[:, 3, 3]
    inertia = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    above = np.triu_indices(3)
    return np.column_stack((mass, moment, inertia[:, above[0], above[1]]))


def _link_slopes(x: Array) -> Array:
    """Return the derivatives of each link's parameters with respect to its coordinates (links, 10, 10)."""
    step = STEP * _scales()
    ahead, behind = (_links((x[:, None] + sign * np.diag(step)).reshape(-1, 10)) for sign in (1.0, -1.0))
    changed = (ahead - behind).reshape(len(x), 10, 10) / (2.0 * step)[:, None]
    return np.swapaxes(changed, 1, 2)


def _coordinates(link: Array) -> Array:
    """Return a link's coordinates; an unphysical link is first made physically consistent."""
    mass = max(float(link[0]), LEAST_MASS)
    centre = link[1:4] / mass if link[0] > LEAST_MASS else np.zeros(3)
    inertia = np.zeros((3, 3))
    inertia[np.triu_indices(3)] = link[4:]
    inertia = inertia + np.triu(inertia, 1).T
    about = inertia - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    second = 0.5 * np.trace(about) * np.eye(3) - about
    size, turned = linalg.eigh(second)
    second = turned @ np.diag(np.maximum(size, mass * LEAST_SPREAD**2)) @ turned.T
    # The upper triangular factor is a Cholesky factor with rows and columns reversed.
    lower = linalg.cholesky(second[::-1, ::-1])
    U = lower[::-1, ::-1]
    return np.array(
        [*np.log(np.diag(U)), 0.5 * np.log(mass), U[0, 1], U[0, 2], centre[0], U[1, 2], centre[1], centre[2]]
    )


def _scales() -> Array:
    """Return each coordinate's typical step: 1 for logarithms (a factor of e), and 3 mm or 2 cm for the others."""
    return np.array([1.0, 1.0, 1.0, 1.0, 0.003, 0.003, 0.02, 0.003, 0.02, 0.02])
