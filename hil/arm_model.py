"""An identified arm as a model: inverse and forward dynamics, gravity and friction. Requires only numpy.

Equations and names are as in docs/model.md. The last axis of every array runs over the joints; any axes may precede
it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hil.estimator.models.friction import direction, dry_level, viscous

__all__ = ["ArmModel", "JointFacts"]

Array = NDArray[np.float64]

_CHUNK = 16384  # samples per block, chosen so that temporaries stay in the processor's cache


UNKNOWN_SERVO = "unknown"


@dataclass(frozen=True)
class JointFacts:
    """Properties of a joint that are not part of its dynamics.

    mode: "current" (goals in A) or "pwm" (goals in V). torque_per_goal: N m/A or N m/V at the output shaft. goal_limit:
    A or V. position_limit: rad. velocity_limit: rad/s. servos: number of servos that drive the joint together.

    For an arm known only from a recording, the servo is `UNKNOWN_SERVO`, the limits are the recorded extremes, and the
    torque per goal is 1 if torques were recorded.
    """

    name: str
    servo: str = field(metadata={"key": "model"})  # the name in result.json
    mode: str
    torque_per_goal: float
    torque_per_goal_std: float
    goal_limit: float
    position_limit: tuple[float, float]
    velocity_limit: float
    servos: int = 1

    @property
    def has_limits(self) -> bool:
        """Whether the limits are the joint's own, not just the extremes of a recording."""
        return self.servo != UNKNOWN_SERVO

    @property
    def goal_unit(self) -> str:
        if not self.has_limits and self.torque_per_goal == 1.0 and self.mode == "current":
            return "N m"
        return "V" if self.mode == "pwm" else "A"


