"""A planar two-link arm, simulated from masses, lengths and gear ratios.

Kinetic energy, where w1 = q1' and w2 = q1' + q2' are the links' angular velocities and phi1, phi2 their angles:

    link 1      m1 c1^2 w1^2 / 2 + J1 w1^2 / 2
    elbow       m_elbow l1^2 w1^2 / 2
    link 2      m2 (l1^2 w1^2 + c2^2 w2^2 + 2 l1 c2 w1 w2 cos(phi2 - phi1)) / 2 + J2 w2^2 / 2
    rotors      n1^2 Jr1 q1'^2 / 2 + n2^2 Jr2 q2'^2 / 2

Lagrange's equations are derived in phi1, phi2, whose generalised forces are tau1 - tau2 and tau2. In the joint
angles, the first equation is the sum of both equations, and the second remains the same. The estimator models the same
arm independently, as a regressor in base parameters; a test compares the two.

Time integration is symmetric and second-order: drift half a step, kick with the step's mean motor torque and the
friction at its middle, drift half a step. Dry friction is an impulse on each joint, limited to the friction level times
the step and just large enough to bring the joint to rest, so stiction is exact.

In a process that has loaded numba anyway, as hil's own experiments do, the loop is compiled for arms with plain drives;
the results are bitwise identical. Otherwise, the loop is interpreted.
"""

import sys
from collections.abc import Callable, Sequence
from functools import cache
from math import ceil, cos, exp, expm1, sin, tanh
from typing import Any

from hil.fakes.plants.arm import Arm, Link, armature
from hil.fakes.plants.motor import SHORTEST_STEP, Motor

State = tuple[float, float, float, float, float, float, float, float]
"""Two angles [rad], velocities [rad/s], accelerations of the last step [rad/s^2] and currents [A]. The accelerations
are used to extrapolate velocities to the middle of the next step.
"""


class TwoLink:
    """A two-joint arm; see `hil.fakes.plants.plant.Plant`. `velocity`: joint velocities at time 0 [rad/s]."""

    def __init__(self, arm: Arm, velocity: Sequence[float] = (0.0, 0.0)) -> None:
        first, second = arm.links
        self._motors = (Motor(arm.drives[0]), Motor(arm.drives[1]))
        beyond = second.mass + arm.drives[1].mass
        inertia_first = _about_joint(first) + beyond * first.length**2
        inertia_second = _about_joint(second)
        self._terms = (
            second.mass * first.length * second.centre,
            inertia_second,
            inertia_first + armature(arm.drives[0]),
            inertia_second + armature(arm.drives[1]),
            (first.mass * first.centre + beyond * first.length) * arm.weight,
            second.mass * second.centre * arm.weight,
        )
        """Coupling, inertia of link 2, inertias with rotors [kg m^2], and gravity torques of both links [N m]."""
        self._longest_step = min(motor.longest_step for motor in self._motors)
        self._time = 0.0
        q1, q2, v1, v2 = map(float, (*arm.start, *velocity))
        self._state: State = (q1, q2, v1, v2, 0.0, 0.0, 0.0, 0.0)
        self._run = _compiled() if "numba" in sys.modules else _run
        self._warms_up = any(drive.warms_up for drive in arm.drives)
        self._drives_changed()

    @property
    def joints(self) -> int:
        return 2

    @property
    def position(self) -> tuple[float, float]:
        return self._state[:2]

    @property
    def velocity(self) -> tuple[float, float]:
        return self._state[2:4]

    @property
    def current(self) -> tuple[float, float]:
        return self._state[6:]

    def jam(self, joint: int, jammed: bool) -> None:
        self._motors[joint].jammed = jammed
        self._drives_changed()

    def hold(self, joint: int, velocity: float | None) -> None:
        self._motors[joint].held_at = velocity
        self._drives_changed()

    def _drives_changed(self) -> None:
        motor_1, motor_2 = self._motors
        self._are_plain = motor_1.is_plain and motor_2.is_plain
        self._drives = (*motor_1.plain, *motor_2.plain)

    def advance(self, until: float, current: Sequence[float]) -> None:
        remaining = until - self._time
        if remaining <= 0.0:
            return
        if self._warms_up:
            for motor in self._motors:
                motor.warm_up(self._time)
            self._drives_changed()
        self._time = until
        longest = remaining / ceil(remaining / self._longest_step)
        command_1, command_2 = float(current[0]), float(current[1])
        run, motors = (self._run, None) if self._are_plain else (_run, self._motors)
        self._state = run(remaining, longest, command_1, command_2, self._state, self._terms, self._drives, motors)


