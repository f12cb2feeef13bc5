"""Zero angle of a recording's joints, estimated from gravity before any fit."""

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
EXPLAINED = 0.5  # maximum ratio of the torque's residual with free zero angles to that with the given ones
LEAST = 0.3  # rad: smaller zero errors are left to the fit
SURE = 0.05  # fraction of the largest torque: weaker gravity does not reveal an angle


def turned_zeros(recordings: Sequence[Recording]) -> Array | None:
    """Return the angles (joints,) [rad] to add to the recorded ones so that joint 1 is measured from the horizontal.

    Returns None if the recordings give no evidence of a different zero. The gravity torque is regressed on the cosine
    and sine of the angle.
    """
    joints = recordings[0].joints
    names = base_names(joints)
    gravity = [names.index(f"gravity_{joint + 1}") for joint in range(joints)]
    try:
        upright = [filtered_rows(each, CUTOFF, WIDTH) for each in recordings]
        turned = [filtered_rows(_turned(each), CUTOFF, WIDTH) for each in recordings]
    except EstimationError:
        return None
    Y = np.concatenate([rows.regressor for rows in upright], axis=1)
    sines = np.concatenate([rows.regressor for rows in turned], axis=1)[:, :, gravity]
    tau = np.concatenate([rows.torque for rows in upright], axis=1).reshape(-1)
    plain = Y.reshape(-1, Y.shape[2])
    both = np.concatenate((plain, sines.reshape(-1, joints)), axis=1)
    (_, left), (found, left_turned) = (_solved(A, tau) for A in (plain, both))
    if left_turned > EXPLAINED * left:
        return None
    cosine, sine = found[gravity], found[len(names) :]
    size = np.hypot(cosine, sine)
    if size[0] < SURE * float(np.abs(tau).max()):
        return None
    angle = np.arctan2(-sine, cosine)
    zeros = np.concatenate((angle[:1], np.diff(angle)))
    zeros = (zeros + np.pi) % (2.0 * np.pi) - np.pi
    zeros[1:] = np.where(size[1:] < SURE * float(np.abs(tau).max()), 0.0, zeros[1:])
    return None if abs(zeros[0]) < LEAST else np.asarray(zeros)


def _turned(recording: Recording) -> Recording:
    position = recording.position.copy()
    position[0] -= 0.5 * np.pi
    return replace(recording, position=position)


def _solved(A: Array, b: Array) -> tuple[Array, float]:
    norm = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
    x = linalg.lstsq(A / norm, b, rcond=1e-10)[0] / norm
    return x, float(np.sqrt(np.mean((b - A @ x) ** 2)))
