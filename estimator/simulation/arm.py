"""The compiled simulation of an arm under given motor torques: the most time-critical loop of the estimator.

The equations are those of `hil.estimator.models.regressor` with a smooth friction law:

    driving torque = torque_scale torque - generated v
    given torque = driving torque (1 - saturation (driving torque)^2)
    motor torque = given torque (1 + ripple_sin sin(ripple_cycles q) + ripple_cos cos(ripple_cycles q))
    friction(v) = (viscous - generated) v + viscous_asymmetry |v| + level(v) tanh(v / width)
    level(v) = coulomb (1 + stribeck_rise exp(-(v / stribeck_velocity)^2)) + load |motor torque|

Here generated v is the back-EMF of a joint driven by voltage (`hil.estimator.simulation.back_emf`), 0 otherwise. In
addition to friction there is the torque cable_stiffness q - cogging_sin sin(cogging_cycles q) - cogging_cos
cos(cogging_cycles q). |v| is smoothed as well, to v tanh(v / width). An asymmetry of the Coulomb level itself is
described by the offset. With presliding, the term level(v) tanh(v / width) is replaced by the bristles of
`hil.estimator.simulation.bristles`. `hil.estimator.simulation.sensitivity` differentiates these equations and this
integration scheme.

Each step uses the two-stage Rosenbrock method ROS2 (Verwer, Spee, Blom, Hundsdorfer 1999). Only the slope of friction
is included in the Jacobian: the method is L-stable for this slope, and second-order whatever the Jacobian omits. While
a joint is near standstill, where tanh is steep, a step is divided into smaller ones. At 400 Hz and for widths from
0.0003 to 0.05 rad/s, three steps per sample differ from a hundred by 0.003 encoder steps RMS. With one step per sample,
which takes a third of the time, the difference is 0.05.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled
from hil.estimator.models.parameters import Physics, place_of
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.bristles import bend, first_bend, has_bristles, inlined, without_dry_friction

# Indices of joint 1's constants in `Physics.vector`; joint 2's follow.
VISCOUS, COULOMB, OFFSET, WIDTH, RISE, FADING = map(
    place_of, ("viscous", "coulomb", "offset", "coulomb_width", "stribeck_rise", "stribeck_velocity")
)
LOAD, ASYMMETRY, SINE, COSINE, CYCLES, ZERO, SCALE = map(
    place_of, ("load", "viscous_asymmetry", "ripple_sin", "ripple_cos", "ripple_cycles", "zero", "torque_scale")
)
SATURATION, CABLE, GENERATED = map(place_of, ("saturation", "cable_stiffness", "back_emf"))
COG_SINE, COG_COSINE, COG_CYCLES = map(place_of, ("cogging_sin", "cogging_cos", "cogging_cycles"))
STIFFNESS = place_of("presliding_stiffness")

INTEGRATION = IntegrationOptions()
MAX_SUBSTEPS = INTEGRATION.max_substeps
FADED = 40.0  # exp(-40) is negligible compared with 1, and the library takes longer for such arguments
GAMMA = 1.0 - math.sqrt(0.5)
STEADY_WIDTHS = 0.25  # largest change in velocity in a substep near standstill, in widths of the Coulomb step


def steps_per_sample(rate: float, longest: float = INTEGRATION.max_step) -> int:
    """Return the number of integration steps of at most `longest` [s] per sample at `rate` [1/s]."""
    return math.ceil(1.0 / (rate * longest))


def simulate(
    physics: Physics,
    start: Array,
    torque: Array,
    step: float,
    max_substeps: int = MAX_SUBSTEPS,
    springs: tuple[Array, Array] | None = None,
    held: bool = False,
) -> tuple[Array, Array]:
    """Simulate as many samples as `torque` has.

    Args:
        physics: physical constants.
        start: state at the first sample (2 or 3, joints): angles [rad], velocities [rad/s] and optionally the torque of
            the bristles [N m], by default as in steady sliding.
        torque: mean motor torque over each of the steps that follow a sample (joints, samples, steps) [N m].
        step: length of a step [s].
        max_substeps: maximum number of substeps into which a step is divided near standstill.
        springs: stiffness of additional springs (joints,) [N m/rad] and the angles to which they pull the joints, held
            between samples (joints, samples) [rad].
        held: whether joints that are held by friction take longer substeps.

    Returns:
        The angles at the samples (joints, samples) [rad] and the state after the last sample's steps (3, joints).
    """
    joints, samples, _ = torque.shape
    # A one-joint arm is simulated as a two-joint arm whose second joint has no torque and moves nothing.
    state = np.zeros((3, 2))
    state[2, :joints] = first_bend(physics, start[1])
    state[: len(start), :joints] = start
    both = np.zeros((2, *torque.shape[1:]))
    both[:joints] = torque
    position = np.empty((2, samples))
    pieces = finer_pieces(physics, step, max_substeps)
    vector = physics.vector.copy()
    pulls = np.zeros((2, samples if springs is not None else 0))
    if springs is not None:
        # A spring is modelled as a cable plus an offset that changes from sample to sample.
        stiffness, ends = springs
        vector[CABLE : CABLE + joints] += stiffness
        pulls[:joints] = stiffness[:, None] * ends
    moving = without_dry_friction(vector)
    _simulate(vector, has_bristles(physics), moving, state, both, pulls, step, pieces, held, position)
    return position[:joints], state[:, :joints]


def finer_pieces(physics: Physics, step: float, most: int = MAX_SUBSTEPS) -> NDArray[np.int64]:
    """Return the number of substeps, at most `most`, for a step of `step` [s] while each joint is near standstill.

    Within one substep, a reversal of dry friction may take a joint through a quarter of its Coulomb step's width. The
    numbers are powers of two, so that small changes in the physics seldom change them. A changed number would alter the
    last digits of the motion.
    """
    needed = [min(step / (STEADY_WIDTHS * max(time, 1e-12)), most) for time in physics.crossing_times()]
    return np.array([2 ** math.ceil(math.log2(max(each, 1.0))) for each in needed], dtype=np.int64)


def bump_at(ratio: float) -> float:
    """Return exp(-ratio^2)."""
    past = ratio * ratio
    return math.exp(-past) if past < FADED else 0.0


def bend_at(v: float, sharp: float) -> tuple[float, float]:
    """Return tanh(v sharp) and its derivative with respect to v, using one exponential; this takes half as long as the
    library's tanh.
    """
    past = 2.0 * abs(v) * sharp
    if not past < FADED:
        return math.copysign(1.0, v), 0.0
    short = math.exp(-past)
    bend = math.copysign((1.0 - short) / (1.0 + short), v)
    return bend, (1.0 - bend * bend) * sharp


# Compiled code takes its arguments by position; p is `Physics.vector`, joint is 0 or 1.
def _drive(p: Any, joint: int, q: float, v: float, t: float) -> tuple[float, float]:
    """Return the torque of a drive minus friction, and the slope of that friction."""
    viscous, cycles = p[VISCOUS + joint], p[CYCLES + joint]
    generated = p[GENERATED + joint] * v
    t = t * p[SCALE + joint] - generated
    t -= p[SATURATION + joint] * t * t * t
    if cycles != 0.0:
        t *= 1.0 + p[SINE + joint] * math.sin(cycles * q) + p[COSINE + joint] * math.cos(cycles * q)
    level = p[COULOMB + joint] * (1.0 + p[RISE + joint] * bump_at(v / p[FADING + joint])) + p[LOAD + joint] * abs(t)
    bend, bent = bend_at(v, 1.0 / p[WIDTH + joint])
    left = (
        t
        + generated
        - p[OFFSET + joint]
        - p[CABLE + joint] * q
        - viscous * v
        - (p[ASYMMETRY + joint] * v + level) * bend
    )
    cogs = p[COG_CYCLES + joint]
    if cogs != 0.0:
        left += p[COG_SINE + joint] * math.sin(cogs * q) + p[COG_COSINE + joint] * math.cos(cogs * q)
    slope = viscous + level * bent
    return left, slope


def _forces(p: Any, q1: float, q2: float, v1: float, v2: float, t1: float, t2: float) -> tuple[float, ...]:
    """Return the first row of the mass matrix, the torques available for acceleration, and the slopes of friction."""
    left_1, slope_1 = _drive(p, 0, q1, v1, t1)
    left_2, slope_2 = _drive(p, 1, q2, v2, t2)
    q1 += p[ZERO]
    q2 += p[ZERO + 1]
    cos_1, sin_1, cos_2, sin_2 = math.cos(q1), math.sin(q1), math.cos(q2), math.sin(q2)
    across = p[1] * cos_2
    turning = p[1] * sin_2
    weight = p[5] * (cos_1 * cos_2 - sin_1 * sin_2)
    return (
        p[0] + p[2] + 2.0 * across,
        p[2] + across,
        left_1 - p[4] * cos_1 - weight + turning * (2.0 * v1 + v2) * v2,
        left_2 - weight - turning * v1 * v1,
        slope_1,
        slope_2,
    )


def pieces_now(
    p: Any, v1: float, v2: float, a1: float, a2: float, piece: float, pieces: Any, left: int, held: bool
) -> int:
    """Return how many of the `left` remaining substeps of length `piece` [s] may be taken at once.

    v1, v2: velocities [rad/s]. a1, a2: last accelerations [rad/s^2]. pieces: number of substeps in a step while each
    joint is near standstill (joints,); a substep is a step divided by the larger of them. held: whether a joint that is
    held by friction may take longer ones.
    """
    ahead = 2.0 * left * piece
    u1, u2 = v1 + ahead * a1, v2 + ahead * a2
    near_1 = (p[COULOMB] > 0.0) & ((min(abs(v1), abs(u1)) < 6.0 * p[WIDTH]) | (v1 * u1 < 0.0))
    near_2 = (p[COULOMB + 1] > 0.0) & ((min(abs(v2), abs(u2)) < 6.0 * p[WIDTH + 1]) | (v2 * u2 < 0.0))
    finest = max(pieces[0], pieces[1])
    at_once = left
    # The last acceleration does not include the effect of a new torque, so each step starts with a short substep.
    if near_1:
        steady = pieces_while_steady(p, 0, a1, piece, left) if held and left < finest else 1
        at_once = min(at_once, max(steady, finest // pieces[0]))
    if near_2:
        steady = pieces_while_steady(p, 1, a2, piece, left) if held and left < finest else 1
        at_once = min(at_once, max(steady, finest // pieces[1]))
    return at_once


def pieces_while_steady(p: Any, joint: int, a: float, piece: float, left: int) -> int:
    """Return how many of the `left` remaining substeps change a joint's velocity by no more than a substep of
    `finer_pieces` may.

    A joint held by dry friction needs no short substeps, since the method is L-stable for the slope of friction.
    Bristles always need them, since they oscillate. a: last acceleration [rad/s^2].
    """
    if p[STIFFNESS + joint] > 0.0:
        return 1
    most = STEADY_WIDTHS * p[WIDTH + joint]
    while left > 1 and abs(a) * left * piece > most:
        left //= 2
    return left


def step_on(
    p: Any, q1: float, q2: float, v1: float, v2: float, t1: float, t2: float, h: float
) -> tuple[float, float, float, float, float, float]:
    """Return angles and velocities after a step of `h` [s] with motor torques t1 and t2 [N m], and the step's mean
    accelerations.
    """
    m22 = p[2] + p[3]
    m11, m12, f1, f2, slope_1, slope_2 = _forces(p, q1, q2, v1, v2, t1, t2)
    # Stage 1: (M + gamma h S) k = f, with S the slopes of friction.
    w11 = m11 + GAMMA * h * slope_1
    w22 = m22 + GAMMA * h * slope_2
    w = w11 * w22 - m12 * m12
    k1 = (w22 * f1 - m12 * f2) / w
    k2 = (w11 * f2 - m12 * f1) / w
    u1 = v1 + h * k1
    u2 = v2 + h * k2
    # Stage 2: (M + gamma h S) l = M (M'^-1 f' - 2 k), with M' and f' at the end predicted by stage 1.
    n11, n12, f1, f2, _, _ = _forces(p, q1 + h * v1, q2 + h * v2, u1, u2, t1, t2)
    n = n11 * m22 - n12 * n12
    r1 = (m22 * f1 - n12 * f2) / n - 2.0 * k1
    r2 = (n11 * f2 - n12 * f1) / n - 2.0 * k2
    f1 = m11 * r1 + m12 * r2
    f2 = m12 * r1 + m22 * r2
    a1 = 1.5 * k1 + 0.5 * (w22 * f1 - m12 * f2) / w
    a2 = 1.5 * k2 + 0.5 * (w11 * f2 - m12 * f1) / w
    return q1 + 0.5 * h * (v1 + u1), q2 + 0.5 * h * (v2 + u2), v1 + h * a1, v2 + h * a2, a1, a2


def step_bent(
    p: Any,
    bristly: bool,
    m: Any,
    b: Any,
    q1: float,
    q2: float,
    v1: float,
    v2: float,
    a1: float,
    a2: float,
    t1: float,
    t2: float,
    h: float,
) -> tuple[float, float, float, float, float, float]:
    """Apply `step_on` between the two halves of the bristles' step; a1 and a2 are the last accelerations [rad/s^2]."""
    half = 0.5 * h
    if bristly:
        bend(p, b, m, v1, v2, v1 + half * a1, v2 + half * a2, t1, t2, half)
    q1, q2, v1, v2, a1, a2 = step_on(m, q1, q2, v1, v2, t1, t2, h)
    if bristly:
        bend(p, b, m, v1, v2, v1 - half * a1, v2 - half * a2, t1, t2, half)
    return q1, q2, v1, v2, a1, a2


