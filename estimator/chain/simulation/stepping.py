"""Compiled simulation of a chain under given motor torques, with derivatives.

Friction and drive are modelled as in `hil.estimator.simulation.arm`. Each step uses that module's Rosenbrock method
ROS2, with the second stage written so that each stage needs the regressor at one acceleration only. With f the torques
minus friction, S the slopes of friction, ID inverse dynamics, M the mass matrix, and primes for quantities at the end
of the step as predicted by the first stage,

    ID(q, v, k) + gamma h S k = f        ID(q', v', l + 2 k) + gamma h S' l = f'
    v += h (3 k + l) / 2                 q += h v + h^2 k / 2

This differs from ROS2 in the second stage's Jacobian and is still second-order. Differentiating both yields

    W dk = -(ID_q dq + ID_v dv + Y dp + ...)        W = M + gamma h S

so that one more parameter costs one more column. At each sample an observer moves the state towards the measured
angles, q += g (measured - q), v += g' (measured - q), and the derivatives with it; the residual before this correction
is the prediction error.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from hil.estimator.chain.model.kernels import accelerate, differentiate, invert, move, place, pull, regress
from hil.estimator.compiled import compiled, embedded
from hil.estimator.simulation.arm import FADED, GAMMA

# Rows of the joints' constants.
VISCOUS, COULOMB, OFFSET, WIDTH, RISE, FADING, LOAD, SCALE, ZERO = range(9)
JOINT_TERMS = (
    *("viscous", "coulomb", "offset", "coulomb_width", "stribeck_rise", "stribeck_velocity", "load"),
    *("torque_scale", "zero"),
)
NEAR = 6.0  # distance from standstill within which steps may be divided, in widths of the Coulomb step
CROSSED = 1.0  # number of these widths that a joint may cross in one step
WORST = 1e4  # rad or rad/s: a simulation that reaches this has diverged


def _left(p: Any, j: int, v: float, t: float, out: Any) -> None:
    """Write to `out` the torque of drive j minus friction and offset, and the slope and shape of friction."""
    motor = p[SCALE, j] * t
    ratio = v / p[FADING, j]
    past = ratio * ratio
    bump = math.exp(-past) if past < FADED else 0.0
    level = p[COULOMB, j] * (1.0 + p[RISE, j] * bump) + p[LOAD, j] * abs(motor)
    bend = math.tanh(v / p[WIDTH, j])
    bent = (1.0 - bend * bend) / p[WIDTH, j]
    out[0, j] = motor - p[OFFSET, j] - p[VISCOUS, j] * v - level * bend
    out[1, j] = p[VISCOUS, j] + level * bent
    out[2, j], out[3, j] = bump, bend


def _direct(
    p: Any,
    at: Any,
    j: int,
    v: float,
    t: float,
    left: Any,
    slopes: Any,
    times: Any,
    late: Any,
    ghk: float,
    by: Any,
    row: Any,
) -> None:
    """Compute the direct derivatives of joint j's step equation with respect to the drive's parameters; those with
    respect to v go to `by`.

    left: see `_left`. slopes: derivatives of the torque with respect to delay and each joint's lag. times: columns of
    the delay, lag and lag ratio of each joint. late: derivatives of each joint's lag with respect to joint 1's lag and
    the joint's ratio. ghk: gamma h times the stage's acceleration.
    """
    scale, width, fading = p[SCALE, j], p[WIDTH, j], p[FADING, j]
    motor = scale * t
    sign = 1.0 if motor > 0.0 else -1.0
    bump, bend = left[2, j], left[3, j]
    coulomb, rise, load = p[COULOMB, j], p[RISE, j], p[LOAD, j]
    level = coulomb * (1.0 + rise * bump) + load * abs(motor)
    bent = (1.0 - bend * bend) / width
    level_v = -2.0 * coulomb * rise * bump * v / (fading * fading)
    bent_v = -2.0 * bend * bent / width
    # The equation is ID - left + ghk slope = 0; each entry: the decrease in `left` plus ghk times the slope's increase.
    by[j] = p[VISCOUS, j] + level_v * bend + level * bent + ghk * (level_v * bent + level * bent_v)
    shape = bend + ghk * bent
    row[at[VISCOUS, j]] = v + ghk
    row[at[COULOMB, j]] = (1.0 + rise * bump) * shape
    row[at[OFFSET, j]] = 1.0
    bend_w = -v / width * bent
    bent_w = -(bent + 2.0 * bend * bend_w) / width
    row[at[WIDTH, j]] = level * (bend_w + ghk * bent_w)
    row[at[RISE, j]] = coulomb * bump * shape
    row[at[FADING, j]] = -level_v * v / fading * shape
    row[at[LOAD, j]] = abs(motor) * shape
    by_motor = load * sign * shape - 1.0
    row[at[SCALE, j]] = by_motor * t
    row[times[0, j]] = by_motor * scale * slopes[0, j]
    by_lag = by_motor * scale * slopes[1, j]
    row[times[1, j]] = by_lag * late[0, j]
    row[times[2, j]] = by_lag * late[1, j]


# These take whole arrays and indices: a view of a row costs as much as its arithmetic.
def _add_eight(out: Any, i: int, A: Any, X: Any, j: int, width: int) -> None:
    """Add the product of A (rows i and i + 1, columns j to j + 7) and X (rows j to j + 7) to rows i and i + 1 of out.

    Processing two rows at a time halves the number of reads of X.
    """
    a, b, c, d = A[i, j], A[i, j + 1], A[i, j + 2], A[i, j + 3]
    e, f, g, h = A[i, j + 4], A[i, j + 5], A[i, j + 6], A[i, j + 7]
    m = i + 1
    p, q, r, s = A[m, j], A[m, j + 1], A[m, j + 2], A[m, j + 3]
    t, u, v, w = A[m, j + 4], A[m, j + 5], A[m, j + 6], A[m, j + 7]
    for k in range(width):
        x0, x1, x2, x3 = X[j, k], X[j + 1, k], X[j + 2, k], X[j + 3, k]
        x4, x5, x6, x7 = X[j + 4, k], X[j + 5, k], X[j + 6, k], X[j + 7, k]
        out[i, k] += (a * x0 + b * x1) + (c * x2 + d * x3) + (e * x4 + f * x5) + (g * x6 + h * x7)
        out[m, k] += (p * x0 + q * x1) + (r * x2 + s * x3) + (t * x4 + u * x5) + (v * x6 + w * x7)


def _add_four(out: Any, i: int, A: Any, X: Any, j: int, width: int) -> None:
    m = i + 1
    a, b, c, d = A[i, j], A[i, j + 1], A[i, j + 2], A[i, j + 3]
    p, q, r, s = A[m, j], A[m, j + 1], A[m, j + 2], A[m, j + 3]
    for k in range(width):
        x0, x1, x2, x3 = X[j, k], X[j + 1, k], X[j + 2, k], X[j + 3, k]
        out[i, k] += (a * x0 + b * x1) + (c * x2 + d * x3)
        out[m, k] += (p * x0 + q * x1) + (r * x2 + s * x3)


def _multiply(A: Any, X: Any, inner: int, out: Any) -> None:
    """Set out = A X, with the first `inner` columns of A.

    The number of rows of `out` is even, and `inner` is a multiple of 4.
    """
    rows, width = out.shape
    for i in range(0, rows, 2):
        for k in range(width):
            out[i, k] = out[i + 1, k] = 0.0
        j = 0
        while j + 8 <= inner:
            _add_eight(out, i, A, X, j, width)
            j += 8
        if j < inner:
            _add_four(out, i, A, X, j, width)


def _solve_for(inverse: Any, mixed: Any, columns: int, first: int, A: Any) -> None:
    """Set A to -inverse [mixed, 1], with its columns in the order of the rows of `z` in `_run_loop`.

    mixed: coefficients of the derivatives of angles and velocities, then of the derivatives of accelerations, which
    start at row `first` of `z`. columns: number of these coefficients. Direct derivatives have the coefficient 1.
    """
    n = inverse.shape[0]
    for i in range(n):
        for c in range(columns):
            total = 0.0
            for j in range(n):
                total -= inverse[i, j] * mixed[j, c]
            A[i, c if c < 2 * n else first - 2 * n + c] = total
        for c in range(n):
            A[i, 2 * n + c] = -inverse[i, c]


def _stage(
    chain: Any, links: Any, p: Any, q: Any, v: Any, t: Any, before: Any, gh: float, found: Any, work: Any, solve: Any
) -> bool:
    """Solve ID(q, v, found + before) + gh S found = left for `found`; `solve` then holds the total acceleration."""
    rotation, translation, axis, gravity = chain
    link, armature = links
    left, matrix, inverse, factor, angle, total, rhs = solve
    n = q.size
    for j in range(n):
        angle[j] = q[j] + p[ZERO, j]
        _left(p, j, v[j], t[j], left)
    place(rotation, translation, axis, angle, work[0], work[1])
    move(link, armature, v, work)
    accelerate(armature, gravity, v, before, work)
    for i in range(n):
        for j in range(n):
            matrix[i, j] = work[4][i, j]
        matrix[i, i] += gh * left[1, i]
        rhs[i] = left[0, i] - work[5][i]
    if not invert(matrix, inverse, factor):
        return False
    for i in range(n):
        x = 0.0
        for j in range(n):
            x += inverse[i, j] * rhs[j]
        found[i] = x
        total[i] = x + before[i]
    return True


def _follow(
    chain: Any,
    links: Any,
    p: Any,
    v: Any,
    t: Any,
    slopes: Any,
    found: Any,
    gh: float,
    columns: Any,
    work: Any,
    solve: Any,
    by: Any,
    direct: Any,
) -> None:
    """Differentiate a solved stage's equation with respect to q and v (`work`) and the parameters (`direct`)."""
    base, at, times, late, tilts, falls = columns
    total = solve[5]
    accelerate(links[1], chain[3], v, total, work)
    differentiate(chain[3], work)
    regress(base, total, work, direct)
    for j in range(v.size):
        _direct(p, at, j, v[j], t[j], solve[0], slopes, times, late, gh * found[j], by, direct[j])
        work[7][j, j] += by[j]
    for j in range(v.size):
        column = at[ZERO, j]
        for i in range(v.size):
            direct[i, column] = work[6][i, j]
    for k in range(tilts.size):
        pull(falls[k], work, tilts[k], direct)


