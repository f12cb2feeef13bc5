"""The method of Zhu et al. for a servo arm's settled period: linear response about the hanging pose at each Fourier
line.

This is the corrected form, second order with damping: (s^2 D + s F + K) q = tau on every line, with D and K of the arm
linearised at (-pi/2, 0). It is valid for small swings without dry friction. Zhu et al., Machines 10 (2022) 392,
equations (13), (48), (52) to (69); docs/paper.md.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.fourier import cut_off, held_lines, lines_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError


@dataclass(frozen=True)
class LinearisedEstimate:
    """Estimate from the linear response."""

    parameters: dict[str, float]
    """Base parameters by name [SI]; the friction is purely viscous."""
    std: dict[str, float]
    remark: str
    """Description of how far each joint swings about the hanging pose."""


def fit_linearised(period: SettledPeriod, length: float | None, gravity: float) -> LinearisedEstimate:
    """Fit the linear response about the hanging pose to the Fourier coefficients of a period by least squares.

    length: length of link 1 [m]. The linear response of two joints determines only three combinations of the four
    inertias; the fourth equation is coupling = length gravity_2 / gravity. Raises ModelError if the gravity term or the
    length is missing.
    """
    if gravity <= 0.0:
        raise ModelError("the method of Zhu et al. linearises about the hanging pose, which requires gravity")
    lines = lines_of(period.filled())
    count = cut_off(lines) + 1
    Q = lines[:, 1:count]
    torque = held_lines(period.torque, period.rate, -period.command_to_sample)[:, 1:count]
    s = 1j * period.fundamental * np.arange(1, count)
    swing = np.degrees(np.ptp(period.filled(), axis=1))
    remark = (
        f"linearised about the hanging pose; the joints swing by {', '.join(f'{angle:.0f}' for angle in swing)} degrees"
    )
    if period.joints == 1:
        A = np.stack((s * s * Q[0], s * Q[0], Q[0]), axis=1)
        x, covariance = _solve(A, torque[0])
        single = ("inertia_1", "viscous_1", "gravity_1")
        return LinearisedEstimate(_named(single, x), _named(single, np.sqrt(np.diag(covariance))), remark)
    if length is None:
        raise ModelError("the method of Zhu et al. needs the length of link 1: set known.length_1")
    none = np.zeros_like(s)
    # Unknowns: D11, D12, D22, viscous_1, viscous_2, gravity_1, gravity_2.
    first = np.stack((s * s * Q[0], s * s * Q[1], none, s * Q[0], none, Q[0], Q[0] + Q[1]), axis=1)
    second = np.stack((none, s * s * Q[0], s * s * Q[1], none, s * Q[1], none, Q[0] + Q[1]), axis=1)
    x, covariance = _solve(np.concatenate((first, second)), np.concatenate((torque[0], torque[1])))
    arm = length / gravity
    # inertia_2 = D12 - coupling and so on, with coupling = arm gravity_2.
    to_base = {
        "inertia_1": (1, -1, 0, 0, 0, 0, -arm),
        "coupling": (0, 0, 0, 0, 0, 0, arm),
        "inertia_2": (0, 1, 0, 0, 0, 0, -arm),
        "armature_2": (0, -1, 1, 0, 0, 0, arm),
        "gravity_1": (0, 0, 0, 0, 0, 1, 0),
        "gravity_2": (0, 0, 0, 0, 0, 0, 1),
        "viscous_1": (0, 0, 0, 1, 0, 0, 0),
        "viscous_2": (0, 0, 0, 0, 1, 0, 0),
    }
    T = np.array(list(to_base.values()), dtype=np.float64)
    names = tuple(to_base)
    return LinearisedEstimate(_named(names, T @ x), _named(names, np.sqrt(np.diag(T @ covariance @ T.T))), remark)


def _named(names: tuple[str, ...], values: Array) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))


def _solve(A: Array, b: Array) -> tuple[Array, Array]:
    """Solve A x = b (complex) by ordinary least squares; return x and its covariance assuming a white residual."""
    real, goal = np.concatenate((A.real, A.imag)), np.concatenate((b.real, b.imag))
    norm = np.linalg.norm(real, axis=0)
    x = linalg.lstsq(real / norm, goal, rcond=None)[0] / norm
    left = goal - real @ x
    variance = float(left @ left) / max(1, goal.size - x.size)
    return x, variance * linalg.pinv((real / norm).T @ (real / norm), hermitian=True) / np.outer(norm, norm)