def _run(  # noqa: PLR0912, PLR0915
    remaining: float,
    longest: float,
    i1: float,
    i2: float,
    state: State,
    arm: tuple[float, ...],
    drives: tuple[float, ...],
    motors: tuple[Motor, Motor] | None,
) -> State:
    """Integrate over `remaining` [s] in steps of at most `longest` [s] with commanded currents [A].

    This is one long loop with local floats because a fake arm spends most of its computing time here: one function call
    per step would make it take 1.5 times as long. A step in which a joint's velocity changes sign is split at that
    point (`cut`).

    arm: `TwoLink._terms`. drives: `Motor.plain` of both motors. motors: None if both are plain; only this case is
    compiled.
    """
    swing, inertia_second, turned_first, turned_second, weight_first, weight_second = arm
    kt_1, offset_1, coulomb_1, rise_1, per_v1, viscous_1, lag_1, width_1 = drives[:8]
    kt_2, offset_2, coulomb_2, rise_2, per_v2, viscous_2, lag_2, width_2 = drives[8:]
    q1, q2, v1, v2, a1, a2, amp_1, amp_2 = state
    if motors is not None:
        motors[0].current, motors[1].current = amp_1, amp_2
    slope_1 = slope_2 = prepared = left_1 = left_2 = mean_1 = mean_2 = 0.0
    cut = rest = 0.0
    while remaining > SHORTEST_STEP:
        step = cut or rest or (longest if longest < remaining else remaining)
        half = 0.5 * step
        middle_v1 = v1 + half * a1 if v1 else 0.0
        middle_v2 = v2 + half * a2 if v2 else 0.0
        middle_q1 = q1 + half * v1
        middle_q2 = q2 + half * v2
        if motors is None:  # same as Motor.push
            if step != prepared:
                prepared = step
                left_1, mean_1 = _lag(step, lag_1)
                left_2, mean_2 = _lag(step, lag_2)
            away_1, away_2 = amp_1 - i1, amp_2 - i2
            ratio_1, ratio_2 = middle_v1 * per_v1, middle_v2 * per_v2
            push_1 = kt_1 * (i1 + away_1 * mean_1) - offset_1
            push_2 = kt_2 * (i2 + away_2 * mean_2) - offset_2
            level_1 = coulomb_1 + rise_1 * exp(-ratio_1 * ratio_1)
            level_2 = coulomb_2 + rise_2 * exp(-ratio_2 * ratio_2)
            next_amp_1, next_amp_2 = i1 + away_1 * left_1, i2 + away_2 * left_2
            if width_1:
                bend = tanh(middle_v1 / width_1)
                push_1 -= level_1 * bend
                slope_1 = level_1 / width_1 * (1.0 - bend * bend)
                level_1 = 0.0
            if width_2:
                bend = tanh(middle_v2 / width_2)
                push_2 -= level_2 * bend
                slope_2 = level_2 / width_2 * (1.0 - bend * bend)
                level_2 = 0.0
        else:
            push_1, level_1, slope_1, next_amp_1 = motors[0].push(step, i1, middle_q1, middle_v1)
            push_2, level_2, slope_2, next_amp_2 = motors[1].push(step, i2, middle_q2, middle_v2)

        across = swing * cos(middle_q2)
        turning = swing * sin(middle_q2)
        weight_2 = weight_second * cos(middle_q1 + middle_q2)
        w2 = middle_v1 + middle_v2
        force_1 = push_1 + turning * (w2 * w2 - middle_v1 * middle_v1) - weight_first * cos(middle_q1) - weight_2
        force_2 = push_2 - turning * middle_v1 * middle_v1 - weight_2

        # Viscous friction at the mean of old and new velocity, smooth friction linearised about the middle,
        # (M + D) new = (M - D) v + step (force + slope middle_v) - dry, with D = step / 2 (viscous + slope).
        m12 = inertia_second + across
        m11 = turned_first + across + m12
        damp_1 = half * (viscous_1 + slope_1)
        damp_2 = half * (viscous_2 + slope_2)
        b1 = (m11 - damp_1) * v1 + m12 * v2 + step * (force_1 + slope_1 * middle_v1)
        b2 = m12 * v1 + (turned_second - damp_2) * v2 + step * (force_2 + slope_2 * middle_v2)
        m11 += damp_1
        m22 = turned_second + damp_2
        dry_1 = step * level_1
        dry_2 = step * level_2
        # First assume that both joints keep sliding in their present direction.
        slid_1 = b1 - dry_1 if v1 > 0.0 else b1 + dry_1
        slid_2 = b2 - dry_2 if v2 > 0.0 else b2 + dry_2
        determinant = m11 * m22 - m12 * m12
        new_1 = (m22 * slid_1 - m12 * slid_2) / determinant
        new_2 = (m11 * slid_2 - m12 * slid_1) / determinant
        if (new_1 * v1 <= 0.0 or new_2 * v2 <= 0.0) and (level_1 or level_2):
            if not cut and not rest:
                cut = step * min(_until_zero(v1, new_1), _until_zero(v2, new_2))
                if SHORTEST_STEP < cut < step - SHORTEST_STEP:
                    rest = step - cut
                    continue
                cut = 0.0
            new_1, new_2 = _sticking((m11, m12, m22), (b1, b2), (dry_1, dry_2), (new_1, new_2))
        a1 = (new_1 - v1) / step
        a2 = (new_2 - v2) / step
        amp_1 = next_amp_1
        amp_2 = next_amp_2
        if motors is not None:
            if motors[0].jammed or motors[1].jammed:  # the impulse of a tiny step cannot be extrapolated to the next
                a1 = a2 = 0.0
            motors[0].current, motors[1].current = amp_1, amp_2
            motors[0].bend(step, 0.5 * (v1 + new_1))
            motors[1].bend(step, 0.5 * (v2 + new_2))
        v1 = new_1
        v2 = new_2
        q1 = middle_q1 + half * new_1
        q2 = middle_q2 + half * new_2
        remaining -= step
        if cut:
            cut = 0.0
        elif rest:
            rest = 0.0
    return q1, q2, v1, v2, a1, a2, amp_1, amp_2


