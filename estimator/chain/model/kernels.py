"""Compiled rigid-body dynamics of a serial chain: torque and its derivatives, mass matrix, regressor.

The algorithms are recursive Newton-Euler and composite rigid bodies (Featherstone, Rigid Body Dynamics Algorithms,
2008), with all spatial vectors expressed about the base's origin, so that no transformation between links is needed:
motions are (angular, linear), forces (moment, force). The derivatives follow Singh, Russo and Wensing, IEEE Robotics
and Automation Letters 7 (2022) 1776. Only the product of their Coriolis matrix B with a motion w is needed; integrated
over the mass, it is

    2 B w = (2 (tr G - G) w_angular, 2 w_angular x l)       G = sum of dm velocity position^T, l the momentum,

so that twelve numbers per body replace the 36 of B. The regressor is that of Atkeson, An and Hollerbach, International
Journal of Robotics Research 5 (1986) 101, in link frames.

Every formula is linear in the inertial parameters, so base parameters, with all others zero, can replace them.
"""

import math
from functools import partial
from typing import Any

import numpy as np

from hil.estimator.compiled import compiled, embedded

# Rows of the array `motion` by joint, six numbers each.
AXIS, VELOCITY, ACCELERATION, SWEPT, CARRIED, CARRIED_AGAIN = range(6)
# Columns of the array `body` by link: mass; first moment; inertia (xx xy xz yy yz zz) about the base's origin; linear
# momentum; G by rows; force (moment, force).
MASS, MOMENT, INERTIA, MOMENTUM, FLOW, FORCE, BODY = 0, 1, 4, 10, 13, 22, 28


def room(joints: int) -> Any:
    """Return the work arrays for the functions below.

    frame    rotation matrix (row by row) and origin of each link (joints, 12)
    motion   joint axis; velocity; acceleration, with gravity as an upward acceleration; time derivative of the axis;
             cross products of the previous link's velocity and of its acceleration with the axis (joints, 6, 6)
    body     columns MASS to FORCE; single links, then composites (2, joints, BODY)
    seized   composite inertia times axis (joints, 6)
    mass     mass matrix (joints, joints)
    torque   (joints,)
    by_q, by_v  derivatives of the torque (joints, joints)
    spare    motions and forces within `differentiate` (5, 6)
    """
    n = joints
    shapes = (n, 12), (n, 6, 6), (2, n, BODY), (n, 6), (n, n), (n,), (n, n), (n, n), (5, 6)
    return tuple(np.zeros(shape) for shape in shapes)


