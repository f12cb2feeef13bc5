"""Determines when a fault became observable, using a detector with more information than the program.

The fault's effect is judged by the data that the program received: does the position agree with the integral of the
velocity, does the current agree with the goals, and could any arm consistent with the prior have moved like this? The
last question is a sequential test: the arm's equations of motion, integrated over intervals of `STRETCH_S`, are linear
in its parameters. These start from the prior of the program's configuration and are estimated from all intervals so
far; each new interval is compared with its prediction. Unlike the program, the detector knows the noise in advance,
from an undisturbed run of the same arm. It excuses nothing: it says of an unsafe run whether more could have been seen.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config

Array = NDArray[np.float64]

STRETCH_S = 0.05
SURE = 4.0
"""Smallest threshold for the deviation of an interval [standard deviations]."""

MARGIN = 1.2
"""Factor on the largest deviation in the undisturbed run, which gives the threshold if that is larger."""

_STILL_RAD_S = 0.06
_STATIC = 1.5
_LAG_RAD = 0.02
_CURRENT_SHARE = 0.2


class Heard:
    """Data that the program received at `time` (n,) [s]: angle, velocity, current (n, joints) [rad, rad/s, A].

    goal, torque: current or voltage that it commanded, and the corresponding torque (n, joints) [A or V, N m].
    """

    def __init__(
        self, config: Config, heard: Sequence[Sequence[tuple[float, ...]]], sent: Sequence[Sequence[tuple[float, int]]]
    ) -> None:
        interval = 1.0 / config.experiment.rate
        columns = [np.array(each, float).reshape(-1, 4) for each in heard]
        last = columns[-1][:, 0]
        picked = [np.clip(np.searchsorted(each[:, 0], last, "right") - 1, 0, None) for each in columns]
        together = np.ones(last.size, bool)
        for each, index in zip(columns, picked, strict=True):
            together &= (each.shape[0] > 0) & (last - each[index, 0] < 0.5 * interval)
        self.time = last[together]
        told = [each[index][together] for each, index in zip(columns, picked, strict=True)]
        self.angle = np.column_stack([each[:, 1] for each in told])
        self.velocity = np.column_stack([each[:, 2] for each in told])
        self.current = np.column_stack([each[:, 3] for each in told])
        goals = []
        for joint, commands in zip(config.joints, sent, strict=True):
            when, ticks = np.array(commands, float).reshape(-1, 2).T
            latest = np.clip(np.searchsorted(when, self.time, "right") - 1, 0, None)
            goals.append(ticks[latest] * joint.joint.drive_unit(12.0))
        self.goal = np.column_stack(goals)
        self.torque = self.goal * [joint.torque_per_goal for joint in config.joints]


def visible_from(config: Config, prior: tuple[Array, Array], told: Heard, undisturbed: Heard) -> float:
    """First time at which the detector finds a fault [s]; infinite if it never does.

    prior: mean and covariance of the parameters, in the order of `_rows`.
    """
    moments = []
    for signal, floor in (
        (_disagreement, _LAG_RAD),
        (lambda heard: _not_carried(config, heard), 0.0),
        (lambda heard: _surprise(prior, heard, _noise(prior, undisturbed)), SURE),
    ):
        time, level = signal(told)
        _, usual = signal(undisturbed)
        beyond = np.flatnonzero(level > np.maximum(MARGIN * usual.max(axis=0, initial=0.0), floor).max())
        if beyond.size:
            moments.append(float(time[beyond[0]]))
    outside = _outside(config, told)
    return min([*moments, outside])


def _outside(config: Config, told: Heard) -> float:
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    fastest = [joint.velocity_limit for joint in config.joints]
    wrong = ((told.angle < low) | (told.angle > high) | (np.abs(told.velocity) > fastest)).any(axis=1)
    at = np.flatnonzero(wrong)
    return float(told.time[at[0]]) if at.size else np.inf


def _disagreement(told: Heard) -> tuple[Array, Array]:
    """Time (n,), and difference of position and integrated velocity over two intervals, worst joint (n, 1) [rad]."""
    step = np.diff(told.time, prepend=told.time[:1])[:, None]
    mean = 0.5 * (told.velocity + np.roll(told.velocity, 1, axis=0))
    apart = np.cumsum(np.diff(told.angle, axis=0, prepend=told.angle[:1]) - mean * step, axis=0)
    back = np.searchsorted(told.time, told.time - 2 * STRETCH_S)
    return told.time, np.abs(apart - apart[back]).max(axis=1, keepdims=True)


def _not_carried(config: Config, told: Heard) -> tuple[Array, Array]:
    """Time, and mean difference of current and goal over an interval, relative to the largest goal; not under PWM."""
    senses = [not joint.joint.servo.senses_supply and joint.drive_mode.goal_unit == "A" for joint in config.joints]
    largest = np.maximum(np.abs(told.goal).max(axis=0), 1e-9)
    former = np.roll(told.goal, 1, axis=0)
    off = np.minimum(np.abs(told.current - told.goal), np.abs(told.current - former)) / largest * senses
    back = np.searchsorted(told.time, told.time - STRETCH_S)
    total = np.cumsum(off, axis=0)
    mean = (total - total[back]) / np.maximum(np.arange(told.time.size) - back, 1)[:, None]
    return told.time, np.maximum(mean.max(axis=1, keepdims=True) - _CURRENT_SHARE, 0.0)


def _rows(told: Heard) -> tuple[Array, Array]:
    """Momentum and remaining terms of the equations of motion, per unit of each parameter (n, joints, parameters).

    In the order inertia_1, coupling, inertia_2, armature_2, gravity_1, gravity_2, viscous_1, viscous_2, coulomb_1,
    coulomb_2, offset_1, offset_2, tilt_1, tilt_2 (docs/model.md).
    """
    count, joints = told.angle.shape
    momentum, rest = np.zeros((2, count, 2, 14))
    q1, v1 = told.angle[:, 0], told.velocity[:, 0]
    momentum[:, 0, 0] = v1
    rest[:, 0, [4, 12]] = np.column_stack((np.cos(q1), np.sin(q1)))
    rest[:, 0, [6, 8, 10]] = np.column_stack((v1, np.tanh(v1 / 0.05), np.ones(count)))
    if joints == 2:
        q2, v2 = told.angle[:, 1], told.velocity[:, 1]
        cos_2, sin_2 = np.cos(q2), np.sin(q2)
        momentum[:, 0, 1], momentum[:, 0, 2] = cos_2 * (2 * v1 + v2), v1 + v2
        momentum[:, 1, 1], momentum[:, 1, 2], momentum[:, 1, 3] = cos_2 * v1, v1 + v2, v2
        rest[:, 1, 1] = sin_2 * v1 * (v1 + v2)
        for joint in (0, 1):
            rest[:, joint, [5, 13]] = np.column_stack((np.cos(q1 + q2), np.sin(q1 + q2)))
        rest[:, 1, [7, 9, 11]] = np.column_stack((v2, np.tanh(v2 / 0.05), np.ones(count)))
    return momentum[:, :joints], rest[:, :joints]


def _stretches(told: Heard) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Successive intervals: ends (m,), rows (m, joints, 14), torques (m, joints), joints at standstill (m, joints)."""
    momentum, rest = _rows(told)
    starts, ends = [], []
    at = 0
    for index in range(told.time.size):
        if told.time[index] - told.time[index - 1] > 2 * STRETCH_S + 1e-3:
            at = index  # replies are missing, so the motion in between is unknown
        elif told.time[index] - told.time[at] >= STRETCH_S - 1e-6:
            starts.append(at)
            ends.append(index)
            at = index
    rows, torques, stood = [], [], []
    for first, last in zip(starts, ends, strict=True):
        time = told.time[first : last + 1]
        seconds = time[-1] - time[0]
        mean = np.trapezoid(rest[first : last + 1], time, axis=0) / seconds
        rows.append((momentum[last] - momentum[first]) / seconds + mean)
        held = np.diff(time)[:, None] * told.torque[first:last]
        torques.append(held.sum(axis=0) / seconds)
        stood.append((np.abs(told.velocity[first : last + 1]) < _STILL_RAD_S).all(axis=0))
    joints = told.angle.shape[1]
    return (
        told.time[ends],
        np.array(rows).reshape(-1, joints, 14),
        np.array(torques).reshape(-1, joints),
        np.array(stood, bool).reshape(-1, joints),
    )