def _lag(step: float, seconds: float) -> tuple[float, float]:
    """Return the same as `Motor.lag` for a lag of `seconds`."""
    if not seconds:
        return 0.0, 0.0
    fallen = -expm1(-step / seconds)
    return 1.0 - fallen, fallen * seconds / step


def _about_joint(link: Link) -> float:
    return link.inertia + link.mass * link.centre**2


def _until_zero(old: float, new: float) -> float:
    """Return the fraction of the step after which the velocity crosses zero; 1 if it does not, or starts at zero."""
    return old / (old - new) if old * new < 0.0 else 1.0


def _sticking(
    mass: tuple[float, float, float],
    impulse: tuple[float, float],
    dry: tuple[float, float],
    guess: tuple[float, float],
) -> tuple[float, float]:
    """Return the new velocities [rad/s] if each joint's friction can exert any impulse up to `dry` [N m s].

    They minimise v'Mv/2 - impulse'v + dry'|v|, which is convex, so solving for one joint at a time converges.
    """
    m11, m12, m22 = mass
    v1, v2 = guess
    for _ in range(100):
        old_1, old_2 = v1, v2
        v1 = _shrunk(impulse[0] - m12 * v2, dry[0]) / m11
        v2 = _shrunk(impulse[1] - m12 * v1, dry[1]) / m22
        if abs(v1 - old_1) + abs(v2 - old_2) < 1e-15:
            break
    return v1, v2


def _shrunk(impulse: float, limit: float) -> float:
    """Return the impulse that remains after friction has absorbed up to `limit` of it."""
    if impulse > limit:
        return impulse - limit
    if impulse < -limit:
        return impulse + limit
    return 0.0


@cache
def _compiled() -> Callable[..., State]:
    """Return the compiled loop; after this call, the interpreted loop calls compiled functions, too."""
    import numba

    inner: Any = numba.njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)  # type: ignore[call-overload]
    for function in (_lag, _until_zero, _shrunk, _sticking):
        globals()[function.__name__] = inner(function)
    return numba.njit(cache=True, nogil=True, error_model="numpy")(_run)