@dataclass(frozen=True, repr=False)
class ArmModel:
    """The dynamics of an identified arm of one or two joints.

    values: base parameters, friction terms and drive terms by name [SI]. stds: their standard errors. gravity:
    gravitational acceleration in the plane of the arm [m/s^2].
    """

    values: Mapping[str, float]
    stds: Mapping[str, float]
    gravity: float
    rest_pose: tuple[float, ...]
    joints: tuple[JointFacts, ...]

    def __repr__(self) -> str:
        """Return a one-line summary; the numbers are in `values` and `stds`."""
        names = ", ".join(joint.name for joint in self.joints)
        return f"<{type(self).__name__} of {len(self.joints)} joints ({names}), {len(self.values)} parameters>"

    def inverse_dynamics(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
        """Motor torques (..., joints) [N m] that produce a motion. Friction, offset, cable and cogging are included.

        Args:
            q: angles (..., joints) [rad].
            dq: velocities (..., joints) [rad/s].
            ddq: accelerations (..., joints) [rad/s^2].

        Raises:
            ValueError: the shapes differ or do not end in the number of joints.
        """
        q, dq, ddq = self._motion(q=q, dq=dq, ddq=ddq)
        flat = [values.reshape(-1, len(self.joints)) for values in (q, dq, ddq)]
        torque = np.empty_like(flat[0])
        for first in range(0, len(torque), _CHUNK):
            part = slice(first, first + _CHUNK)
            torque[part] = self._inverse(*(values[part].T for values in flat)).T
        return torque.reshape(q.shape)

    def rigid_body_torque(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> Array:
        """Torques of the rigid links alone: `inverse_dynamics` without friction, offset, cable, cogging or ripple."""
        q, dq, ddq = self._motion(q=q, dq=dq, ddq=ddq)
        return np.asarray(np.moveaxis(self._rigid_body(*(_joints_first(x) for x in (q, dq, ddq))), 0, -1))

    def gravity_torque(self, q: ArrayLike) -> Array:
        """Torques (..., joints) [N m] that balance gravity in the poses q (..., joints) [rad]."""
        (q,) = self._motion(q=q)
        return np.asarray(np.moveaxis(self._gravity(_joints_first(q)), 0, -1))

    def friction_torque(self, dq: ArrayLike) -> Array:
        """Friction torques (..., joints) [N m] at velocities dq (..., joints) [rad/s].

        Offset and load-dependent friction are not included.
        """
        (dq,) = self._motion(dq=dq)
        velocity = _joints_first(dq)
        steps = [self._step(joint, v) * self._level(joint, v) for joint, v in enumerate(velocity, start=1)]
        viscous = [self._viscous(joint, v) for joint, v in enumerate(velocity, start=1)]
        return np.stack([step + slope for step, slope in zip(steps, viscous, strict=True)], axis=-1)

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Mass matrices (..., joints, joints) [kg m^2] in the poses q (..., joints) [rad]."""
        (q,) = self._motion(q=q)
        p = self.values
        matrix = np.empty((*q.shape, len(self.joints)))
        if len(self.joints) == 1:
            matrix[..., 0, 0] = p["inertia_1"]
            return matrix
        coupling = p["coupling"] * np.cos(q[..., 1] + p.get("zero_2", 0.0))
        matrix[..., 0, 0] = p["inertia_1"] + p["inertia_2"] + 2 * coupling
        matrix[..., 0, 1] = matrix[..., 1, 0] = p["inertia_2"] + coupling
        matrix[..., 1, 1] = p["inertia_2"] + p["armature_2"]
        return matrix

    def forward_dynamics(self, q: ArrayLike, dq: ArrayLike, torque: ArrayLike) -> Array:
        """Accelerations (..., joints) [rad/s^2] of moving joints under motor torques (..., joints) [N m].

        Static friction at zero velocity is taken as zero: its value depends on the applied torque, not on the velocity.
        """
        q, dq, torque = self._motion(q=q, dq=dq, torque=torque)
        torque = torque * np.stack([self._ripple(j, q[..., j - 1]) for j in range(1, len(self.joints) + 1)], axis=-1)
        loaded = self.friction_torque(dq) + self._load_friction(dq, torque) + self._offsets()
        held = np.stack([self._by_angle(j, q[..., j - 1]) for j in range(1, len(self.joints) + 1)], axis=-1)
        free = torque - self.rigid_body_torque(q, dq, np.zeros_like(q)) - loaded - held
        return np.asarray(np.linalg.solve(self.mass_matrix(q), free[..., None])[..., 0])

    def goal(self, torque: ArrayLike) -> Array:
        """Goals (..., joints) [A, or V in pwm mode] for motor torques (..., joints) [N m]; no limit is applied."""
        (torque,) = self._motion(torque=torque)
        return np.asarray(torque / [self.torque_per_goal(number) for number in range(1, len(self.joints) + 1)])

    def torque_scale(self, joint: int) -> float:
        """Ratio of true to assumed torque of `joint` (numbered from 1), given that the first joint's assumed torque is
        correct.
        """
        return self.values.get(f"torque_scale_{joint}", 1.0)

    def torque_per_goal(self, joint: int) -> float:
        """Identified torque per goal of `joint` (numbered from 1): the assumed value times torque_scale [N m/A or N
        m/V].
        """
        return self.joints[joint - 1].torque_per_goal * self.torque_scale(joint)

    def _motion(self, **arrays: ArrayLike) -> list[Array]:
        """Convert the arguments to arrays and check that their shapes agree. Raises ValueError."""
        taken = {name: np.asarray(values, dtype=np.float64) for name, values in arrays.items()}
        shapes = {values.shape for values in taken.values()}
        count = len(self.joints)
        if len(shapes) != 1 or any(not shape or shape[-1] != count for shape in shapes):
            found = ", ".join(f"{name} {values.shape}" for name, values in taken.items())
            raise ValueError(f"{found}: all must have the same shape (..., {count}), with the joints on the last axis")
        return list(taken.values())

    def _inverse(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Motor torques (joints, ...) [N m]. In the arguments, too, the first axis runs over the joints."""
        torque = self._rigid_body(q, dq, ddq)
        for joint, v in enumerate(dq, start=1):
            step = self._step(joint, v)
            moving = self._viscous(joint, v) + step * self._level(joint, v)
            total = torque[joint - 1] + moving + self.values[f"offset_{joint}"] + self._by_angle(joint, q[joint - 1])
            load = self.values.get(f"load_{joint}", 0.0)
            # Solves total + step * load * |torque| = torque; torque has the sign of total as long as load < 1.
            applied = total / (1 - load * step * np.sign(total)) if load else total
            torque[joint - 1] = applied / self._ripple(joint, q[joint - 1])
        return torque

    def _rigid_body(self, q: Array, dq: Array, ddq: Array) -> Array:
        p = self.values
        if len(q) == 1:
            return np.asarray(p["inertia_1"] * ddq + self._gravity(q))
        elbow = q[1] + p.get("zero_2", 0.0)
        coupling, sine = p["coupling"] * np.cos(elbow), p["coupling"] * np.sin(elbow)
        both = p["inertia_2"] * (ddq[0] + ddq[1])
        torque = self._gravity(q)
        torque[0] += p["inertia_1"] * ddq[0] + both + coupling * (2 * ddq[0] + ddq[1])
        torque[0] -= sine * (2 * dq[0] + dq[1]) * dq[1]
        torque[1] += both + p["armature_2"] * ddq[1] + coupling * ddq[0] + sine * dq[0] * dq[0]
        return torque

    def _gravity(self, q: Array) -> Array:
        p = self.values
        if len(q) == 1:
            return np.asarray(p["gravity_1"] * np.cos(q + p.get("zero_1", 0.0)))
        shoulder, elbow = q[0] + p.get("zero_1", 0.0), q[1] + p.get("zero_2", 0.0)
        second = p["gravity_2"] * np.cos(shoulder + elbow)
        return np.stack((p["gravity_1"] * np.cos(shoulder) + second, second))

    def _viscous(self, joint: int, v: Array) -> Array:
        return viscous(self.values, joint, v, self._step(joint, v))

    def _ripple(self, joint: int, q: Array) -> Array:
        """Ratio of motor torque to nominal torque at the angles q [rad]."""
        cycles = self.values.get(f"ripple_cycles_{joint}", 0.0) * q
        sine, cosine = (self.values.get(f"ripple_{part}_{joint}", 0.0) for part in ("sin", "cos"))
        return np.asarray(1.0 + sine * np.sin(cycles) + cosine * np.cos(cycles))

    def _by_angle(self, joint: int, q: Array) -> Array:
        """Load torque due to the cable and to cogging at the angles q [rad]."""
        cycles = self.values.get(f"cogging_cycles_{joint}", 0.0) * q
        sine, cosine = (self.values.get(f"cogging_{part}_{joint}", 0.0) for part in ("sin", "cos"))
        cable = self.values.get(f"cable_stiffness_{joint}", 0.0) * q
        return np.asarray(cable - sine * np.sin(cycles) - cosine * np.cos(cycles))

    def _step(self, joint: int, v: Array) -> Array:
        return direction(v, self.values.get(f"coulomb_width_{joint}", 0.0))

    def _level(self, joint: int, v: Array) -> Array:
        return dry_level(self.values, joint, v)

    def _load_friction(self, dq: Array, torque: Array) -> Array:
        loads = [self.values.get(f"load_{joint}", 0.0) for joint in range(1, len(self.joints) + 1)]
        steps = [self._step(joint, dq[..., joint - 1]) for joint in range(1, len(self.joints) + 1)]
        return np.asarray(np.stack(steps, axis=-1) * loads * np.abs(torque))

    def _offsets(self) -> Array:
        return np.array([self.values[f"offset_{joint}"] for joint in range(1, len(self.joints) + 1)])


def _joints_first(values: Array) -> Array:
    return np.moveaxis(values, -1, 0)