def _cross(a: Any, b: Any, out: Any) -> None:
    """Set out = a x b (motion cross product): the rate of change of b in a body moving with a."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    out[3] = a[1] * b[5] - a[2] * b[4] + a[4] * b[2] - a[5] * b[1]
    out[4] = a[2] * b[3] - a[0] * b[5] + a[5] * b[0] - a[3] * b[2]
    out[5] = a[0] * b[4] - a[1] * b[3] + a[3] * b[1] - a[4] * b[0]


def _dot(a: Any, b: Any) -> float:
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
    return product


def _push(b: Any, x: Any, out: Any) -> None:
    """Set out = inertia of body b times the motion x."""
    h0, h1, h2 = b[1], b[2], b[3]
    out[0] = b[4] * x[0] + b[5] * x[1] + b[6] * x[2] + h1 * x[5] - h2 * x[4]
    out[1] = b[5] * x[0] + b[7] * x[1] + b[8] * x[2] + h2 * x[3] - h0 * x[5]
    out[2] = b[6] * x[0] + b[8] * x[1] + b[9] * x[2] + h0 * x[4] - h1 * x[3]
    out[3] = b[0] * x[3] + x[1] * h2 - x[2] * h1
    out[4] = b[0] * x[4] + x[2] * h0 - x[0] * h2
    out[5] = b[0] * x[5] + x[0] * h1 - x[1] * h0


def place(rotation: Any, translation: Any, axis: Any, q: Any, frame: Any, motion: Any) -> None:
    """Compute frames and joint axes at the angles q."""
    for i in range(q.size):
        f = frame[i]
        if i == 0:
            for r in range(3):
                f[9 + r] = translation[0, r]
                for c in range(3):
                    f[3 * r + c] = rotation[0, r, c]
        else:
            p, t, turn = frame[i - 1], translation[i], rotation[i]
            for r in range(3):
                f[9 + r] = p[9 + r] + p[3 * r] * t[0] + p[3 * r + 1] * t[1] + p[3 * r + 2] * t[2]
                for c in range(3):
                    f[3 * r + c] = p[3 * r] * turn[0, c] + p[3 * r + 1] * turn[1, c] + p[3 * r + 2] * turn[2, c]
        x, y, z = axis[i, 0], axis[i, 1], axis[i, 2]
        s = motion[i, AXIS]
        for r in range(3):
            s[r] = f[3 * r] * x + f[3 * r + 1] * y + f[3 * r + 2] * z
        s[3] = f[10] * s[2] - f[11] * s[1]
        s[4] = f[11] * s[0] - f[9] * s[2]
        s[5] = f[9] * s[1] - f[10] * s[0]
        # Rodrigues' rotation about the axis in the joint's own frame.
        cosine, sine = math.cos(q[i]), math.sin(q[i])
        rest = 1.0 - cosine
        for r in range(3):
            a, b, c = f[3 * r], f[3 * r + 1], f[3 * r + 2]
            along = rest * (a * x + b * y + c * z)
            f[3 * r] = cosine * a + along * x + sine * (b * z - c * y)
            f[3 * r + 1] = cosine * b + along * y + sine * (c * x - a * z)
            f[3 * r + 2] = cosine * c + along * z + sine * (a * y - b * x)


def _carry(link: Any, f: Any, b: Any) -> None:
    """Transform a link's mass, moment and inertia from its own frame f to the base's origin and axes."""
    m = link[0]
    px, py, pz = f[9], f[10], f[11]
    hx = f[0] * link[1] + f[1] * link[2] + f[2] * link[3]
    hy = f[3] * link[1] + f[4] * link[2] + f[5] * link[3]
    hz = f[6] * link[1] + f[7] * link[2] + f[8] * link[3]
    b[0], b[1], b[2], b[3] = m, hx + m * px, hy + m * py, hz + m * pz
    k = 4
    for r in range(3):
        a0, a1, a2 = f[3 * r], f[3 * r + 1], f[3 * r + 2]
        u0 = a0 * link[4] + a1 * link[5] + a2 * link[6]
        u1 = a0 * link[5] + a1 * link[7] + a2 * link[8]
        u2 = a0 * link[6] + a1 * link[8] + a2 * link[9]
        for c in range(r, 3):
            b[k] = u0 * f[3 * c] + u1 * f[3 * c + 1] + u2 * f[3 * c + 2]
            k += 1
    b[4] += m * (py * py + pz * pz) + 2.0 * (hy * py + hz * pz)
    b[5] -= m * px * py + hx * py + px * hy
    b[6] -= m * px * pz + hx * pz + px * hz
    b[7] += m * (px * px + pz * pz) + 2.0 * (hx * px + hz * pz)
    b[8] -= m * py * pz + hy * pz + py * hz
    b[9] += m * (px * px + py * py) + 2.0 * (hx * px + hy * py)


def move(link: Any, armature: Any, v: Any, room: Any) -> None:
    """Compute velocities, bodies, composites and the mass matrix; call `place` first.

    link: (joints, 10). armature: (joints,). v: joint velocities (joints,).
    """
    frame, motion, body, seized, mass, _, _, _, _ = room
    n = v.size
    for i in range(n):
        s, w = motion[i, AXIS], motion[i, VELOCITY]
        for r in range(6):
            w[r] = s[r] * v[i] + (motion[i - 1, VELOCITY, r] if i > 0 else 0.0)
        _cross(w, s, motion[i, SWEPT])
        b = body[0, i]
        _carry(link[i], frame[i], b)
        # Momentum, and G = u h' + omega x (half tr J - J).
        b[10] = b[0] * w[3] + w[1] * b[3] - w[2] * b[2]
        b[11] = b[0] * w[4] + w[2] * b[1] - w[0] * b[3]
        b[12] = b[0] * w[5] + w[0] * b[2] - w[1] * b[1]
        half = 0.5 * (b[4] + b[7] + b[9])
        xx, yy, zz, xy, xz, yz = half - b[4], half - b[7], half - b[9], -b[5], -b[6], -b[8]
        b[13] = w[3] * b[1] + w[1] * xz - w[2] * xy
        b[14] = w[3] * b[2] + w[1] * yz - w[2] * yy
        b[15] = w[3] * b[3] + w[1] * zz - w[2] * yz
        b[16] = w[4] * b[1] + w[2] * xx - w[0] * xz
        b[17] = w[4] * b[2] + w[2] * xy - w[0] * yz
        b[18] = w[4] * b[3] + w[2] * xz - w[0] * zz
        b[19] = w[5] * b[1] + w[0] * xy - w[1] * xx
        b[20] = w[5] * b[2] + w[0] * yy - w[1] * xy
        b[21] = w[5] * b[3] + w[0] * yz - w[1] * xz
    for i in range(n - 1, -1, -1):
        b = body[1, i]
        for r in range(FORCE):
            b[r] = body[0, i, r] + (body[1, i + 1, r] if i < n - 1 else 0.0)
        _push(b, motion[i, AXIS], seized[i])
        for j in range(i + 1):
            mass[i, j] = mass[j, i] = _dot(seized[i], motion[j, AXIS])
        mass[i, i] += armature[i]


def accelerate(armature: Any, gravity: Any, v: Any, a: Any, room: Any) -> None:
    """Compute the torques required for the accelerations a (joints,); call `move` first."""
    _, motion, body, _, _, torque, _, _, _ = room
    n = a.size
    for i in range(n):
        x, w, b = motion[i, ACCELERATION], motion[i, VELOCITY], body[0, i]
        for r in range(6):
            before = motion[i - 1, ACCELERATION, r] if i > 0 else (-gravity[r - 3] if r > 2 else 0.0)
            x[r] = before + motion[i, AXIS, r] * a[i] + motion[i, SWEPT, r] * v[i]
        f = b[FORCE:BODY]
        _push(b, x, f)
        # v x* (I v); the linear part of the momentum is already available.
        l0, l1, l2 = b[10], b[11], b[12]
        k0 = b[4] * w[0] + b[5] * w[1] + b[6] * w[2] + b[2] * w[5] - b[3] * w[4]
        k1 = b[5] * w[0] + b[7] * w[1] + b[8] * w[2] + b[3] * w[3] - b[1] * w[5]
        k2 = b[6] * w[0] + b[8] * w[1] + b[9] * w[2] + b[1] * w[4] - b[2] * w[3]
        f[0] += w[1] * k2 - w[2] * k1 + w[4] * l2 - w[5] * l1
        f[1] += w[2] * k0 - w[0] * k2 + w[5] * l0 - w[3] * l2
        f[2] += w[0] * k1 - w[1] * k0 + w[3] * l1 - w[4] * l0
        f[3] += w[1] * l2 - w[2] * l1
        f[4] += w[2] * l0 - w[0] * l2
        f[5] += w[0] * l1 - w[1] * l0
    for i in range(n - 1, -1, -1):
        for r in range(FORCE, BODY):
            body[1, i, r] = body[0, i, r] + (body[1, i + 1, r] if i < n - 1 else 0.0)
        torque[i] = _dot(body[1, i, FORCE:BODY], motion[i, AXIS]) + armature[i] * a[i]


def differentiate(gravity: Any, room: Any) -> None:
    """Compute the torques' derivatives with respect to angles and velocities, at the accelerations last passed to
    `accelerate`.
    """
    _, motion, body, seized, _, _, by_q, by_v, spare = room
    n = motion.shape[0]
    still, falling, force, forced, both = spare[0], spare[1], spare[2], spare[3], spare[4]
    falling[3], falling[4], falling[5] = -gravity[0], -gravity[1], -gravity[2]
    for i in range(n):
        s = motion[i, AXIS]
        w = motion[i - 1, VELOCITY] if i > 0 else still
        x = motion[i - 1, ACCELERATION] if i > 0 else falling
        once, again = motion[i, CARRIED], motion[i, CARRIED_AGAIN]
        _cross(w, s, once)
        _cross(w, once, again)
        _cross(x, s, both)
        for r in range(6):
            again[r] += both[r]
    for i in range(n):
        b, s = body[1, i], motion[i, AXIS]
        once, again, swept = motion[i, CARRIED], motion[i, CARRIED_AGAIN], motion[i, SWEPT]
        trace = b[13] + b[17] + b[21]
        _push(b, again, force)
        _flow(b, trace, once, force)
        # axis x* force of the composite
        f = b[FORCE:BODY]
        force[0] += s[1] * f[2] - s[2] * f[1] + s[4] * f[5] - s[5] * f[4]
        force[1] += s[2] * f[0] - s[0] * f[2] + s[5] * f[3] - s[3] * f[5]
        force[2] += s[0] * f[1] - s[1] * f[0] + s[3] * f[4] - s[4] * f[3]
        force[3] += s[1] * f[5] - s[2] * f[4]
        force[4] += s[2] * f[3] - s[0] * f[5]
        force[5] += s[0] * f[4] - s[1] * f[3]
        for r in range(6):
            both[r] = once[r] + swept[r]
        _push(b, both, forced)
        _flow(b, trace, s, forced)
        # (2 B)' axis has an angular part only.
        d0 = 2.0 * (trace * s[0] - b[13] * s[0] - b[16] * s[1] - b[19] * s[2] + b[11] * s[5] - b[12] * s[4])
        d1 = 2.0 * (trace * s[1] - b[14] * s[0] - b[17] * s[1] - b[20] * s[2] + b[12] * s[3] - b[10] * s[5])
        d2 = 2.0 * (trace * s[2] - b[15] * s[0] - b[18] * s[1] - b[21] * s[2] + b[10] * s[4] - b[11] * s[3])
        for j in range(i + 1):
            t, o, e, u = motion[j, AXIS], motion[j, CARRIED], motion[j, CARRIED_AGAIN], motion[j, SWEPT]
            by_q[i, j] = d0 * o[0] + d1 * o[1] + d2 * o[2] + _dot(seized[i], e)
            by_v[i, j] = d0 * t[0] + d1 * t[1] + d2 * t[2] + _dot(seized[i], o) + _dot(seized[i], u)
            if j < i:
                by_q[j, i] = _dot(t, force)
                by_v[j, i] = _dot(t, forced)


def _flow(b: Any, trace: float, w: Any, out: Any) -> None:
    out[0] += 2.0 * (trace * w[0] - b[13] * w[0] - b[14] * w[1] - b[15] * w[2])
    out[1] += 2.0 * (trace * w[1] - b[16] * w[0] - b[17] * w[1] - b[18] * w[2])
    out[2] += 2.0 * (trace * w[2] - b[19] * w[0] - b[20] * w[1] - b[21] * w[2])
    out[3] += 2.0 * (w[1] * b[12] - w[2] * b[11])
    out[4] += 2.0 * (w[2] * b[10] - w[0] * b[12])
    out[5] += 2.0 * (w[0] * b[11] - w[1] * b[10])


def regress(column: Any, a: Any, room: Any, Y: Any) -> None:
    """Compute the regressor Y (joints, columns) at the accelerations last passed to `accelerate`.

    column (joints, 11): column of Y for each of a link's parameters and the armature; unwanted columns are written but
    never read. Entries that are always zero are not written.
    """
    frame, motion = room[0], room[1]
    n = a.size
    for i in range(n):
        f, w, x, at = frame[i], motion[i, VELOCITY], motion[i, ACCELERATION], column[i]
        px, py, pz = f[9], f[10], f[11]
        # Velocity and acceleration of the link's origin, then everything in the link's own frame.
        ux, uy, uz = w[3] + w[1] * pz - w[2] * py, w[4] + w[2] * px - w[0] * pz, w[5] + w[0] * py - w[1] * px
        gx = x[3] + x[1] * pz - x[2] * py + w[1] * uz - w[2] * uy
        gy = x[4] + x[2] * px - x[0] * pz + w[2] * ux - w[0] * uz
        gz = x[5] + x[0] * py - x[1] * px + w[0] * uy - w[1] * ux
        w0, w1, w2 = _into(f, w[0], w[1], w[2])
        e0, e1, e2 = _into(f, x[0], x[1], x[2])
        g0, g1, g2 = _into(f, gx, gy, gz)
        # Force per moment: angular acceleration x + omega x omega x.
        a00, a11, a22 = -w1 * w1 - w2 * w2, -w0 * w0 - w2 * w2, -w0 * w0 - w1 * w1
        a01, a10 = w0 * w1 - e2, w0 * w1 + e2
        a02, a20 = w0 * w2 + e1, w0 * w2 - e1
        a12, a21 = w1 * w2 - e0, w1 * w2 + e0
        for j in range(i + 1):
            s, row = motion[j, AXIS], Y[j]
            z0, z1, z2 = _into(f, s[0], s[1], s[2])
            b0, b1, b2 = _into(
                f, s[3] + s[1] * pz - s[2] * py, s[4] + s[2] * px - s[0] * pz, s[5] + s[0] * py - s[1] * px
            )
            u0, u1, u2 = z1 * w2 - z2 * w1, z2 * w0 - z0 * w2, z0 * w1 - z1 * w0
            row[at[0]] = b0 * g0 + b1 * g1 + b2 * g2
            row[at[1]] = a00 * b0 + a10 * b1 + a20 * b2 + g1 * z2 - g2 * z1
            row[at[2]] = a01 * b0 + a11 * b1 + a21 * b2 + g2 * z0 - g0 * z2
            row[at[3]] = a02 * b0 + a12 * b1 + a22 * b2 + g0 * z1 - g1 * z0
            row[at[4]] = z0 * e0 + u0 * w0
            row[at[5]] = z0 * e1 + z1 * e0 + u0 * w1 + u1 * w0
            row[at[6]] = z0 * e2 + z2 * e0 + u0 * w2 + u2 * w0
            row[at[7]] = z1 * e1 + u1 * w1
            row[at[8]] = z1 * e2 + z2 * e1 + u1 * w2 + u2 * w1
            row[at[9]] = z2 * e2 + u2 * w2
        Y[i, at[10]] = a[i]


def pull(gravity: Any, room: Any, column: int, out: Any) -> None:
    """Set a column of `out` (joints, columns) to the torques that hold all links still under the given gravity.

    Call `move` first. The torques are linear in gravity, so passing a change in gravity yields the change in the
    torques.
    """
    motion, body = room[1], room[2]
    x, y, z = -gravity[0], -gravity[1], -gravity[2]
    for i in range(motion.shape[0]):
        s, b = motion[i, AXIS], body[1, i]
        out[i, column] = (
            (s[0] * (b[2] * z - b[3] * y) + s[1] * (b[3] * x - b[1] * z) + s[2] * (b[1] * y - b[2] * x))
            + b[0] * (s[3] * x + s[4] * y + s[5] * z)
        )  # fmt: skip


def _into(f: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Rotate a vector into the link's own frame."""
    return (
        f[0] * x + f[3] * y + f[6] * z,
        f[1] * x + f[4] * y + f[7] * z,
        f[2] * x + f[5] * y + f[8] * z,
    )