def _pieces(p: Any, v: Any, k: Any, step: float, most: int) -> int:
    """Return the number of smaller steps, at most `most`, into which to divide this step.

    A joint that may pass through the steep part of its friction crosses at most CROSSED widths per smaller step. A
    joint that sticks needs no smaller steps. k: last accelerations.
    """
    needed = 1.0
    for j in range(v.size):
        ahead = v[j] + 2.0 * step * k[j]
        if p[COULOMB, j] > 0.0 and (min(abs(v[j]), abs(ahead)) < NEAR * p[WIDTH, j] or v[j] * ahead < 0.0):
            needed = max(needed, step * abs(k[j]) / (CROSSED * p[WIDTH, j]))
    return int(min(math.ceil(needed), most))


def _broken(p: Any, v: Any, k: Any, t: Any, solve: Any, step: float, most: int) -> int:
    """Return the number of smaller steps, at most `most`, into which to divide a step after its first stage.

    `_pieces` cannot predict that a joint will break away from standstill. Friction at the end of the stage then differs
    from the tangent that the stage assumed; the velocity error that this difference causes is limited to CROSSED
    widths. k: accelerations of the stage. t: motor torques. solve: as `_stage` left it.
    """
    left, inverse = solve[0], solve[2]
    gh = GAMMA * step
    needed = 1.0
    for j in range(v.size):
        width = p[WIDTH, j]
        ahead = v[j] + step * k[j]
        if p[COULOMB, j] > 0.0 and (min(abs(v[j]), abs(ahead)) < NEAR * width or v[j] * ahead < 0.0):
            bend = math.tanh(ahead / width)
            steepness = (left[1, j] - p[VISCOUS, j]) * width  # level of dry friction times (1 - bend^2) before the step
            level = p[COULOMB, j] * (1.0 + p[RISE, j] * left[2, j]) + p[LOAD, j] * abs(p[SCALE, j] * t[j])
            wrong = abs(level * (bend - left[3, j]) - steepness * (ahead - v[j]) / width)
            inertia = 1.0 / inverse[j, j] + gh * (level * (1.0 - bend * bend) - steepness) / width
            needed = max(needed, step * wrong / (CROSSED * width * max(inertia, 1e-12)))
    return int(min(math.ceil(needed), most))


