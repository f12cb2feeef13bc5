"""Closed-loop simulation of an ensemble of chains under goal torques, as in an experiment.

At each sample, a goal torque is added to the torque of a software spring and damper, which is computed from the angles
and velocities of the previous sample, as in the real loop. In between, the motion is integrated by the linearly
implicit Euler method, with the slope of friction evaluated at the old velocity. The feedback at every sample keeps the
errors of this first-order method small.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.kernels import accelerate, invert, move, place, room
from hil.estimator.compiled import compiled

LONGEST_STEP = 1.3e-3  # s
RAN_AWAY = 1e3  # rad/s
NEAR_REST = 0.2  # rad: distance from the rest pose within which the surface may support the arm
YIELDS = 0.03  # rad: how far that surface gives way under a joint's largest torque
STOP_YIELDS = 0.01  # rad: how far a joint's own end stop gives way under its largest torque
PRESSED_SHARE = 0.03  # of a joint's largest torque; less gravity torque does not press the joint against the surface
VISCOUS, COULOMB, OFFSET, WIDTH, SCALE, LAG = range(6)
DRIVE_TERMS = ("viscous", "coulomb", "offset", "coulomb_width", "torque_scale", "lag")


@dataclass(frozen=True)
class ChainArms:
    """An ensemble of arms, each a candidate for the real one.

    rigid: base parameters (arms, base parameters) [SI].
    drive: DRIVE_TERMS (arms, 6, joints) [SI]; `torque_scale` is the ratio of true to commanded torque.
    """

    base: BaseParameters
    rigid: Array
    drive: Array

    @property
    def size(self) -> int:
        return len(self.rigid)

    def first(self, count: int) -> "ChainArms":
        return ChainArms(self.base, self.rigid[:count], self.drive[:count])

    def and_more(self, others: "ChainArms") -> "ChainArms":
        """Return these arms followed by others of the same chain."""
        return ChainArms(
            self.base, np.concatenate((self.rigid, others.rigid)), np.concatenate((self.drive, others.drive))
        )

    def chosen(self, arms: Any) -> "ChainArms":
        return ChainArms(self.base, self.rigid[arms], self.drive[arms])

    @property
    def mean(self) -> "ChainArms":
        """One arm with the mean base parameters and the median drive parameters."""
        return ChainArms(self.base, self.rigid.mean(axis=0)[None], np.median(self.drive, axis=0)[None])


@dataclass(frozen=True)
class Loop:
    """The software's part of the closed loop.

    rate: samples per second.
    goal: torques (samples, joints) [N m].
    stiffness, damping: gains of the spring [N m/rad] and damper [N m s/rad] towards `pose` (joints,).
    pose: rest pose (joints,) [rad], in which a surface keeps gravity from moving joints further down.
    limit: largest commanded torque (joints,) [N m].
    stops: side on which each joint rests against its own end stop in the rest pose (joints,): -1, 1, or 0 for none;
    None if no joint does. Such a joint is supported by its end stop, not by the surface, whatever the angles of the
    other joints. Nothing supports a joint whose largest torque is 0.
    pull: torque added to that of the spring and damper; None if they act alone.
    """

    rate: float
    goal: Array
    stiffness: Array
    damping: Array
    pose: Array
    limit: Array
    stops: Array | None = None
    pull: "Pull | None" = None


@dataclass(frozen=True)
class Pull:
    """Torque that grows while a joint is off its path, so that friction and unknown weights cannot keep it off.

    path: positions (samples, joints) [rad]. per_second: growth relative to the spring's torque [1/s]. share: maximum of
    this torque, as a fraction of the joint's largest torque.
    """

    path: Array
    per_second: float
    share: float


@dataclass(frozen=True)
class Motions:
    """Angles, velocities and commanded torques of all arms (arms, samples, joints) [rad, rad/s, N m].

    The values are NaN once an arm's motion has diverged.
    """

    position: Array
    velocity: Array
    torque: Array


def roll_out(arms: ChainArms, loop: Loop, start: Array, speed: Array | None = None) -> Motions:
    """Return the motions of all arms from angles `start` (joints,) or (arms, joints) [rad].

    The arms start at rest unless `speed` [rad/s], of the same shape as `start`, is given.
    """
    n, samples = arms.base.chain.joints, len(loop.goal)
    at = np.broadcast_to(start, (arms.size, n))
    moving = np.zeros((arms.size, n)) if speed is None else np.broadcast_to(speed, (arms.size, n))
    shape = arms.size, samples, n
    position, velocity, torque = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    steps = max(1, math.ceil(1.0 / (loop.rate * LONGEST_STEP)))
    stops = np.zeros(n) if loop.stops is None else loop.stops
    pressed = weights(arms, loop.pose)
    is_carried = (np.abs(pressed) > PRESSED_SHARE * loop.limit) & (stops == 0.0)
    pressed = np.where(is_carried, -np.sign(pressed), 0.0)
    software = tuple(
        np.ascontiguousarray(each, dtype=np.float64)
        for each in (loop.goal, loop.stiffness, loop.damping, loop.pose, loop.limit, stops, *_pull_of(loop))
    )
    for arm in range(arms.size):
        link, armature = _split(arms, arm)
        _roll(
            *(arms.base.chain.arrays, link, armature, np.ascontiguousarray(arms.drive[arm]), software),
            *(pressed[arm], np.array(at[arm]), np.array(moving[arm]), 1.0 / (loop.rate * steps), steps),
            *(room(n), position[arm], velocity[arm], torque[arm]),
        )
    return Motions(position, velocity, torque)


def _pull_of(loop: Loop) -> tuple[Array, Array, Array]:
    """Return the path (samples, joints), the torque's growth per sample and radian (joints,), and its maximum
    (joints,).

    The path is empty if `loop.pull` is None.
    """
    if loop.pull is None:
        return np.empty((0, len(loop.limit))), np.zeros_like(loop.limit), np.zeros_like(loop.limit)
    return loop.pull.path, loop.pull.per_second / loop.rate * loop.stiffness, loop.pull.share * loop.limit


def weights(arms: ChainArms, pose: Array) -> Array:
    """Return the torque that holds each arm still in a pose (arms, joints) [N m], without friction."""
    n = arms.base.chain.joints
    at, still = np.broadcast_to(pose, (arms.size, n)), np.zeros(n)
    out = np.empty((arms.size, n))
    work = room(n)
    rotation, translation, axis, gravity = arms.base.chain.arrays
    for arm in range(arms.size):
        link, armature = _split(arms, arm)
        place(rotation, translation, axis, np.array(at[arm]), work[0], work[1])
        move(link, armature, still, work)
        accelerate(armature, gravity, still, still, work)
        out[arm] = work[5] + arms.drive[arm, OFFSET]
    return out


def mass_matrices(chain: Chain, link: Array, armature: Array, poses: Array) -> Array:
    """Return the mass matrices (poses, joints, joints) [kg m^2] of one arm in `poses` (poses, joints).

    link: inertial parameters (joints, 10). armature: (joints,).
    """
    n = chain.joints
    work, still = room(n), np.zeros(n)
    rotation, translation, axis, _ = chain.arrays
    mass = np.empty((len(poses), n, n))
    link, armature = np.ascontiguousarray(link), np.ascontiguousarray(armature)
    for pose, matrix in zip(np.ascontiguousarray(poses, dtype=np.float64), mass, strict=True):
        place(rotation, translation, axis, pose, work[0], work[1])
        move(link, armature, still, work)
        matrix[:] = work[4]
    return mass


def inertias(arms: ChainArms, poses: Array) -> tuple[Array, Array]:
    """Return two inertias of each joint, each (arms, joints) [kg m^2].

    The first is the mean over `poses` (poses, joints) with the other joints held, the second the minimum over `poses`
    with the other joints free.
    """
    n = arms.base.chain.joints
    held, free = np.empty((arms.size, n)), np.empty((arms.size, n))
    for arm in range(arms.size):
        mass = mass_matrices(arms.base.chain, *_split(arms, arm), poses)
        # Unlike np.sum, np.cumsum rounds a column's sum in the same way, however many columns there are.
        held[arm] = np.cumsum(np.diagonal(mass, axis1=1, axis2=2) / len(poses), axis=0)[-1]
        free[arm] = (1.0 / np.diagonal(linalg.inv(mass), axis1=1, axis2=2)).min(axis=0)
    return held, free


def is_physical(arms: ChainArms, poses: Array) -> Any:
    """Return whether each arm (arms,) has a positive definite mass matrix in all `poses` (poses, joints)."""
    n = arms.base.chain.joints
    work, still = room(n), np.zeros(n)
    rotation, translation, axis, _ = arms.base.chain.arrays
    good = np.ones(arms.size, dtype=bool)
    for arm in range(arms.size):
        link, armature = _split(arms, arm)
        for pose in np.ascontiguousarray(poses, dtype=np.float64):
            place(rotation, translation, axis, pose, work[0], work[1])
            move(link, armature, still, work)
            if linalg.eigvalsh(work[4])[0] <= 0.0:
                good[arm] = False
                break
    return good


def _split(arms: ChainArms, arm: int) -> tuple[Array, Array]:
    table = arms.base.as_all(arms.rigid[arm]).reshape(-1, TERMS)
    return np.ascontiguousarray(table[:, :-1]), np.ascontiguousarray(table[:, -1])


def _roll_loop(  # noqa: PLR0912
    chain: Any,
    link: Any,
    armature: Any,
    drive: Any,
    software: Any,
    pressed: Any,
    q: Any,
    v: Any,
    h: float,
    steps: int,
    work: Any,
    position: Any,
    velocity: Any,
    torque: Any,
) -> None:
    rotation, translation, axis, gravity = chain
    goal, stiffness, damping, pose, limit, stops, path, growth, most_pull = software
    n = q.size
    still, real, pull = np.zeros(n), np.zeros(n), np.zeros(n)
    seen_q, seen_v = q.copy(), v.copy()
    A, inverse, factor = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    b, u = np.zeros(n), np.zeros(n)
    for k in range(goal.shape[0]):
        for j in range(n):
            if path.shape[0] > 0:
                pull[j] = min(max(pull[j] + growth[j] * (path[k, j] - seen_q[j]), -most_pull[j]), most_pull[j])
            wanted = goal[k, j] + pull[j] + stiffness[j] * (pose[j] - seen_q[j]) - damping[j] * seen_v[j]
            u[j] = min(max(wanted, -limit[j]), limit[j])
            seen_q[j], seen_v[j] = q[j], v[j]
            position[k, j], velocity[k, j], torque[k, j] = q[j], v[j], u[j]
        for _ in range(steps):
            place(rotation, translation, axis, q, work[0], work[1])
            move(link, armature, v, work)
            accelerate(armature, gravity, v, still, work)
            carried = 1.0  # effective fraction of the surface's stiffness; it falls with distance from the rest pose
            for j in range(n):
                carried = min(carried, 2.0 - 2.0 * abs(q[j] - pose[j]) / NEAR_REST)
            for j in range(n):
                lag = drive[5, j]
                kept = math.exp(-h / lag) if lag > 0.0 else 0.0
                real[j] = kept * real[j] + (1.0 - kept) * u[j] * drive[4, j]
                bend = math.tanh(v[j] / drive[3, j])
                slope = drive[0, j] + drive[1, j] * (1.0 - bend * bend) / drive[3, j]
                b[j] = real[j] - work[5][j]
                b[j] -= drive[2, j] + drive[0, j] * v[j] + drive[1, j] * bend
                for i in range(n):
                    A[j, i] = work[4][j, i]
                A[j, j] += h * slope
                stiff = 0.0
                if stops[j] * (q[j] - pose[j]) > 0.0:
                    stiff = limit[j] / STOP_YIELDS
                elif carried > 0.0 and pressed[j] * (q[j] - pose[j]) > 0.0:
                    stiff = carried * limit[j] / YIELDS
                if stiff > 0.0:
                    firm = math.sqrt(stiff * work[4][j, j])
                    b[j] -= stiff * (q[j] - pose[j] + h * v[j]) + firm * v[j]
                    A[j, j] += h * (firm + h * stiff)
            if not invert(A, inverse, factor):
                return
            for j in range(n):
                change = 0.0
                for i in range(n):
                    change += inverse[j, i] * b[i]
                still[j] = h * change
            for j in range(n):
                v[j] += still[j]
                still[j] = 0.0
                q[j] += h * v[j]
                if not abs(v[j]) < RAN_AWAY:
                    for i in range(n):
                        position[k, i] = velocity[k, i] = np.nan
                    return


_roll: Callable[..., None] = compiled(_roll_loop, fastmath={"contract"})
