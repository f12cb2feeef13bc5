"""Forward sensitivities: the simulated motion and its derivatives by parameters and starting state, in one go.

The derivative is that of the discrete scheme of `estimator.simulation` itself, step by step, so that it is the
gradient of what is minimised and not of something close to it. One step is, with W = M + gamma h S (M mass
matrix, S slopes of friction) and primes where stage 1 foresees the end,

    W k = f        M' a = f'        W l = M (a - 2 k)        v += h (3 k + l) / 2        q += h v + h^2 k / 2

All that depends on a parameter enters through three gaps: of W k = f, of M' a = f' and of the third equation.
A change of them by r, g, e moves the new velocity by A r + B g + C e; A, B and C are two-by-two and common to
all parameters, which makes one more parameter cost a few dozen operations a step, not one more simulation.
"""

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from estimator.arrays import Array
from estimator.physics import CONSTANTS, Physics
from estimator.simulation import GAMMA, _pieces

# What can be differentiated by: the constants, the drive's times, the state at the first sample.
CAUSES = (*CONSTANTS, "delay", "lag", "position_1", "position_2", "velocity_1", "velocity_2")
DELAY, STATE = len(CONSTANTS), len(CONSTANTS) + 2
ZERO_2 = CONSTANTS.index("zero_2")


class Sensitive:
    """A simulation that goes on piece by piece, so that long recordings need little memory.

    `start` (2, joints): angles [rad] and velocities [rad/s] at the first sample; `causes`: names of what to
    differentiate by, from CAUSES; `step` [s]: length of one integration step.
    """

    def __init__(self, physics: Physics, start: Array, causes: tuple[str, ...], step: float) -> None:
        self._joints = start.shape[1]
        self._constants = physics.vector
        self._step = step
        self._pieces = _pieces(physics, step)
        state = np.zeros((2, 2))
        state[:, : self._joints] = start
        self._state = state.reshape(-1)
        self._work = _room()
        self._causes: npt.NDArray[np.int64] = np.array([CAUSES.index(name) for name in causes])
        # How the state (q1, q2, v1, v2) changes with each cause.
        self._change = np.zeros((len(causes), 4))
        for row, cause in enumerate(self._causes):
            if cause >= STATE:
                self._change[row, cause - STATE] = 1.0

    def advance(self, torque: Array, torque_slopes: Array) -> tuple[Array, Array]:
        """Go on by as many samples as `torque` has.

        `torque` (joints, samples, steps): mean motor torque over each step after each sample [N m];
        `torque_slopes` (2, joints, samples, steps): its derivatives by delay and lag [N m/s]. Returns the
        angles (joints, samples) [rad] and their derivatives (joints, samples, causes).
        """
        joints, samples, steps = torque.shape
        both = np.zeros((2, samples, steps))
        both[:joints] = torque
        slopes = np.zeros((2, 2, samples, steps))
        slopes[:, :joints] = torque_slopes
        position = np.empty((2, samples))
        derivative = np.empty((2, samples, self._causes.size))
        _advance(
            *(self._constants, self._state, self._change, both, slopes, self._step, self._pieces),
            *(self._work, self._causes, position, derivative),
        )
        return position[:joints], derivative[:joints]


def _room() -> tuple[Array, ...]:
    """Arrays that the steps write to: derivatives of both stages, the state's transition, the torques' slopes.

    Made here, since what makes arrays takes a compiler seconds.
    """
    stages = [np.zeros(shape) for _ in range(2) for shape in ((2, STATE), (2, STATE), (3, STATE), (4, 6))]
    for mass in (stages[2], stages[6]):
        mass[[0, 0, 1, 2, 2], [0, 2, 2, 2, 3]] = 1.0
    return (*stages, np.zeros((4, 4)), np.zeros((2, 2)))


