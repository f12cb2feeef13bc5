"""Forward sensitivities: the simulated motion and its derivatives with respect to parameters and initial state.

The derivative is that of the discrete scheme of `hil.estimator.simulation.arm`, step by step, so it is the exact
gradient of the objective. With W = M + gamma h S (M mass matrix, S slopes of friction) and primes for quantities at the
end of the step as predicted by its first stage, a step is

    W k = f        M' a = f'        W l = M (a - 2 k)        v += h (3 k + l) / 2        q += h v + h^2 k / 2

A parameter only enters through the residuals of W k = f, of M' a = f' and of the third equation. Changing them by r, g,
e changes the new velocity by A r + B g + C e, where A, B and C are two-by-two matrices common to all parameters.
Therefore each further parameter costs a few dozen operations per step instead of another simulation.

For vector instructions, rows of derivatives are WIDE elements apart in one-dimensional arrays, and are processed one
step behind the rest, since reading several values at a time stalls if they have just been written one by one.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, embedded
from hil.estimator.models.parameters import CONSTANTS, ENCODER, Physics
from hil.estimator.simulation.arm import (
    ASYMMETRY,
    CABLE,
    COG_COSINE,
    COG_CYCLES,
    COG_SINE,
    COSINE,
    COULOMB,
    CYCLES,
    FADING,
    GAMMA,
    GENERATED,
    LOAD,
    MAX_SUBSTEPS,
    OFFSET,
    RISE,
    SATURATION,
    SCALE,
    SINE,
    VISCOUS,
    WIDTH,
    ZERO,
    bend_at,
    bump_at,
    finer_pieces,
    pieces_now,
)

# Quantities with respect to which the motion can be differentiated: the constants, the drive's times, encoder errors
# that move the ends of the springs, the state at the first sample.
TRACKED = tuple(f"{name}_{joint}" for name in ENCODER for joint in (1, 2))
STATES = ("position_1", "position_2", "velocity_1", "velocity_2")
CAUSES = (*CONSTANTS, "delay", "lag", "lag_difference_2", *TRACKED, *STATES)
DELAY, LAG_DIFFERENCE, END = len(CONSTANTS), len(CONSTANTS) + 2, len(CONSTANTS) + 3
STATE = END + len(TRACKED)
COUPLING, GRAVITY_1, GRAVITY_2 = map(CONSTANTS.index, ("coupling", "gravity_1", "gravity_2"))
ZERO_1, ZERO_2 = ZERO, ZERO + 1

AT_ONCE = 8  # causes that a processor can handle at once; their number is padded to a multiple of this
NOWHERE = AT_ONCE * math.ceil(len(CAUSES) / AT_ONCE)  # column for unwanted derivatives
WIDE = NOWHERE + AT_ONCE
# Rows of each step, with causes as columns: f1, f2, slope_1, slope_2, m11, m12, m22 of stage 1, then of stage 2.
STAGE = 7 * WIDE
SLOPES, MASSES = 2 * WIDE, 4 * WIDE  # offsets from the stage's first row
# Scalars of each step. For each stage, derivatives with respect to the state: f1 and f2 to q1, q2, v1, v2; slope_1 to
# q1, v1; slope_2 to q2, v2; m11 and m12 to q2. Then scalars common to all parameters, see `arm_step`.
BY_STATE = 14
NUMBERS = 2 * BY_STATE + 24


class Sensitive:
    """A simulation with derivatives that advances piece by piece, so that long recordings need little memory.

    physics: physical constants.
    start: angles [rad] and velocities [rad/s] at the first sample (2, joints).
    causes: names of the quantities with respect to which to differentiate, from CAUSES.
    step: length of an integration step [s].
    max_substeps: maximum number of substeps into which a step is divided near standstill.
    tracking_stiffness: stiffness of additional springs that pull the joints to given angles (joints,) [N m/rad].
    held: whether joints that are held by friction take longer substeps.
    """

    def __init__(
        self,
        physics: Physics,
        start: Array,
        causes: tuple[str, ...],
        step: float,
        max_substeps: int = MAX_SUBSTEPS,
        tracking_stiffness: Array | None = None,
        held: bool = False,
    ) -> None:
        self._joints = start.shape[1]
        self._count = len(causes)
        self._constants = physics.vector
        self._step = step
        self._pieces = finer_pieces(physics, step, max_substeps)
        self._held = held
        self._state = np.zeros((2, 2))
        self._state[:, : self._joints] = start
        self._places: npt.NDArray[np.int64] = np.full(len(CAUSES), NOWHERE)
        self._places[[CAUSES.index(name) for name in causes]] = np.arange(len(causes))
        z = np.zeros((4, WIDE))
        z[np.arange(4), self._places[STATE:]] = 1.0
        # Rows and scalars of two steps, one of which waits to be processed by `follow`; initially nothing changes.
        rows = np.zeros((4, 7, WIDE))
        # The mass matrix, m11, m12 and m22, is linear in the inertias.
        for row, inertia in ((4, 0), (4, 2), (5, 2), (6, 2), (6, 3)):
            rows[:, row, self._places[inertia]] = 1.0
        spring = np.zeros((2 + len(ENCODER), 2))
        spring[0, : self._joints] = 0.0 if tracking_stiffness is None else tracking_stiffness
        self._room = (rows.reshape(-1), np.zeros(2 * NUMBERS), *np.zeros((4, 2, 2)), spring, self._places)
        self._z = z.reshape(-1)
        self._turn = np.zeros(1, dtype=np.int64)

    def advance(
        self, torque: Array, torque_slopes: Array, tracked: Array | None = None, tracked_slopes: Array | None = None
    ) -> tuple[Array, Array]:
        """Simulate as many samples as `torque` has.

        Args:
            torque: mean motor torque over each of the steps that follow a sample (joints, samples, steps) [N m].
            torque_slopes: its derivatives with respect to delay and each joint's lag (2, joints, samples, steps)
                [N m/s].
            tracked: angles to which the springs pull, held between samples (joints, samples) [rad].
            tracked_slopes: their derivatives with respect to the encoder errors of the same joint (joints, samples,
                errors).

        Returns:
            The angles (joints, samples) [rad] and their derivatives (joints, samples, causes).
        """
        joints, samples, steps = torque.shape
        both = np.zeros((2, samples, steps))
        both[:joints] = torque
        slopes = np.zeros((2, 2, samples, steps))
        slopes[:, :joints] = torque_slopes
        ends = np.zeros((2, samples, 1 + len(ENCODER)))
        ends[:joints, :, 0] = 0.0 if tracked is None else tracked
        ends[:joints, :, 1:] = 0.0 if tracked_slopes is None else tracked_slopes
        position = np.empty((2, samples))
        derivative = np.empty((2, samples, self._count))
        self._go_on(
            *(self._constants, self._state, both, slopes, ends, self._step, self._pieces, self._held),
            *(self._room, self._z, self._turn, position, derivative),
        )
        return position[:joints], derivative[:joints]

    def _go_on(self, *given: Any) -> None:
        _advance(*given)


# Compiled code takes its arguments by position; p is `Physics.vector`, joint and stage are 0 or 1, and `now` (0 or 1)
# selects the step's rows and scalars. `room` consists of
#   rows, numbers  rows and scalars as above, flattened
#   here           angles and velocities at which the stage is evaluated (2, joints)
#   left, slope    torques available for acceleration and slopes of friction (stages, joints)
#   dt             derivatives of the motor torques with respect to delay and lag (causes, joints)
#   spring         stiffness and target angle of the springs; derivatives of the target with respect to encoder errors
#   at             the column of each cause
def _drive(p: Any, joint: int, stage: int, now: int, t: float, room: Any) -> None:  # noqa: PLR0915 a call costs time
    """Write a drive's torque minus friction, the slope of friction, and all derivatives to `room`."""
    rows, numbers, here, left, slope, dt, _, at = room
    q, v = here[0, joint], here[1, joint]
    viscous, coulomb, offset, width = p[VISCOUS + joint], p[COULOMB + joint], p[OFFSET + joint], p[WIDTH + joint]
    rise, fading, load, asymmetry = p[RISE + joint], p[FADING + joint], p[LOAD + joint], p[ASYMMETRY + joint]
    ripple_sin, ripple_cos, cycles = p[SINE + joint], p[COSINE + joint], p[CYCLES + joint]
    commanded, scale, per_speed = t, p[SCALE + joint], p[GENERATED + joint]
    t = scale * t - per_speed * v
    cube, eased = t * t * t, 1.0 - 3.0 * p[SATURATION + joint] * t * t
    t -= p[SATURATION + joint] * cube
    sine, cosine, shape = 0.0, 1.0, 1.0
    if cycles != 0.0:
        sine, cosine = math.sin(cycles * q), math.cos(cycles * q)
        shape = 1.0 + ripple_sin * sine + ripple_cos * cosine
    motor, turn = t * shape, t * (ripple_sin * cosine - ripple_cos * sine)
    loaded = load if motor > 0.0 else -load
    sharp, slow = 1.0 / width, 1.0 / fading
    bump = bump_at(v * slow)
    raised = 1.0 + rise * bump
    level = coulomb * raised + load * abs(motor)
    dry = asymmetry * v + level
    level_v = -2.0 * coulomb * rise * bump * v * slow * slow
    level_f = -level_v * v * slow
    bend, bent = bend_at(v, sharp)
    bent_v, bend_w = -2.0 * bend * bent * sharp, -v * sharp * bent
    passed = 1.0 - loaded * bend
    f = (2 * now + stage) * STAGE + joint * WIDE
    s = f + SLOPES
    rows[f + at[VISCOUS + joint]], rows[s + at[VISCOUS + joint]] = -v, 1.0
    rows[f + at[COULOMB + joint]], rows[s + at[COULOMB + joint]] = -raised * bend, raised * bent
    rows[f + at[OFFSET + joint]], rows[f + at[WIDTH + joint]] = -1.0, -dry * bend_w
    rows[s + at[WIDTH + joint]] = -level * (bent + 2.0 * bend * bend_w) * sharp
    rows[f + at[RISE + joint]], rows[s + at[RISE + joint]] = -coulomb * bump * bend, coulomb * bump * bent
    rows[f + at[FADING + joint]], rows[s + at[FADING + joint]] = -level_f * bend, level_f * bent
    # Writing these values takes longer than computing them, so unwanted ones are skipped.
    if at[LOAD + joint] != NOWHERE:
        rows[f + at[LOAD + joint]], rows[s + at[LOAD + joint]] = -abs(motor) * bend, abs(motor) * bent
    if at[ASYMMETRY + joint] != NOWHERE:
        rows[f + at[ASYMMETRY + joint]] = -v * bend
    if min(at[SINE + joint], at[COSINE + joint], at[CYCLES + joint]) < NOWHERE:
        rows[f + at[SINE + joint]], rows[s + at[SINE + joint]] = t * sine * passed, t * sine * loaded * bent
        rows[f + at[COSINE + joint]], rows[s + at[COSINE + joint]] = t * cosine * passed, t * cosine * loaded * bent
        rows[f + at[CYCLES + joint]], rows[s + at[CYCLES + joint]] = q * turn * passed, q * turn * loaded * bent
    if at[SCALE + joint] != NOWHERE:
        given = commanded * eased * shape
        rows[f + at[SCALE + joint]], rows[s + at[SCALE + joint]] = given * passed, given * loaded * bent
    if at[SATURATION + joint] != NOWHERE:
        lost = -cube * shape
        rows[f + at[SATURATION + joint]], rows[s + at[SATURATION + joint]] = lost * passed, lost * loaded * bent
    # With respect to the torque before saturation and ripple, which includes the back-EMF.
    driven, driven_slope = eased * shape * passed, eased * shape * loaded * bent
    if at[GENERATED + joint] != NOWHERE:
        rows[f + at[GENERATED + joint]], rows[s + at[GENERATED + joint]] = v - v * driven, -v * driven_slope
    if at[CABLE + joint] != NOWHERE:
        rows[f + at[CABLE + joint]] = -q
    cogging, cogging_q, cogs = 0.0, 0.0, p[COG_CYCLES + joint]
    if cogs != 0.0:
        sine, cosine = math.sin(cogs * q), math.cos(cogs * q)
        cogging = p[COG_SINE + joint] * sine + p[COG_COSINE + joint] * cosine
        cogging_q = p[COG_SINE + joint] * cosine - p[COG_COSINE + joint] * sine
        rows[f + at[COG_SINE + joint]], rows[f + at[COG_COSINE + joint]] = sine, cosine
        rows[f + at[COG_CYCLES + joint]] = q * cogging_q
    for cause in range(2):
        given = scale * eased * shape * dt[cause, joint]
        rows[f + at[DELAY + cause]], rows[s + at[DELAY + cause]] = given * passed, given * loaded * bent
    if joint == 1:
        # `given` still holds the derivative with respect to the joint's own lag.
        rows[f + at[LAG_DIFFERENCE]], rows[s + at[LAG_DIFFERENCE]] = given * passed, given * loaded * bent
    cable = p[CABLE + joint]
    left[stage, joint] = motor + cogging - offset - cable * q - (viscous - per_speed) * v - dry * bend
    slope[stage, joint] = viscous + level * bent
    left_by = now * NUMBERS + stage * BY_STATE + 5 * joint
    slope_by = left_by + 8 - 3 * joint
    numbers[left_by] = cycles * turn * passed + cogs * cogging_q - cable
    numbers[left_by + 2] = per_speed * (1.0 - driven) - viscous - dry * bent - (asymmetry + level_v) * bend
    numbers[slope_by] = cycles * turn * loaded * bent
    numbers[slope_by + 1] = level_v * bent + level * bent_v - per_speed * driven_slope


