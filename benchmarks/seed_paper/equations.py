"""The method of Zhu et al. on their own arm: as printed, and by maximum likelihood on the same Fourier coefficients.

Zhu, Man, Cao, Zheng, Wang, "Parameter Estimation for Robotic Manipulator Systems", Machines 10 (2022) 392. Numbers in
parentheses are its equations; docs/paper.md explains them and lists the misprints.

The arm consists of two point masses at the ends of two links, linearised about the hanging pose. As printed, in (16)
and (17), it obeys the first-order equation q' = A q + B u. The correct form, q'' = A q + B u, never settles without
friction, so the corrected arm has viscous friction, (s^2 D + s F + K) q = u. `order` chooses between the two.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.errors import ModelError, ShapeError

Complex = npt.NDArray[np.complex128]
Order = Literal[1, 2]

FUNDAMENTAL = 0.01  # Hz, Table 2
LINES = (3, 5, 7, 9, 11, 13, 17, 21, 27, 42)
AMPLITUDES = (0.2, 1.5, 0.3, 0.5, 0.7, 0.8, 1.0, 1.2, 1.4, 2.0)  # N m
NOISE = 0.1  # rad: "white noise 0.1*rand()", uniformly distributed from 0 to this value


@dataclass(frozen=True)
class PaperArm:
    """The paper's arm; the defaults are those of its Table 1."""

    mass_1: float = 5.0
    mass_2: float = 1.5
    inertia_1: float = 5.0
    inertia_2: float = 5.0
    length_1: float = 1.0
    length_2: float = 0.8
    gravity: float = 9.81
    viscous: float = 0.0
    """Friction of each joint [N m s/rad]; the paper's model has none."""

    def mass_matrix(self) -> Array:
        """Return D (2, 2) [kg m^2] of equation (3) at q2 = 0, with J1 and J2, which equations (14) and (15) omit."""
        alpha = (self.mass_1 + self.mass_2) * self.length_1**2 + self.inertia_1
        beta = self.mass_2 * self.length_1 * self.length_2
        delta = self.mass_2 * self.length_2**2
        return np.array([[alpha + delta + 2.0 * beta, delta + beta], [delta + beta, delta + self.inertia_2]])

    def stiffness(self) -> Array:
        """Return K (2, 2) [N m/rad]: gravity linearised about the hanging pose.

        This is equation (7), corrected to contain cos q1 in its first term.
        """
        first = (self.mass_1 + self.mass_2) * self.length_1 * self.gravity
        second = self.mass_2 * self.length_2 * self.gravity
        return np.array([[first + second, second], [second, second]])


@dataclass(frozen=True)
class Excitation:
    """Torque as a sum of cosines (spectral lines): harmonics, and amplitudes for each joint."""

    lines: npt.NDArray[np.int64]
    """Harmonics of FUNDAMENTAL (lines,)."""
    torque: Array
    """Amplitudes (2, lines) [N m]."""

    @property
    def frequency(self) -> Array:
        """Angular frequencies (lines,) [rad/s]."""
        return np.asarray(2.0 * np.pi * FUNDAMENTAL * self.lines, dtype=np.float64)


def own_lines() -> Excitation:
    """Return the spectral lines of Table 2 for joint 1, and the same amplitudes one harmonic higher for joint 2.

    In equation (19) as printed, both joints have the same torque at the same frequencies. Only sums of the two columns
    of the transfer function can then be observed, and A1 of equation (33) is singular. A shift by one harmonic is the
    smallest change that resolves this.
    """
    lines, amplitude = np.array(LINES), np.array(AMPLITUDES)
    nothing = np.zeros_like(amplitude)
    torque = np.stack((np.concatenate((amplitude, nothing)), np.concatenate((nothing, amplitude))))
    return Excitation(np.concatenate((lines, lines + 1)), torque)


def printed_lines() -> Excitation:
    """Return the spectral lines of Table 2 as printed, which are the same for both joints."""
    return Excitation(np.array(LINES), np.array([AMPLITUDES, AMPLITUDES]))


def response(arm: PaperArm, excitation: Excitation, order: Order) -> Complex:
    """Return the complex amplitudes of the joint angles at the excited harmonics (2, lines) [rad], equation (30)."""
    s = 1j * excitation.frequency
    D, K, F = arm.mass_matrix(), arm.stiffness(), np.eye(2) * arm.viscous
    terms = (s * D[:, :, None] if order == 1 else s * s * D[:, :, None] + s * F[:, :, None]) + K[:, :, None]
    angles = linalg.solve(np.moveaxis(terms, 2, 0), excitation.torque.T[:, :, None])[:, :, 0].T
    return np.asarray(angles, dtype=np.complex128)


def record(arm: PaperArm, excitation: Excitation, order: Order, rate: float, seed: int) -> Array:
    """Return one fundamental period of the settled angles (2, samples) [rad], with the paper's noise added."""
    samples = round(rate / FUNDAMENTAL)
    turn = np.exp(1j * np.outer(excitation.frequency, np.arange(samples) / rate))
    clean = (response(arm, excitation, order) @ turn).real
    return np.asarray(clean + NOISE * np.random.default_rng(seed).random(clean.shape))