# Compiled code takes its arguments by position; p is `Physics.vector`, joint is 0 or 1.
def _drive(p: Any, joint: int, q: float, v: float, t: float, F: Any, S: Any) -> tuple[float, ...]:
    """Torque left by a drive and slope of its friction as in the simulation, and derivatives of both.

    By parameters into F and S (causes,); returned by angle, velocity and torque.
    """
    c = 6 + joint
    viscous, coulomb, offset, width = p[c], p[c + 2], p[c + 4], p[c + 6]
    rise, fading, load, asymmetry = p[c + 8], p[c + 10], p[c + 12], p[c + 14]
    ripple_sin, ripple_cos, cycles = p[c + 16], p[c + 18], p[c + 20]
    commanded, scale = t, p[c + 24]
    t *= scale
    sine, cosine = 0.0, 1.0
    if cycles != 0.0:
        sine, cosine = math.sin(cycles * q), math.cos(cycles * q)
        gain = 1.0 + ripple_sin * sine + ripple_cos * cosine
    else:
        gain = 1.0
    turn = t * (ripple_sin * cosine - ripple_cos * sine)
    motor = t * gain
    loaded = load if motor > 0.0 else -load
    bump = math.exp(-((v / fading) ** 2))
    level = coulomb * (1.0 + rise * bump) + load * abs(motor)
    level_v = -2.0 * coulomb * rise * bump * v / fading**2
    bend = math.tanh(v / width)
    bent = (1.0 - bend * bend) / width
    bent_v = -2.0 * bend * bent / width
    F[c], S[c] = -v, 1.0
    F[c + 2], S[c + 2] = -(1.0 + rise * bump) * bend, (1.0 + rise * bump) * bent
    F[c + 4] = -1.0
    bend_w = -v / width * bent
    F[c + 6], S[c + 6] = -(level + asymmetry * v) * bend_w, -level * (bent + 2.0 * bend * bend_w) / width
    F[c + 8], S[c + 8] = -coulomb * bump * bend, coulomb * bump * bent
    level_f = 2.0 * coulomb * rise * bump * v * v / fading**3
    F[c + 10], S[c + 10] = -level_f * bend, level_f * bent
    F[c + 12], S[c + 12] = -abs(motor) * bend, abs(motor) * bent
    F[c + 14] = -v * bend
    F[c + 16], S[c + 16] = t * sine * (1.0 - loaded * bend), t * sine * loaded * bent
    F[c + 18], S[c + 18] = t * cosine * (1.0 - loaded * bend), t * cosine * loaded * bent
    F[c + 20], S[c + 20] = q * turn * (1.0 - loaded * bend), q * turn * loaded * bent
    F[c + 24], S[c + 24] = commanded * gain * (1.0 - loaded * bend), commanded * gain * loaded * bent
    return (
        motor - offset - viscous * v - (asymmetry * v + level) * bend,
        viscous + level * bent,
        cycles * turn * (1.0 - loaded * bend),
        -viscous - (asymmetry * v + level) * bent - (asymmetry + level_v) * bend,
        scale * gain * (1.0 - loaded * bend),
        cycles * turn * loaded * bent,
        level_v * bent + level * bent_v,
        scale * gain * loaded * bent,
    )


def _arm(
    p: Any, q1: float, q2: float, v1: float, v2: float, t1: float, t2: float, dt: Any, F: Any, S: Any, M: Any, X: Any
) -> tuple[float, ...]:
    """Mass matrix's first row, torques left, slopes of friction, and their derivatives.

    By parameters into F and S (2, causes) and M (3, causes), whose rows are m11, m12, m22; by the state
    q1, q2, v1, v2 into X (4, 6), whose columns are f1, f2, slope_1, slope_2, m11, m12. `dt` (2, 2): of the
    motor torques by delay and lag [cause, joint].
    """
    left_1, slope_1, f1_q, f1_v, f1_t, s1_q, s1_v, s1_t = _drive(p, 0, q1, v1, t1, F[0], S[0])
    left_2, slope_2, f2_q, f2_v, f2_t, s2_q, s2_v, s2_t = _drive(p, 1, q2, v2, t2, F[1], S[1])
    for cause in range(2):
        F[0, DELAY + cause], S[0, DELAY + cause] = f1_t * dt[cause, 0], s1_t * dt[cause, 0]
        F[1, DELAY + cause], S[1, DELAY + cause] = f2_t * dt[cause, 1], s2_t * dt[cause, 1]
    q1 += p[28]
    q2 += p[29]
    cos_2, sin_2 = math.cos(q2), math.sin(q2)
    level_1, level_12 = math.cos(q1), math.cos(q1 + q2)
    across, turning = p[1] * cos_2, p[1] * sin_2
    fall_1, fall_12 = p[4] * math.sin(q1), p[5] * math.sin(q1 + q2)
    whirl = (2.0 * v1 + v2) * v2
    M[0, 1], M[1, 1] = 2.0 * cos_2, cos_2
    F[0, 1], F[1, 1] = sin_2 * whirl, -sin_2 * v1 * v1
    F[0, 4] = -level_1
    F[0, 5] = F[1, 5] = -level_12
    f1_q2, f2_q2 = fall_12 + across * whirl, fall_12 - across * v1 * v1
    F[0, 28], F[1, 28] = fall_1 + fall_12, fall_12
    F[0, 29], F[1, 29] = f1_q2, f2_q2
    M[0, 29], M[1, 29] = -2.0 * turning, -turning
    X[0, 0], X[0, 1], X[0, 2] = fall_1 + fall_12 + f1_q, fall_12, s1_q
    X[1, 0], X[1, 1], X[1, 3] = f1_q2, f2_q2 + f2_q, s2_q
    X[1, 4], X[1, 5] = -2.0 * turning, -turning
    X[2, 0], X[2, 1], X[2, 2] = f1_v + 2.0 * turning * v2, -2.0 * turning * v1, s1_v
    X[3, 0], X[3, 1], X[3, 3] = turning * 2.0 * (v1 + v2), f2_v, s2_v
    return (
        p[0] + p[2] + 2.0 * across,
        p[2] + across,
        left_1 - p[4] * level_1 - p[5] * level_12 + turning * whirl,
        left_2 - p[5] * level_12 - turning * v1 * v1,
        slope_1,
        slope_2,
    )