# pulls: torques of the springs if the joints were at zero (2, samples) [N m], or (2, 0) without springs.
def _loop(
    p: Any,
    bristly: bool,
    m: Any,
    state: Any,
    torque: Any,
    pulls: Any,
    step: float,
    pieces: Any,
    held: bool,
    position: Any,
) -> None:
    q1, q2, v1, v2 = state[0, 0], state[0, 1], state[1, 0], state[1, 1]
    b = state[2]
    a1 = a2 = 0.0
    finest = max(pieces[0], pieces[1])
    piece = step / finest
    offset_1, offset_2 = p[OFFSET], p[OFFSET + 1]
    for k in range(position.shape[1]):
        position[0, k] = q1
        position[1, k] = q2
        if pulls.shape[1] > 0:
            p[OFFSET] = m[OFFSET] = offset_1 - pulls[0, k]
            p[OFFSET + 1] = m[OFFSET + 1] = offset_2 - pulls[1, k]
        for s in range(torque.shape[2]):
            t1, t2 = torque[0, k, s], torque[1, k, s]
            left = finest
            while left > 0:
                n = pieces_now(p, v1, v2, a1, a2, piece, pieces, left, held)
                q1, q2, v1, v2, a1, a2 = step_bent(p, bristly, m, b, q1, q2, v1, v2, a1, a2, t1, t2, n * piece)
                left -= n
    state[0, 0], state[0, 1], state[1, 0], state[1, 1] = q1, q2, v1, v2


# Functions called only from compiled code need no wrappers, which take a second to compile. They are inlined because
# the reference counting for their arrays would take longer than the arithmetic of a step.
bump_at, bend_at, _drive, _forces, pieces_while_steady, pieces_now, step_on, step_bent = map(
    inlined, (bump_at, bend_at, _drive, _forces, pieces_while_steady, pieces_now, step_on, step_bent)
)
_simulate: Callable[..., None] = compiled(_loop)
