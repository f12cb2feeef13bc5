"""Zero angles of a recording's joints, estimated from gravity before any fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import filtered_rows
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError
from hil.estimator.models.terms import base_names

CUTOFF, WIDTH = 8.0, 0.05  # Hz, rad/s
EXPLAINED = 0.5  # maximum ratio of the torque residual with free zero angles to that with the given ones
LEAST = 0.3  # rad; the fit itself can estimate smaller zero errors
QUARTER, TIE = 0.5 * np.pi, 1.05
"""Zeros that are multiples of QUARTER [rad] are preferred if their residual is less than TIE times the smallest
residual, since a weak or slow motion determines the zero of joint 2 poorly.
"""
SURE, ABOVE = 0.05, 2.0
"""A gravity torque reveals an angle only above this fraction of the RMS torque and this multiple of its residual."""


def turned_zeros(recordings: Sequence[Recording]) -> Array | None:
    """Return the angles (joints,) [rad] to add to the recorded ones so that joint 1 is measured from the horizontal.

    Returns None if the recordings give no evidence of a different zero. The gravity torque is regressed on the cosine
    and sine of the angle.
    """
    joints = recordings[0].joints
    names = base_names(joints)
    gravity = [names.index(f"gravity_{joint + 1}") for joint in range(joints)]
    try:
        plain, tau, level = _rows(recordings, np.zeros(joints))
        sines = [_rows(recordings, np.eye(joints)[0] * -QUARTER)[0][:, gravity]]
        if joints == 2:  # coupling, too, depends on the zero of joint 2
            sines.append(_rows(recordings, np.array([0.0, -QUARTER]))[0][:, [names.index("coupling")]])
    except EstimationError:
        return None
    both = np.concatenate((plain, *sines), axis=1)
    (upright, left), (found, left_turned) = (_solved(A, tau) for A in (plain, both))
    least = level * max(SURE, ABOVE * min(left, left_turned))
    if left_turned > EXPLAINED * left:
        return half_turns(upright[gravity], least)
    cosine, sine = found[gravity], found[len(names) : len(names) + joints]
    size = np.hypot(cosine, sine)
    if size[0] < least:
        return None
    angle = np.arctan2(-sine, cosine)
    zeros = np.concatenate((angle[:1], np.diff(angle)))
    zeros = (zeros + np.pi) % (2.0 * np.pi) - np.pi
    if joints == 2 and size[1] < least:
        zeros[1] = np.arctan2(-found[-1], found[names.index("coupling")])
    if np.abs(zeros).max() < LEAST:
        return half_turns(upright[gravity], least)
    whole = np.round(zeros / QUARTER) * QUARTER + 0.0  # not -0.0
    for simple in (whole, np.eye(joints)[0] * whole[0]):
        weights, left = _solved(*_rows(recordings, simple)[:2])
        if left < TIE * left_turned:
            half = half_turns(weights[gravity], least)
            return np.asarray(simple if half is None else simple + half)
    return np.asarray(zeros)


def half_turns(weights: Array, least: float) -> Array | None:
    """Return zeros (joints,) [rad], 0 or half a turn, that make all gravity torques positive; None if they already are
    positive.

    weights: gravity torque of each joint in a horizontal pose (joints,) [N m]; below `least`, its sign is ignored.
    """
    angle, angles = 0.0, []
    for weight in weights.tolist():
        angle = angle if abs(weight) < least else 0.0 if weight > 0.0 else np.pi
        angles.append(angle)
    zeros = np.abs(np.diff(angles, prepend=0.0))
    return zeros if zeros.any() else None


def _rows(recordings: Sequence[Recording], zeros: Array) -> tuple[Array, Array, float]:
    """Return the regressor and torques of inverse dynamics with `zeros` (joints,) [rad] added to the angles, and the
    RMS torque of the strongest joint.

    Each joint's rows are divided by the RMS of its torque, so that the torques of a light joint count as well.
    """
    turned = (replace(each, position=each.position + zeros[:, None]) for each in recordings)
    rows = [filtered_rows(each, CUTOFF, WIDTH) for each in turned]
    Y = np.concatenate([each.regressor for each in rows], axis=1)
    tau = np.concatenate([each.torque for each in rows], axis=1)
    level = np.maximum(np.sqrt(np.mean(tau**2, axis=1, keepdims=True)), 1e-12)
    return (Y / level[:, :, None]).reshape(-1, Y.shape[2]), (tau / level).reshape(-1), float(level.max())


def _solved(A: Array, b: Array) -> tuple[Array, float]:
    norm = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    x = linalg.lstsq(A / norm, b, rcond=1e-10)[0] / norm
    return x, float(np.sqrt(np.mean((b - A @ x) ** 2)))
