"""How well given parameters foretell a recording that was not used to find them."""

from collections.abc import Mapping, Sequence

import numpy as np

from estimator.arrays import Array
from estimator.model import Model
from estimator.physics import Physics
from estimator.recording import Recording
from estimator.shooting import Shooting

LEAST_WIDTH = 1e-3  # rad/s of a Coulomb step, where a method knows none


def prediction_rms(
    recordings: Sequence[Recording], parameters: Mapping[str, float], length: float, joints: int
) -> Array:
    """RMS of measured less simulated position (joints,) [rad], the simulation set on its way every `length` [s].

    It starts from angle and velocity as the samples right around the start show them, and then sees the torque
    only. `parameters` [SI] by the names of `Model.names`, with zero_1 .. where the encoder's zero was found to be
    off. A simulation that runs away counts as wrong by pi.
    """
    problem = Shooting(recordings, Model(joints), False, length)
    known = {f"coulomb_width_{joint + 1}": LEAST_WIDTH for joint in range(joints)} | dict(parameters)
    physics = Physics.of(known)
    zero = np.array([known.get(f"zero_{joint + 1}", 0.0) for joint in range(joints)])
    squares, samples = np.zeros(joints), 0
    for segment in problem.segments:
        state = segment.state.copy()
        state[0] -= zero
        error = segment.position - zero[:, None] - problem.position(segment, physics, state)
        error = np.where(np.isfinite(segment.position), error, 0.0)
        error = np.clip(np.nan_to_num(error, nan=np.pi, posinf=np.pi, neginf=-np.pi), -np.pi, np.pi)
        squares += np.sum(error**2, axis=1)
        samples += error.shape[1]
    rms: Array = np.sqrt(squares / samples)
    return rms