def _arm(p: Any, stage: int, now: int, t1: float, t2: float, room: Any) -> tuple[float, float]:
    """Return the first row of the mass matrix; write torques, slopes of friction and all derivatives to `room`.

    t1, t2: motor torques [N m].
    """
    rows, numbers, here, left, _, _, spring, at = room
    for joint in range(2):
        _drive(p, joint, stage, now, t1 if joint == 0 else t2, room)
    q1, q2, v1, v2 = here[0, 0] + p[ZERO_1], here[0, 1] + p[ZERO_2], here[1, 0], here[1, 1]
    cos_1, sin_1, cos_2, sin_2 = math.cos(q1), math.sin(q1), math.cos(q2), math.sin(q2)
    cos_12, sin_12 = cos_1 * cos_2 - sin_1 * sin_2, sin_1 * cos_2 + cos_1 * sin_2
    across, turning = p[COUPLING] * cos_2, p[COUPLING] * sin_2
    fall_1, fall_12 = p[GRAVITY_1] * sin_1, p[GRAVITY_2] * sin_12
    whirl = (2.0 * v1 + v2) * v2
    f1_q2, f2_q2 = fall_12 + across * whirl, fall_12 - across * v1 * v1
    for joint in range(2):
        left[stage, joint] += spring[0, joint] * (spring[1, joint] - here[0, joint])
        if spring[0, joint] != 0.0:
            f = (2 * now + stage) * STAGE + joint * WIDE
            for error in range(spring.shape[0] - 2):
                rows[f + at[END + 2 * error + joint]] = spring[0, joint] * spring[2 + error, joint]
    left[stage, 0] += turning * whirl - p[GRAVITY_1] * cos_1 - p[GRAVITY_2] * cos_12
    left[stage, 1] -= turning * v1 * v1 + p[GRAVITY_2] * cos_12
    f1 = (2 * now + stage) * STAGE
    f2, m11, m12 = f1 + WIDE, f1 + MASSES, f1 + MASSES + WIDE
    rows[m11 + at[COUPLING]], rows[m12 + at[COUPLING]] = 2.0 * cos_2, cos_2
    rows[f1 + at[COUPLING]], rows[f2 + at[COUPLING]] = sin_2 * whirl, -sin_2 * v1 * v1
    rows[f1 + at[GRAVITY_1]] = -cos_1
    rows[f1 + at[GRAVITY_2]] = rows[f2 + at[GRAVITY_2]] = -cos_12
    rows[f1 + at[ZERO_1]], rows[f2 + at[ZERO_1]] = fall_1 + fall_12, fall_12
    rows[f1 + at[ZERO_2]], rows[f2 + at[ZERO_2]] = f1_q2, f2_q2
    rows[m11 + at[ZERO_2]], rows[m12 + at[ZERO_2]] = -2.0 * turning, -turning
    n = now * NUMBERS + stage * BY_STATE
    numbers[n] += fall_1 + fall_12 - spring[0, 0]
    numbers[n + 1] = f1_q2
    numbers[n + 2] += 2.0 * turning * v2
    numbers[n + 3] = 2.0 * turning * (v1 + v2)
    numbers[n + 4] = fall_12
    numbers[n + 5] += f2_q2 - spring[0, 1]
    numbers[n + 6] = -2.0 * turning * v1
    numbers[n + 12], numbers[n + 13] = -2.0 * turning, -turning
    return p[0] + p[2] + 2.0 * across, p[2] + across