def _noise(prior: tuple[Array, Array], undisturbed: Heard) -> Array:
    """Standard deviation of each joint's torque residual after a fit with the prior, over an undisturbed run [N m]."""
    _, rows, torque, stood = _stretches(undisturbed)
    mean, covariance = prior
    noise = np.full(torque.shape[1], 0.02 * np.abs(torque).max())
    for _ in range(3):
        moved = ~stood
        weights = (moved / noise**2).reshape(-1)
        flat = rows.reshape(-1, 14)
        information = np.linalg.pinv(covariance) + (flat * weights[:, None]).T @ flat
        best = mean + np.linalg.solve(
            information + 1e-12 * np.eye(14), (flat * weights[:, None]).T @ (torque.reshape(-1) - flat @ mean)
        )
        left = torque - rows @ best
        noise = np.array([max(float(np.std(left[moved[:, joint], joint])), 1e-6) for joint in range(torque.shape[1])])
    return noise


def _surprise(prior: tuple[Array, Array], told: Heard, noise: Array) -> tuple[Array, Array]:
    """Ends of intervals, and deviation from the prediction of the worst joint (m, 1) [standard deviations]."""
    ends, rows, torque, stood = _stretches(told)
    mean, covariance = prior[0].copy(), prior[1].copy()
    surprise = np.zeros((ends.size, 1))
    for index in range(ends.size):
        for joint in range(torque.shape[1]):
            row = rows[index, joint]
            gain = covariance @ row
            variance = float(row @ gain) + noise[joint] ** 2
            off = float(torque[index, joint] - row @ mean)
            holds = 0.0
            if stood[index, joint]:
                dry = 8 + joint
                holds = _STATIC * max(0.0, mean[dry] + float(np.sqrt(max(covariance[dry, dry], 0.0))))
            beyond = max(abs(off) - holds, 0.0)
            surprise[index] = max(surprise[index, 0], beyond / np.sqrt(variance))
            if not stood[index, joint]:
                mean += gain * off / variance
                covariance -= np.outer(gain, gain) / variance
    return ends, surprise