def coefficients(position: Array, excitation: Excitation) -> Complex:
    """Return the complex Fourier coefficients of one period (2, samples) at the excited harmonics (2, lines).

    See equations (48) and (60). The mean of the noise, NOISE / 2, only affects harmonic 0, which is not used. Raises
    ShapeError.
    """
    if position.ndim != 2 or position.shape[0] != 2 or position.shape[1] <= 2 * excitation.lines.max():
        raise ShapeError(
            f"position has shape {position.shape}: one period of two joints (2, samples) is needed, with more than "
            f"{2 * excitation.lines.max()} samples"
        )
    samples = position.shape[1]
    lines: Complex = np.fft.rfft(position, axis=1)[:, excitation.lines] * 2.0 / samples
    return lines


def fit_as_printed(coefficient: Complex, excitation: Excitation, known: PaperArm) -> tuple[float, float]:
    """Return m1 and m2 [kg] by the paper's method: ordinary least squares, then the masses from the coefficients.

    Joint i's coefficients obey (s^2 + a1 s + a0) q_i = (b11 s + b10) u1 + (b21 s + b20) u2 for the first-order plant.
    Equations (52) to (58) solve this for joint 1 and (63) to (69) for joint 2, for each harmonic, separately for real
    and imaginary parts, with the noisy q_i on both sides. Then m1 is found from joint 1's six coefficients and m2 from
    joint 2's, as the masses that minimise the coefficients' relative error.

    `known` provides lengths and inertias; its masses only set the scale. Noise in the regressors biases the
    coefficients towards zero, however much data there is. Raises ModelError if both joints use the same harmonics,
    since the columns of equation (33) then coincide.
    """
    s = 1j * excitation.frequency
    u1, u2 = excitation.torque
    masses = []
    for joint in range(2):
        q = coefficient[joint]
        A = np.stack((-s * q, -q, s * u1, u1, s * u2, u2), axis=1)
        goal = s * s * q
        rows = np.concatenate((A.real, A.imag))
        if linalg.matrix_rank(rows / np.linalg.norm(rows, axis=0)) < rows.shape[1]:
            raise ModelError(
                "both joints have the same torque on the same lines: eq. (33) is singular; give each joint its own "
                "lines"
            )
        found = linalg.lstsq(rows, np.concatenate((goal.real, goal.imag)), rcond=None)[0]
        masses.append(_nearest_masses(found, joint, known)[joint])
    return masses[0], masses[1]


@dataclass(frozen=True)
class MassEstimate:
    """Maximum-likelihood estimate of the paper's two masses."""

    mass_1: float
    mass_2: float
    std: tuple[float, float]
    """Standard errors from the residual [kg]."""
    viscous: float
    """Viscous friction estimated along with the masses, only for the second-order plant [N m s/rad]."""


def fit_likelihood(coefficient: Complex, excitation: Excitation, known: PaperArm, order: Order) -> MassEstimate:
    """Return the masses (and the friction of the second-order plant) that maximise the likelihood of the coefficients.

    The noise of a Fourier coefficient is normal with the same variance at all harmonics, whatever the noise's
    distribution in time, so maximising the likelihood means minimising the sum of squared differences between measured
    and predicted coefficients. `known` provides lengths, inertias and the initial guess.
    """

    def arm(x: Array) -> PaperArm:
        viscous = float(x[2]) if order == 2 else 0.0
        return replace(known, mass_1=float(x[0]), mass_2=float(x[1]), viscous=viscous)

    def misfit(x: Array) -> Array:
        left = (response(arm(x), excitation, order) - coefficient).reshape(-1)
        return np.concatenate((left.real, left.imag))

    start = np.array([known.mass_1, known.mass_2, known.viscous][: 1 + order])
    found = linalg.least_squares(misfit, start, x_scale=np.maximum(start, 0.1), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    variance = 2.0 * found.cost / (found.fun.size - start.size)
    jacobian = np.asarray(found.jac, dtype=np.float64)
    std = np.sqrt(variance * np.diag(linalg.inv(jacobian.T @ jacobian)))
    viscous = float(found.x[2]) if order == 2 else 0.0
    return MassEstimate(float(found.x[0]), float(found.x[1]), (float(std[0]), float(std[1])), viscous)


def _nearest_masses(found: Array, joint: int, known: PaperArm) -> Array:
    """Return the masses (2,) whose transfer coefficients are closest to `found` (6,)."""
    size = np.abs(_transfer(known, joint))

    def misfit(x: Array) -> Array:
        arm = replace(known, mass_1=abs(float(x[0])), mass_2=abs(float(x[1])))
        return np.asarray((_transfer(arm, joint) - found) / size)

    return np.abs(linalg.least_squares(misfit, [0.8 * known.mass_1, 0.8 * known.mass_2]).x)


def _transfer(arm: PaperArm, joint: int) -> Array:
    """Return a1, a0, b11, b10, b21, b20 of one joint of the first-order plant, equations (25) to (28)."""
    B = linalg.inv(arm.mass_matrix())
    A = -B @ arm.stiffness()
    adjugate = np.array([[-A[1, 1], A[0, 1]], [A[1, 0], -A[0, 0]]]) @ B
    b = ((B[joint, i], adjugate[joint, i]) for i in range(2))
    return np.array([-np.trace(A), np.linalg.det(A), *next(b), *next(b)])