def invert(matrix: Any, inverse: Any, factor: Any) -> bool:  # noqa: PLR0912
    """Invert a symmetric matrix by its Cholesky factor; return False if the matrix is not positive definite."""
    n = matrix.shape[0]
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = 1.0 / math.sqrt(total)
            else:
                factor[i, j] = total * factor[j, j]
    for column in range(n):
        for i in range(column, n):
            total = 1.0 if i == column else 0.0
            for k in range(column, i):
                total -= factor[i, k] * inverse[k, column]
            inverse[i, column] = total * factor[i, i]
    # The lower triangle now holds the factor's inverse.
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, n):
                total += inverse[k, i] * inverse[k, j]
            factor[i, j] = total
    for i in range(n):
        for j in range(i + 1):
            inverse[i, j] = inverse[j, i] = factor[i, j]
    return True


# Functions called only from compiled code need no wrappers for C. The large ones are used by several loops and are
# cached, so that a program that later needs another of these loops does not compile them again.
_PLAIN: dict[str, Any] = {"fastmath": {"contract"}, "_nrt": False}
_inner = partial(embedded, **_PLAIN)
_cross, _dot, _push, _carry, _flow, _into = map(_inner, (_cross, _dot, _push, _carry, _flow, _into))
place, move, accelerate, differentiate, regress, pull, invert = (
    compiled(each, no_cfunc_wrapper=True, **_PLAIN)
    for each in (place, move, accelerate, differentiate, regress, pull, invert)
)