def _step(  # noqa: PLR0915
    p: Any, x: Any, t1: float, t2: float, dt: Any, h: float, work: Any, change: Any, causes: Any
) -> tuple[float, float]:
    """One step of the state x (4,) and of `change` (causes, 4); the accelerations."""
    F, S, M, X, G, S_, N, Y, T, _ = work
    q1, q2, v1, v2 = x
    gh = GAMMA * h
    m22 = p[2] + p[3]
    m11, m12, f1, f2, slope_1, slope_2 = _arm(p, q1, q2, v1, v2, t1, t2, dt, F, S, M, X)
    w11, w22 = m11 + gh * slope_1, m22 + gh * slope_2
    w = w11 * w22 - m12 * m12
    # Winv = [i11 i12; i12 i22]
    i11, i12, i22 = w22 / w, -m12 / w, w11 / w
    k1, k2 = i11 * f1 + i12 * f2, i12 * f1 + i22 * f2
    n11, n12, f1, f2, _, _ = _arm(p, q1 + h * v1, q2 + h * v2, v1 + h * k1, v2 + h * k2, t1, t2, dt, G, S_, N, Y)
    n = n11 * m22 - n12 * n12
    j11, j12, j22 = m22 / n, -n12 / n, n11 / n
    a1, a2 = j11 * f1 + j12 * f2, j12 * f1 + j22 * f2
    r1, r2 = a1 - 2.0 * k1, a2 - 2.0 * k2
    b1, b2 = m11 * r1 + m12 * r2, m12 * r1 + m22 * r2
    l1, l2 = i11 * b1 + i12 * b2, i12 * b1 + i22 * b2
    y1, y2 = r1 - l1, r2 - l2
    # C = h/2 Winv; Q = C M; B = Q M'inv; A = (3 h/2 + h B f'_v - 2 Q) Winv
    c11, c12, c22 = 0.5 * h * i11, 0.5 * h * i12, 0.5 * h * i22
    o11, o12 = c11 * m11 + c12 * m12, c11 * m12 + c12 * m22
    o21, o22 = c12 * m11 + c22 * m12, c12 * m12 + c22 * m22
    b11, b12 = o11 * j11 + o12 * j12, o11 * j12 + o12 * j22
    b21, b22 = o21 * j11 + o22 * j12, o21 * j12 + o22 * j22
    d11 = 1.5 * h + h * (b11 * Y[2, 0] + b12 * Y[2, 1]) - 2.0 * o11
    d12 = h * (b11 * Y[3, 0] + b12 * Y[3, 1]) - 2.0 * o12
    d21 = h * (b21 * Y[2, 0] + b22 * Y[2, 1]) - 2.0 * o21
    d22 = 1.5 * h + h * (b21 * Y[3, 0] + b22 * Y[3, 1]) - 2.0 * o22
    a11, a12 = d11 * i11 + d12 * i12, d11 * i12 + d12 * i22
    a21, a22 = d21 * i11 + d22 * i12, d21 * i12 + d22 * i22
    # By the state: X holds what it does to stage 1, Y to stage 2, where angles have moved by h v.
    for d in range(4):
        u1 = X[d, 0] - X[d, 4] * k1 - X[d, 5] * k2 - gh * X[d, 2] * k1
        u2 = X[d, 1] - X[d, 5] * k1 - gh * X[d, 3] * k2
        g1 = Y[d, 0] - Y[d, 4] * a1 - Y[d, 5] * a2
        g2 = Y[d, 1] - Y[d, 5] * a1
        if d >= 2:
            g1 += h * (Y[d - 2, 0] - Y[d - 2, 4] * a1 - Y[d - 2, 5] * a2)
            g2 += h * (Y[d - 2, 1] - Y[d - 2, 5] * a1)
        e1 = X[d, 4] * y1 + X[d, 5] * y2 - gh * X[d, 2] * l1
        e2 = X[d, 5] * y1 - gh * X[d, 3] * l2
        T[0, d] = h * h * 0.5 * (i11 * u1 + i12 * u2)
        T[1, d] = h * h * 0.5 * (i12 * u1 + i22 * u2)
        T[2, d] = a11 * u1 + a12 * u2 + b11 * g1 + b12 * g2 + c11 * e1 + c12 * e2
        T[3, d] = a21 * u1 + a22 * u2 + b21 * g1 + b22 * g2 + c12 * e1 + c22 * e2
        T[d, d] += 1.0
    T[0, 2] += h
    T[1, 3] += h
    for row in range(causes.size):
        i = causes[row]
        z1, z2, z3, z4 = change[row, 0], change[row, 1], change[row, 2], change[row, 3]
        n1 = T[0, 0] * z1 + T[0, 1] * z2 + T[0, 2] * z3 + T[0, 3] * z4
        n2 = T[1, 0] * z1 + T[1, 1] * z2 + T[1, 2] * z3 + T[1, 3] * z4
        n3 = T[2, 0] * z1 + T[2, 1] * z2 + T[2, 2] * z3 + T[2, 3] * z4
        n4 = T[3, 0] * z1 + T[3, 1] * z2 + T[3, 2] * z3 + T[3, 3] * z4
        if i < STATE:
            u1 = F[0, i] - M[0, i] * k1 - M[1, i] * k2 - gh * S[0, i] * k1
            u2 = F[1, i] - M[1, i] * k1 - M[2, i] * k2 - gh * S[1, i] * k2
            g1 = G[0, i] - N[0, i] * a1 - N[1, i] * a2
            g2 = G[1, i] - N[1, i] * a1 - N[2, i] * a2
            e1 = M[0, i] * y1 + M[1, i] * y2 - gh * S[0, i] * l1
            e2 = M[1, i] * y1 + M[2, i] * y2 - gh * S[1, i] * l2
            n1 += h * h * 0.5 * (i11 * u1 + i12 * u2)
            n2 += h * h * 0.5 * (i12 * u1 + i22 * u2)
            n3 += a11 * u1 + a12 * u2 + b11 * g1 + b12 * g2 + c11 * e1 + c12 * e2
            n4 += a21 * u1 + a22 * u2 + b21 * g1 + b22 * g2 + c12 * e1 + c22 * e2
        change[row, 0], change[row, 1], change[row, 2], change[row, 3] = n1, n2, n3, n4
    s1, s2 = 1.5 * k1 + 0.5 * l1, 1.5 * k2 + 0.5 * l2
    x[0] = q1 + h * v1 + 0.5 * h * h * k1
    x[1] = q2 + h * v2 + 0.5 * h * h * k2
    x[2] = v1 + h * s1
    x[3] = v2 + h * s2
    return s1, s2