def arm_step(p: Any, x: Any, t1: float, t2: float, h: float, now: int, room: Any) -> tuple[float, float]:
    """Advance the state x (2, joints) by a step of `h` [s], computing its rows and scalars; return the accelerations
    [rad/s^2].

    t1, t2: motor torques [N m].
    """
    _, numbers, here, left, slope, _, _, _ = room
    gh, half = GAMMA * h, 0.5 * h * h
    m22 = p[2] + p[3]
    m11 = m12 = n11 = n12 = i11 = i12 = i22 = k1 = k2 = 0.0
    here[0, 0], here[0, 1], here[1, 0], here[1, 1] = x[0, 0], x[0, 1], x[1, 0], x[1, 1]
    for stage in range(2):
        n11, n12 = _arm(p, stage, now, t1, t2, room)
        if stage == 0:
            m11, m12 = n11, n12
            w11, w22 = m11 + gh * slope[0, 0], m22 + gh * slope[0, 1]
            w = 1.0 / (w11 * w22 - m12 * m12)
            # Winv = [i11 i12; i12 i22]
            i11, i12, i22 = w22 * w, -m12 * w, w11 * w
            k1, k2 = i11 * left[0, 0] + i12 * left[0, 1], i12 * left[0, 0] + i22 * left[0, 1]
            here[0, 0] += h * x[1, 0]
            here[0, 1] += h * x[1, 1]
            here[1, 0] += h * k1
            here[1, 1] += h * k2
    n = 1.0 / (n11 * m22 - n12 * n12)
    j11, j12, j22 = m22 * n, -n12 * n, n11 * n
    a1, a2 = j11 * left[1, 0] + j12 * left[1, 1], j12 * left[1, 0] + j22 * left[1, 1]
    r1, r2 = a1 - 2.0 * k1, a2 - 2.0 * k2
    b1, b2 = m11 * r1 + m12 * r2, m12 * r1 + m22 * r2
    l1, l2 = i11 * b1 + i12 * b2, i12 * b1 + i22 * b2
    # C = h/2 Winv; Q = C M; B = Q M'inv; A = (3 h/2 + h B f'_v - 2 Q) Winv
    c11, c12, c22 = 0.5 * h * i11, 0.5 * h * i12, 0.5 * h * i22
    o11, o12 = c11 * m11 + c12 * m12, c11 * m12 + c12 * m22
    o21, o22 = c12 * m11 + c22 * m12, c12 * m12 + c22 * m22
    b11, b12 = o11 * j11 + o12 * j12, o11 * j12 + o12 * j22
    b21, b22 = o21 * j11 + o22 * j12, o21 * j12 + o22 * j22
    v = now * NUMBERS + BY_STATE
    d11 = 1.5 * h + h * (b11 * numbers[v + 2] + b12 * numbers[v + 6]) - 2.0 * o11
    d12 = h * (b11 * numbers[v + 3] + b12 * numbers[v + 7]) - 2.0 * o12
    d21 = h * (b21 * numbers[v + 2] + b22 * numbers[v + 6]) - 2.0 * o21
    d22 = 1.5 * h + h * (b21 * numbers[v + 3] + b22 * numbers[v + 7]) - 2.0 * o22
    n = v + BY_STATE
    numbers[n], numbers[n + 1], numbers[n + 2], numbers[n + 3] = k1, k2, gh * k1, gh * k2
    numbers[n + 4], numbers[n + 5], numbers[n + 6], numbers[n + 7] = r1 - l1, r2 - l2, gh * l1, gh * l2
    numbers[n + 8], numbers[n + 9] = a1, a2
    numbers[n + 10], numbers[n + 11] = d11 * i11 + d12 * i12, d11 * i12 + d12 * i22
    numbers[n + 12], numbers[n + 13] = d21 * i11 + d22 * i12, d21 * i12 + d22 * i22
    numbers[n + 14], numbers[n + 15], numbers[n + 16], numbers[n + 17] = b11, b12, b21, b22
    numbers[n + 18], numbers[n + 19], numbers[n + 20] = c11, c12, c22
    numbers[n + 21] = h
    s1, s2 = 1.5 * k1 + 0.5 * l1, 1.5 * k2 + 0.5 * l2
    x[0, 0] += h * x[1, 0] + half * k1
    x[0, 1] += h * x[1, 1] + half * k2
    x[1, 0] += h * s1
    x[1, 1] += h * s2
    return s1, s2


