"""Compiled equations of motion of a spatial arm from its links' masses, centres of mass and inertias.

By Kane's equations, the Jacobians Jv and Jw of each link's centre of mass yield the mass matrix and the bias forces,

    M = sum of m Jv'Jv + Jw' I Jw        bias = sum of Jv' m (a - g) + Jw' (I alpha + omega x I omega)

where a and alpha are the accelerations due to the joint velocities alone. The estimator models the same arm
independently, with spatial vectors and a regressor of base parameters; a test compares the two.

Time integration and dry friction are as in `hil.fakes.plants.two_link`.
"""

import math
from collections.abc import Callable
from typing import Any

import numba

SHORTEST_STEP = 1e-9  # s
SWEEPS = 400
# Rows of the drives' constants.
KT, LAG, OFFSET, VISCOUS, COULOMB, WIDTH, RISE, PER_VELOCITY, LOAD, RIPPLE, CYCLES, LOW, HIGH, STIFF, DAMP, ARMATURE = (
    range(16)
)
DRIVE = 16


def _frames(rotation: Any, shift: Any, axis: Any, q: Any, turn: Any, at: Any, z: Any) -> None:
    """Write each link's rotation, and its joint's position and axis, all in the base frame, to `turn`, `at` and `z`."""
    for i in range(q.size):
        for r in range(3):
            if i == 0:
                at[0, r] = shift[0, r]
            else:
                at[i, r] = at[i - 1, r]
                for k in range(3):
                    at[i, r] += turn[i - 1, r, k] * shift[i, k]
        x, y, w = axis[i, 0], axis[i, 1], axis[i, 2]
        s, c = math.sin(q[i]), math.cos(q[i])
        d = 1.0 - c
        # The joint's own rotation, element by element.
        g00, g01, g02 = c + d * x * x, d * x * y - s * w, d * x * w + s * y
        g10, g11, g12 = d * x * y + s * w, c + d * y * y, d * y * w - s * x
        g20, g21, g22 = d * x * w - s * y, d * y * w + s * x, c + d * w * w
        for r in range(3):
            if i == 0:
                h0, h1, h2 = rotation[0, r, 0], rotation[0, r, 1], rotation[0, r, 2]
            else:
                h0 = h1 = h2 = 0.0
                for k in range(3):
                    h0 += turn[i - 1, r, k] * rotation[i, k, 0]
                    h1 += turn[i - 1, r, k] * rotation[i, k, 1]
                    h2 += turn[i - 1, r, k] * rotation[i, k, 2]
            z[i, r] = h0 * x + h1 * y + h2 * w
            turn[i, r, 0] = h0 * g00 + h1 * g10 + h2 * g20
            turn[i, r, 1] = h0 * g01 + h1 * g11 + h2 * g21
            turn[i, r, 2] = h0 * g02 + h1 * g12 + h2 * g22