def _loop(
    p: Any,
    x: Any,
    change: Any,
    torque: Any,
    slopes: Any,
    step: float,
    pieces: int,
    work: Any,
    causes: Any,
    position: Any,
    derivative: Any,
) -> None:
    dt = work[9]
    a1 = a2 = 0.0
    for k in range(position.shape[1]):
        position[0, k], position[1, k] = x[0], x[1]
        for row in range(causes.size):
            derivative[0, k, row], derivative[1, k, row] = change[row, 0], change[row, 1]
        for s in range(torque.shape[2]):
            near_1 = p[8] > 0.0 and abs(x[2]) < 6.0 * p[12] + 2.0 * step * abs(a1)
            near_2 = p[9] > 0.0 and abs(x[3]) < 6.0 * p[13] + 2.0 * step * abs(a2)
            cuts = pieces if near_1 or near_2 else 1
            dt[0, 0] = slopes[0, 0, k, s]
            dt[0, 1] = slopes[0, 1, k, s]
            dt[1, 0] = slopes[1, 0, k, s]
            dt[1, 1] = slopes[1, 1, k, s]
            for _ in range(cuts):
                a1, a2 = _step(p, x, torque[0, k, s], torque[1, k, s], dt, step / cuts, work, change, causes)


# Only the loop is called from Python; wrappers for the others would take a second more to compile.
_inner: Any = numba.njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)  # type: ignore[call-overload]
_drive = _inner(_drive)
_arm = _inner(_arm)
_step = _inner(_step)
_advance: Callable[..., None] = numba.njit(cache=True, nogil=True)(_loop)
