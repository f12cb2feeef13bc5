"""Forward sensitivities of an arm with presliding friction.

`hil.estimator.simulation.bristles` splits each step into parts. Here, the derivatives of the bristles' parts are
propagated together with those of the arm's part, in which the bristles' torque is an additional offset and their
damping additional viscous friction.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled
from hil.estimator.models.parameters import SLIDING, Physics
from hil.estimator.simulation.arm import MAX_SUBSTEPS, pieces_now
from hil.estimator.simulation.bristles import (
    COULOMB,
    DAMPING,
    FADING,
    GENERATED,
    LOAD,
    OFFSET,
    RISE,
    SATURATION,
    SCALE,
    STIFFNESS,
    VISCOUS,
    first_bend,
    has_bristles,
    without_dry_friction,
)
from hil.estimator.simulation.sensitivity import (
    AT_ONCE,
    DELAY,
    LAG_DIFFERENCE,
    NOWHERE,
    SLOPES,
    STAGE,
    STATE,
    WIDE,
    Sensitive,
    arm_step,
    follow,
    fused,
)


def sensitive(physics: Physics) -> "type[Sensitive]":
    """Return the class that simulates an arm with these constants, including derivatives."""
    return PreslidingSensitive if has_bristles(physics) else Sensitive


class PreslidingSensitive(Sensitive):
    """A simulation with derivatives for presliding friction, starting with bristles deflected as in steady sliding."""

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
        super().__init__(physics, start, causes, step, max_substeps, tracking_stiffness, held)
        *room, at = self._room
        # Dry friction is modelled by the bristles: within the arm's step its derivatives are discarded.
        within = at.copy()
        for joint in range(2):
            if physics.vector[STIFFNESS + joint] > 0.0:
                within[[COULOMB + joint, LOAD + joint]] = NOWHERE
        self._room = (*room, within)
        self._moving = without_dry_friction(physics.vector)
        self._began, self._faster = np.zeros((2, 2))
        self._bent = np.zeros(2)
        self._bent[: self._joints] = first_bend(physics, start[1])
        self._bristles = (at, _first_slopes(physics.vector, self._state[1], at).reshape(-1), *np.zeros((3, 2 * WIDE)))

    def _go_on(self, *given: Any) -> None:
        _advance(self._moving, self._bent, (*self._bristles, self._began, self._faster), *given)


def _first_slopes(p: Array, velocity: Array, at: npt.NDArray[np.int64]) -> Array:
    """Return the derivatives of `first_bend` (2, WIDE) with respect to the causes in the columns `at`."""
    slopes = np.zeros((2, WIDE))
    for joint in np.flatnonzero(p[STIFFNESS : STIFFNESS + 2] > 0.0):
        coulomb, rise, fading, v = p[COULOMB + joint], p[RISE + joint], p[FADING + joint], velocity[joint]
        bump = math.exp(-((v / fading) ** 2))
        way = math.tanh(v / SLIDING)
        slopes[joint, at[COULOMB + joint]] = (1.0 + rise * bump) * way
        slopes[joint, at[RISE + joint]] = coulomb * bump * way
        slopes[joint, at[FADING + joint]] = 2.0 * coulomb * rise * bump * v * v / fading**3 * way
        slopes[joint, at[STATE + 2 + joint]] = (
            coulomb * (1.0 + rise * bump) * (1.0 - way * way) / SLIDING
            - 2.0 * coulomb * rise * bump * v / fading**2 * way
        )
    return slopes


# Compiled code takes its arguments by position; see `hil.estimator.simulation.sensitivity`. `bristles` consists of
#   at             the column of each cause
#   D              derivatives of the bristles' torque (joints, WIDE), flattened like the others
#   level_by       derivatives of the level at a given velocity
#   give_by        derivatives of the bristles' contribution to viscous friction
#   faster_by      derivatives of the last step's accelerations
#   began          velocities at the start of the arm's step (joints,)
#   faster         accelerations of the last step (joints,)
def _bend(
    p: Any,
    m: Any,
    b: Any,
    bristles: Any,
    x: Any,
    t1: float,
    t2: float,
    time: float,
    ahead: float,
    dt: Any,
    Z: Any,
    count: int,
) -> None:
    """Apply and differentiate `hil.estimator.simulation.bristles.bend`; the step's middle is `ahead` [s] from now."""
    at, D, level_by, give_by, faster_by, began, faster = bristles
    for joint in range(2):
        stiffness = p[STIFFNESS + joint]
        if stiffness > 0.0:
            v, commanded = x[1, joint], t1 if joint == 0 else t2
            coulomb, rise, fading, load = p[COULOMB + joint], p[RISE + joint], p[FADING + joint], p[LOAD + joint]
            scale, damping = p[SCALE + joint], p[DAMPING + joint]
            u = v + ahead * faster[joint]
            per_speed = p[GENERATED + joint]
            t = scale * commanded - per_speed * u
            cube, eased = t * t * t, 1.0 - 3.0 * p[SATURATION + joint] * t * t
            t -= p[SATURATION + joint] * cube
            loaded = load if t > 0.0 else -load
            bump = math.exp(-((u / fading) ** 2))
            level = coulomb * (1.0 + rise * bump) + load * abs(t)
            level_u = -2.0 * coulomb * rise * bump * u / fading**2 - loaded * eased * per_speed
            way = math.copysign(1.0, v)
            turns = stiffness * abs(v) * time / level
            left = math.exp(-turns)
            away = b[joint] - way * level
            by_level = way * (1.0 - left) + away * left * turns / level
            by_v = -away * left * way * stiffness * time / level
            r = joint * WIDE
            level_by[r + at[COULOMB + joint]] = 1.0 + rise * bump
            level_by[r + at[RISE + joint]] = coulomb * bump
            level_by[r + at[FADING + joint]] = 2.0 * coulomb * rise * bump * u * u / fading**3
            level_by[r + at[LOAD + joint]] = abs(t)
            level_by[r + at[SCALE + joint]] = loaded * commanded * eased
            level_by[r + at[SATURATION + joint]] = -loaded * cube
            level_by[r + at[GENERATED + joint]] = -loaded * eased * u
            for cause in range(2):
                level_by[r + at[DELAY + cause]] = loaded * scale * eased * dt[cause, joint]
            if joint == 1:
                level_by[r + at[LAG_DIFFERENCE]] = loaded * scale * eased * dt[1, joint]
            b[joint] = way * level + away * left
            bent = way * b[joint] / level
            z = (2 + joint) * WIDE
            D[r + at[STIFFNESS + joint]] -= away * abs(v) * time / level
            for i in range(count):
                level_i = level_by[r + i] + level_u * (Z[z + i] + ahead * faster_by[r + i])
                D[r + i] = left * D[r + i] + by_level * level_i + by_v * Z[z + i]
                give_by[r + i] = -damping / level * (way * D[r + i] - bent * level_i)
            give_by[r + at[DAMPING + joint]] += 1.0 - bent
            m[OFFSET + joint] = p[OFFSET + joint] + b[joint]
            m[VISCOUS + joint] = p[VISCOUS + joint] + damping * (1.0 - bent)
        began[joint] = x[1, joint]