def follow(rows: Any, numbers: Any, Z: Any, before: int, count: int) -> None:
    """Propagate the state's derivatives Z through the previous step, whose rows and scalars are at index `before`."""
    # This tells the compiler that `before` is 0 or 1, so that no index can be negative (counting from the end).
    before &= 1
    w, v = 2 * before * STAGE, before * NUMBERS
    e, n = v + BY_STATE, v + 2 * BY_STATE
    h = numbers[n + 21]
    for i in range(count):
        z1, z2, z3, z4 = Z[i], Z[WIDE + i], Z[2 * WIDE + i], Z[3 * WIDE + i]
        m11 = rows[w + 4 * WIDE + i] + numbers[v + 12] * z2
        m12 = rows[w + 5 * WIDE + i] + numbers[v + 13] * z2
        m22 = rows[w + 6 * WIDE + i]
        s1 = rows[w + 2 * WIDE + i] + numbers[v + 8] * z1 + numbers[v + 9] * z3
        s2 = rows[w + 3 * WIDE + i] + numbers[v + 10] * z2 + numbers[v + 11] * z4
        f1 = rows[w + i] + numbers[v] * z1 + numbers[v + 1] * z2 + numbers[v + 2] * z3 + numbers[v + 3] * z4
        f2 = rows[w + WIDE + i] + numbers[v + 4] * z1 + numbers[v + 5] * z2 + numbers[v + 6] * z3 + numbers[v + 7] * z4
        r1 = f1 - m11 * numbers[n] - m12 * numbers[n + 1] - s1 * numbers[n + 2]
        r2 = f2 - m12 * numbers[n] - m22 * numbers[n + 1] - s2 * numbers[n + 3]
        e1 = m11 * numbers[n + 4] + m12 * numbers[n + 5] - s1 * numbers[n + 6]
        e2 = m12 * numbers[n + 4] + m22 * numbers[n + 5] - s2 * numbers[n + 7]
        # Stage 2 is evaluated at angles that have moved by h v.
        y1, y2 = z1 + h * z3, z2 + h * z4
        m11 = rows[w + 11 * WIDE + i] + numbers[e + 12] * y2
        m12 = rows[w + 12 * WIDE + i] + numbers[e + 13] * y2
        m22 = rows[w + 13 * WIDE + i]
        f1 = rows[w + 7 * WIDE + i] + numbers[e] * y1 + numbers[e + 1] * y2 + numbers[e + 2] * z3 + numbers[e + 3] * z4
        f2 = (
            rows[w + 8 * WIDE + i]
            + numbers[e + 4] * y1
            + numbers[e + 5] * y2
            + numbers[e + 6] * z3
            + numbers[e + 7] * z4
        )
        g1 = f1 - m11 * numbers[n + 8] - m12 * numbers[n + 9]
        g2 = f2 - m12 * numbers[n + 8] - m22 * numbers[n + 9]
        c1, c2 = numbers[n + 18] * r1 + numbers[n + 19] * r2, numbers[n + 19] * r1 + numbers[n + 20] * r2
        Z[i] = y1 + h * c1
        Z[WIDE + i] = y2 + h * c2
        Z[2 * WIDE + i] = (
            z3
            + (numbers[n + 10] * r1 + numbers[n + 11] * r2)
            + (numbers[n + 14] * g1 + numbers[n + 15] * g2)
            + (numbers[n + 18] * e1 + numbers[n + 19] * e2)
        )
        Z[3 * WIDE + i] = (
            z4
            + (numbers[n + 12] * r1 + numbers[n + 13] * r2)
            + (numbers[n + 16] * g1 + numbers[n + 17] * g2)
            + (numbers[n + 19] * e1 + numbers[n + 20] * e2)
        )