def _equations(chain: Any, q: Any, v: Any, work: Any) -> None:  # noqa: PLR0912
    """Compute the mass matrix and bias forces in this state, and write them to `work`."""
    rotation, shift, axis, gravity, mass, centre, inertia = chain
    turn, at, z, jv, spin, M, bias = work
    n = q.size
    _frames(rotation, shift, axis, q, turn, at, z)
    for i in range(n):
        bias[i] = 0.0
        for j in range(n):
            M[i, j] = 0.0
    w0 = w1 = w2 = e0 = e1 = e2 = 0.0  # angular velocity and acceleration of the previous link
    p0 = p1 = p2 = 0.0  # acceleration of the joint
    for i in range(n):
        if i > 0:
            d0, d1, d2 = at[i, 0] - at[i - 1, 0], at[i, 1] - at[i - 1, 1], at[i, 2] - at[i - 1, 2]
            u0, u1, u2 = w1 * d2 - w2 * d1, w2 * d0 - w0 * d2, w0 * d1 - w1 * d0
            p0 += e1 * d2 - e2 * d1 + w1 * u2 - w2 * u1
            p1 += e2 * d0 - e0 * d2 + w2 * u0 - w0 * u2
            p2 += e0 * d1 - e1 * d0 + w0 * u1 - w1 * u0
        z0, z1, z2 = z[i, 0], z[i, 1], z[i, 2]
        e0 += (w1 * z2 - w2 * z1) * v[i]
        e1 += (w2 * z0 - w0 * z2) * v[i]
        e2 += (w0 * z1 - w1 * z0) * v[i]
        w0 += z0 * v[i]
        w1 += z1 * v[i]
        w2 += z2 * v[i]
        c0 = turn[i, 0, 0] * centre[i, 0] + turn[i, 0, 1] * centre[i, 1] + turn[i, 0, 2] * centre[i, 2]
        c1 = turn[i, 1, 0] * centre[i, 0] + turn[i, 1, 1] * centre[i, 1] + turn[i, 1, 2] * centre[i, 2]
        c2 = turn[i, 2, 0] * centre[i, 0] + turn[i, 2, 1] * centre[i, 1] + turn[i, 2, 2] * centre[i, 2]
        u0, u1, u2 = w1 * c2 - w2 * c1, w2 * c0 - w0 * c2, w0 * c1 - w1 * c0
        m = mass[i]
        f0 = m * (p0 + e1 * c2 - e2 * c1 + w1 * u2 - w2 * u1 - gravity[0])
        f1 = m * (p1 + e2 * c0 - e0 * c2 + w2 * u0 - w0 * u2 - gravity[1])
        f2 = m * (p2 + e0 * c1 - e1 * c0 + w0 * u1 - w1 * u0 - gravity[2])
        # Inertia about the centre of mass, in the base's directions.
        for r in range(3):
            for c in range(3):
                total = 0.0
                for a in range(3):
                    for b in range(3):
                        total += turn[i, r, a] * inertia[i, a, b] * turn[i, c, b]
                spin[r, c] = total
        k0 = spin[0, 0] * w0 + spin[0, 1] * w1 + spin[0, 2] * w2
        k1 = spin[1, 0] * w0 + spin[1, 1] * w1 + spin[1, 2] * w2
        k2 = spin[2, 0] * w0 + spin[2, 1] * w1 + spin[2, 2] * w2
        n0 = spin[0, 0] * e0 + spin[0, 1] * e1 + spin[0, 2] * e2 + w1 * k2 - w2 * k1
        n1 = spin[1, 0] * e0 + spin[1, 1] * e1 + spin[1, 2] * e2 + w2 * k0 - w0 * k2
        n2 = spin[2, 0] * e0 + spin[2, 1] * e1 + spin[2, 2] * e2 + w0 * k1 - w1 * k0
        for j in range(i + 1):
            r0, r1, r2 = at[i, 0] + c0 - at[j, 0], at[i, 1] + c1 - at[j, 1], at[i, 2] + c2 - at[j, 2]
            jv[j, 0] = z[j, 1] * r2 - z[j, 2] * r1
            jv[j, 1] = z[j, 2] * r0 - z[j, 0] * r2
            jv[j, 2] = z[j, 0] * r1 - z[j, 1] * r0
            bias[j] += jv[j, 0] * f0 + jv[j, 1] * f1 + jv[j, 2] * f2 + z[j, 0] * n0 + z[j, 1] * n1 + z[j, 2] * n2
        for j in range(i + 1):
            s0 = spin[0, 0] * z[j, 0] + spin[0, 1] * z[j, 1] + spin[0, 2] * z[j, 2]
            s1 = spin[1, 0] * z[j, 0] + spin[1, 1] * z[j, 1] + spin[1, 2] * z[j, 2]
            s2 = spin[2, 0] * z[j, 0] + spin[2, 1] * z[j, 1] + spin[2, 2] * z[j, 2]
            for k in range(j + 1):
                moved = m * (jv[j, 0] * jv[k, 0] + jv[j, 1] * jv[k, 1] + jv[j, 2] * jv[k, 2])
                M[j, k] += moved + s0 * z[k, 0] + s1 * z[k, 1] + s2 * z[k, 2]
    for j in range(n):
        for k in range(j):
            M[k, j] = M[j, k]


def _push(d: Any, j: int, step: float, command: float, q: float, v: float, amps: Any, out: Any) -> None:
    """Compute the effect of drive `j` during one step, and write it to the rows of `out`.

    The rows are: mean torque without stiction, level of dry friction, slope of the smooth friction, and the current at
    the end of the step.
    """
    away = amps[j] - command
    left, mean = 0.0, 0.0
    if d[LAG, j] > 0.0:
        fallen = -math.expm1(-step / d[LAG, j])
        left, mean = 1.0 - fallen, fallen * d[LAG, j] / step
    torque = d[KT, j] * (command + away * mean)
    if d[RIPPLE, j] != 0.0:
        torque *= 1.0 + d[RIPPLE, j] * math.sin(d[CYCLES, j] * q)
    ratio = v * d[PER_VELOCITY, j]
    level = d[COULOMB, j] * (1.0 + d[RISE, j] * math.exp(-ratio * ratio)) + d[LOAD, j] * abs(torque)
    slope = 0.0
    if q > d[HIGH, j] or q < d[LOW, j]:
        torque -= d[STIFF, j] * (q - (d[HIGH, j] if q > d[HIGH, j] else d[LOW, j])) + d[DAMP, j] * v
        slope += d[DAMP, j]
    torque -= d[OFFSET, j]
    if d[WIDTH, j] > 0.0:
        bend = math.tanh(v / d[WIDTH, j])
        torque -= level * bend
        slope += level / d[WIDTH, j] * (1.0 - bend * bend)
        level = 0.0
    out[0, j], out[1, j], out[2, j], out[3, j] = torque, level, slope, command + away * left