def _run_loop(  # noqa: PLR0912
    chain: Any,
    links: Any,
    p: Any,
    state: Any,
    torque: Any,
    slopes: Any,
    measured: Any,
    gain: Any,
    step: float,
    finer: int,
    columns: Any,
    room: Any,
    position: Any,
    derivative: Any,
) -> bool:
    """Simulate the samples of `torque` (samples, steps, joints) from `state` (2, joints); return False if it diverges.

    The results are written to `position` (samples, joints) and, if derivatives are requested, `derivative`
    (samples, joints, causes). A step in which a joint may come close to standstill is divided into up to `finer`
    smaller ones.

    The rows of `z` are the derivatives of angles and velocities, the direct derivatives of a stage's equation, and,
    from row `first` on, the derivatives of the first stage's accelerations; `dl` holds those of the second stage's.
    """
    work, solve, motion, by, z, first, dl, mixed, A = room
    q1, v1, k, m, nothing, ahead = motion
    q, v = state[0], state[1]
    n, causes, width = q.size, derivative.shape[2], z.shape[1]
    zq, zv, direct, dk = z[:n], z[n : 2 * n], z[2 * n : 3 * n], z[first : first + dl.shape[0]]
    for sample in range(torque.shape[0]):
        for j in range(n):
            position[sample, j] = q[j]
            if not abs(q[j]) + abs(v[j]) < WORST:
                return False
            for c in range(causes):
                derivative[sample, j, c] = zq[j, c]
        for j in range(n):
            miss = measured[sample, j] - q[j]
            if miss == miss:  # noqa: PLR0124  not missing
                q[j] += gain[0, j] * miss
                v[j] += gain[1, j] * miss
                if causes > 0:
                    for c in range(width):
                        zv[j, c] -= gain[1, j] * zq[j, c]
                        zq[j, c] *= 1.0 - gain[0, j]
        for s in range(torque.shape[1]):
            t = torque[sample, s]
            pieces = _pieces(p, v, k, step, finer)
            done = 0
            while done < pieces:
                h = step / pieces
                gh = GAMMA * h
                if not _stage(chain, links, p, q, v, t, nothing, gh, k, work, solve):
                    return False
                if pieces == 1 and finer > 1:
                    pieces = _broken(p, v, k, t, solve, step, finer)
                    if pieces > 1:
                        continue
                done += 1
                if causes > 0:
                    _follow(chain, links, p, v, t, slopes[sample, s], k, gh, columns, work, solve, by, direct)
                    for i in range(n):
                        for j in range(n):
                            mixed[i, j], mixed[i, n + j] = work[6][i, j], work[7][i, j]
                    _solve_for(solve[2], mixed, 2 * n, first, A)
                    _multiply(A, z, first, dk)
                for j in range(n):
                    q1[j], v1[j], ahead[j] = q[j] + h * v[j], v[j] + h * k[j], 2.0 * k[j]
                if not _stage(chain, links, p, q1, v1, t, ahead, gh, m, work, solve):
                    return False
                if causes > 0:
                    _follow(chain, links, p, v1, t, slopes[sample, s], m, gh, columns, work, solve, by, direct)
                    for i in range(n):
                        for j in range(n):
                            # Derivatives with respect to q, v, and k (through v' = v + h k and the acceleration).
                            mixed[i, j] = work[6][i, j]
                            mixed[i, n + j] = work[7][i, j] + h * work[6][i, j]
                            mixed[i, 2 * n + j] = h * work[7][i, j] + 2.0 * work[4][i, j]
                    _solve_for(solve[2], mixed, 3 * n, first, A)
                    _multiply(A, z, A.shape[1], dl)
                    for j in range(n):
                        for c in range(width):
                            zq[j, c] += h * zv[j, c] + 0.5 * h * h * dk[j, c]
                        for c in range(width):
                            zv[j, c] += h * (1.5 * dk[j, c] + 0.5 * dl[j, c])
                for j in range(n):
                    q[j] += h * v[j] + 0.5 * h * h * k[j]
                    v[j] += h * (1.5 * k[j] + 0.5 * m[j])
    return True


# Only the loop is called from Python. None of these functions allocates memory, so they need no reference counts, which
# in numba cost an atomic operation for every view of an array; without them, the code is a quarter faster.
_inner = partial(embedded, fastmath={"contract"}, _nrt=False)
_left, _direct, _add_eight, _add_four, _multiply, _solve_for, _stage, _follow, _pieces, _broken = map(
    _inner, (_left, _direct, _add_eight, _add_four, _multiply, _solve_for, _stage, _follow, _pieces, _broken)
)
run: Callable[..., bool] = compiled(_run_loop, fastmath={"contract"}, _nrt=False)