def _loop(
    p: Any,
    x: Any,
    torque: Any,
    slopes: Any,
    ends: Any,
    step: float,
    pieces: Any,
    held: bool,
    room: Any,
    Z: Any,
    turn: Any,
    position: Any,
    derivative: Any,
) -> None:
    rows, numbers, _, _, _, dt, spring, _ = room
    causes = derivative.shape[2]
    count = (causes + AT_ONCE - 1) // AT_ONCE * AT_ONCE
    now = turn[0]
    a1 = a2 = 0.0
    finest = max(pieces[0], pieces[1])
    piece = step / finest
    for k in range(position.shape[1]):
        position[0, k], position[1, k] = x[0, 0], x[0, 1]
        for row in range(ends.shape[2]):
            spring[1 + row, 0], spring[1 + row, 1] = ends[0, k, row], ends[1, k, row]
        written = False
        for s in range(torque.shape[2]):
            t1, t2 = torque[0, k, s], torque[1, k, s]
            for cause in range(2):
                dt[cause, 0], dt[cause, 1] = slopes[cause, 0, k, s], slopes[cause, 1, k, s]
            left = finest
            while left > 0:
                n = pieces_now(p, x[1, 0], x[1, 1], a1, a2, piece, pieces, left, held)
                a1, a2 = arm_step(p, x, t1, t2, n * piece, now, room)
                left -= n
                now = 1 - now
                follow(rows, numbers, Z, now, count)
                if not written:
                    for i in range(causes):
                        derivative[0, k, i] = Z[i]
                        derivative[1, k, i] = Z[WIDE + i]
                    written = True
    turn[0] = now


# Only the loop is called from Python; wrappers for the others would take another second to compile. Calls that are not
# inlined would spend more time on counting references to arrays than on arithmetic. None of these functions allocates
# memory, so they do without such counts; this also makes compilation a fifth faster.
fused = partial(embedded, fastmath={"contract"}, forceinline=True, _nrt=False)
_drive, _arm, arm_step, follow = map(fused, (_drive, _arm, arm_step, follow))
_advance: Callable[..., None] = compiled(_loop, fastmath={"contract"}, _nrt=False)