def _clear(rows: Any, now: int) -> None:
    """Clear the friction rows that the arm's step is about to write, since the bristles have written to all of them."""
    for stage in range(2):
        first = (2 * now + stage) * STAGE
        for i in range(4 * WIDE):
            rows[first + i] = 0.0


def _press(rows: Any, here: Any, bristles: Any, now: int, count: int) -> None:
    """Add the effect of the bristles' torque and damping to the rows of the step at `now`."""
    _, D, _, give_by, _, began, _ = bristles
    for stage in range(2):
        for joint in range(2):
            v = began[joint] if stage == 0 else here[1, joint]
            f, r = (2 * now + stage) * STAGE + joint * WIDE, joint * WIDE
            for i in range(count):
                rows[f + i] -= D[r + i] + v * give_by[r + i]
                rows[f + SLOPES + i] += give_by[r + i]


def _accelerate(bristles: Any, Z: Any, kept: float, share: float, count: int) -> None:
    """Set the derivatives of the accelerations: `kept` times their previous values plus `share` times the derivatives
    of the velocities.
    """
    faster_by = bristles[4]
    for joint in range(2):
        r, z = joint * WIDE, (2 + joint) * WIDE
        for i in range(count):
            faster_by[r + i] = kept * faster_by[r + i] + share * Z[z + i]


def _loop(
    m: Any,
    b: Any,
    bristles: Any,
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
    rows, numbers, here, _, _, dt, spring, _ = room
    causes = derivative.shape[2]
    count = (causes + AT_ONCE - 1) // AT_ONCE * AT_ONCE
    now = turn[0]
    faster = bristles[6]
    finest = max(pieces[0], pieces[1])
    piece = step / finest
    for k in range(position.shape[1]):
        position[0, k], position[1, k] = x[0, 0], x[0, 1]
        for i in range(causes):
            derivative[0, k, i] = Z[i]
            derivative[1, k, i] = Z[WIDE + i]
        for row in range(ends.shape[2]):
            spring[1 + row, 0], spring[1 + row, 1] = ends[0, k, row], ends[1, k, row]
        for s in range(torque.shape[2]):
            t1, t2 = torque[0, k, s], torque[1, k, s]
            for cause in range(2):
                dt[cause, 0], dt[cause, 1] = slopes[cause, 0, k, s], slopes[cause, 1, k, s]
            left = finest
            while left > 0:
                n = pieces_now(p, x[1, 0], x[1, 1], faster[0], faster[1], piece, pieces, left, held)
                h = n * piece
                _bend(p, m, b, bristles, x, t1, t2, 0.5 * h, 0.5 * h, dt, Z, count)
                _clear(rows, now)
                _accelerate(bristles, Z, 0.0, -1.0 / h, count)
                faster[0], faster[1] = arm_step(m, x, t1, t2, h, now, room)
                _press(rows, here, bristles, now, count)
                # Done immediately, since the second half of the bristles' step needs the effect of this step on the
                # velocities.
                follow(rows, numbers, Z, now, count)
                _accelerate(bristles, Z, 1.0, 1.0 / h, count)
                _bend(p, m, b, bristles, x, t1, t2, 0.5 * h, -0.5 * h, dt, Z, count)
                left -= n


_bend, _clear, _press, _accelerate = map(fused, (_bend, _clear, _press, _accelerate))
_advance: Callable[..., None] = compiled(_loop, fastmath={"contract"}, _nrt=False)
