"""Randomly drawn serial arms, as URDF text."""

import numpy as np

from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.model.geometry import Chain


def random_urdf(joints: int, seed: int) -> str:
    """An arm with links of any shape, axes in any direction, and a part fixed to its last link."""
    rng = np.random.default_rng(seed)
    parts = ['<robot name="random"><link name="base"/>']
    for joint in range(joints):
        parent = "base" if joint == 0 else f"link_{joint}"
        axis = rng.standard_normal(3)
        axis /= np.linalg.norm(axis)
        parts.append(
            f'<joint name="joint_{joint + 1}" type="revolute"><parent link="{parent}"/><child link="link_{joint + 1}"/>'
            f"{_origin(rng, 0.15)}<axis xyz={_numbers(axis)}/>"
            f'<limit lower="-3" upper="3" velocity="5" effort="5"/></joint>{_link(rng, f"link_{joint + 1}")}'
        )
    parts.append(
        f'<joint name="weld" type="fixed"><parent link="link_{joints}"/><child link="tip"/>{_origin(rng, 0.1)}</joint>'
        f"{_link(rng, 'tip')}</robot>"
    )
    return "".join(parts)


def random_chain(joints: int, seed: int) -> Chain:
    """A chain with joint axes and gravity in random directions."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal((joints, 3))
    rotation = np.stack([np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(joints)])
    rotation *= np.linalg.det(rotation)[:, None, None]
    return Chain(
        rotation,
        0.15 * rng.standard_normal((joints, 3)),
        axis / np.linalg.norm(axis, axis=1, keepdims=True),
        5.0 * rng.standard_normal(3),
    )


def random_parameters(joints: int, seed: int) -> np.ndarray:
    """All inertial parameters of random links with positive mass, including armatures (11 joints,)."""
    rng = np.random.default_rng(seed)
    table = np.empty((joints, TERMS))
    for row in table:
        mass, centre, spread = rng.uniform(0.1, 1.0), 0.1 * rng.standard_normal(3), rng.uniform(0.01, 0.1, (3, 3))
        about = spread @ spread.T + np.outer(centre, centre)
        inertia = mass * (np.trace(about) * np.eye(3) - about)
        row[:] = [mass, *(mass * centre), *inertia[np.triu_indices(3)], rng.uniform(0.001, 0.02)]
    return table.reshape(-1)


def _link(rng: np.random.Generator, name: str) -> str:
    mass, spread = rng.uniform(0.1, 1.0), rng.uniform(0.01, 0.1, 3)
    second = mass * spread**2
    xx, yy, zz = second.sum() - second
    return (
        f'<link name="{name}"><inertial>{_origin(rng, 0.1)}<mass value="{float(mass)!r}"/><inertia ixx="{float(xx)!r}" '
        f'iyy="{float(yy)!r}" izz="{float(zz)!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def _origin(rng: np.random.Generator, size: float) -> str:
    return f"<origin xyz={_numbers(size * rng.standard_normal(3))} rpy={_numbers(rng.uniform(-3, 3, 3))}/>"


def _numbers(values: np.ndarray) -> str:
    return '"' + " ".join(repr(float(value)) for value in values) + '"'