def _solve(A: Any, b: Any, x: Any) -> None:
    """Solve A x = b for a symmetric positive definite A, whose strict upper triangle is left unchanged."""
    n = b.size
    for i in range(n):
        for j in range(i + 1):
            total = A[j, i] if i != j else A[i, i]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = math.sqrt(total) if i == j else total / A[j, j]
    for i in range(n):
        total = b[i]
        for k in range(i):
            total -= A[i, k] * x[k]
        x[i] = total / A[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= A[k, i] * x[k]
        x[i] = total / A[i, i]


def _stick(A: Any, b: Any, dry: Any, x: Any) -> None:
    """Compute the velocities `x` if each joint's friction can exert any impulse up to `dry` [N m s].

    They minimise x'Ax/2 - b'x + dry'|x|, which is convex, so solving for one joint at a time converges.
    """
    n = b.size
    for _ in range(SWEEPS):
        change = 0.0
        for i in range(n):
            impulse = b[i]
            for j in range(n):
                if j != i:
                    impulse -= A[i, j] * x[j]
            new = 0.0
            if impulse > dry[i]:
                new = (impulse - dry[i]) / A[i, i]
            elif impulse < -dry[i]:
                new = (impulse + dry[i]) / A[i, i]
            change += abs(new - x[i])
            x[i] = new
        if change < 1e-15:
            break


def _run_loop(  # noqa: PLR0912
    chain: Any, drive: Any, held: Any, state: Any, command: Any, remaining: float, longest: float, work: Any, room: Any
) -> None:
    """Integrate over `remaining` [s] in steps of at most `longest` [s].

    held (3, joints): friction that jams a joint [N m]; damping between the joint and a hand that grips it [N m s/rad],
    0 if no hand grips it; the hand's velocity [rad/s].
    state (4, joints): angles, velocities, accelerations in the previous step, and currents; updated in place.
    """
    q, v, a, amps = state[0], state[1], state[2], state[3]
    M, bias = work[5], work[6]
    A, middle_q, middle_v, b, slid, new, dry, out = room
    n = q.size
    cut = rest = 0.0
    while remaining > SHORTEST_STEP:
        step = cut if cut > 0.0 else (rest if rest > 0.0 else min(longest, remaining))
        half = 0.5 * step
        is_jammed = False
        for j in range(n):
            is_jammed = is_jammed or held[0, j] > 0.0
            middle_q[j] = q[j] + half * v[j]
            middle_v[j] = v[j] + half * a[j] if v[j] != 0.0 else 0.0
            _push(drive, j, step, command[j], middle_q[j], middle_v[j], amps, out)
            out[0, j] += held[1, j] * (held[2, j] - middle_v[j])
            out[2, j] += held[1, j]
        _equations(chain, middle_q, middle_v, work)
        # (M + D) new = (M - D) v + step (force + slope middle_v) - dry, with D = step / 2 (viscous + slope).
        for i in range(n):
            M[i, i] += drive[ARMATURE, i]
            damp = half * (drive[VISCOUS, i] + out[2, i])
            total = step * (out[0, i] - bias[i] + out[2, i] * middle_v[i]) - damp * v[i]
            for j in range(n):
                total += M[i, j] * v[j]
                A[i, j] = M[i, j]
            b[i] = total
            dry[i] = step * (out[1, i] + held[0, i])
        for i in range(n):
            A[i, i] = M[i, i] = M[i, i] + half * (drive[VISCOUS, i] + out[2, i])
            slid[i] = b[i] - dry[i] if v[i] > 0.0 else b[i] + dry[i]
        _solve(A, slid, new)
        turning, first = False, 1.0
        for j in range(n):
            if dry[j] > 0.0 and new[j] * v[j] <= 0.0:
                turning = True
                if new[j] * v[j] < 0.0:
                    first = min(first, v[j] / (v[j] - new[j]))
        if turning:
            if cut == 0.0 and rest == 0.0:
                cut = step * first
                if SHORTEST_STEP < cut < step - SHORTEST_STEP:
                    rest = step - cut
                    continue
                cut = 0.0
            _stick(M, b, dry, new)
        for j in range(n):
            a[j] = 0.0 if is_jammed else (new[j] - v[j]) / step
            v[j] = new[j]
            q[j] = middle_q[j] + half * new[j]
            amps[j] = out[3, j]
        remaining -= step
        if cut > 0.0:
            cut = 0.0
        elif rest > 0.0:
            rest = 0.0


_inner: Any = numba.njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)  # type: ignore[call-overload]
_frames, _equations, _push, _solve, _stick = map(_inner, (_frames, _equations, _push, _solve, _stick))
equations: Callable[..., None] = _equations
run: Callable[..., None] = numba.njit(cache=True, nogil=True, error_model="numpy")(_run_loop)
