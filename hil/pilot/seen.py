"""Commands and motion of a run from its first ramp on; the pilot learns from them no matter how the run ended."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.estimator.arrays import Array
from hil.plan.stabiliser import feedback_torque
from hil.runs.recording import Phase

_FEWEST = 40  # smallest useful number of samples


@dataclass(frozen=True)
class Seen:
    """Commands and motion of a run.

    command, torque: torque without and with the stabiliser's contribution (joints, samples) [N m]. position: measured
    angles (joints, samples) [rad], NaN where a reply is missing. pose: pose before the run (joints,) [rad]. end: last
    pose (joints,) [rad].
    """

    command: Array
    torque: Array
    position: Array
    pose: Array
    end: Array

    @property
    def swing(self) -> Array:
        """Range of motion (joints,) [rad]."""
        swing: Array = np.nanmax(self.position, axis=1) - np.nanmin(self.position, axis=1)
        return swing


def seen_of(config: Config, samples: NDArray[np.void]) -> Seen | None:
    """Extract the ramp and the first period of a recording; return None if the recording is too short."""
    before = np.nonzero(samples["phase"] == Phase.REST)[0]
    played = (samples["phase"] == Phase.RAMP_IN) | (samples["phase"] == Phase.PERIODIC)
    rows = np.nonzero(played & (samples["segment"] == 0) & (samples["period"] < 1))[0]
    if rows.size < _FEWEST or not before.size:
        return None
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    torque = samples["goal_current"][rows].T * constants[:, None]
    command = torque
    if config.stabiliser is not None:
        with_former = samples[rows[0] - 1 : rows[-1] + 1]
        command = torque - np.nan_to_num(feedback_torque(config, with_former)).T
    position = samples["position"][rows].T.astype(np.float64)
    pose = _last_finite(samples["position"][before])
    if not np.isfinite(pose).all() or not np.isfinite(position).any(axis=1).all():
        return None
    end = _last_finite(samples["position"])
    return Seen(np.ascontiguousarray(command), np.ascontiguousarray(torque), position, pose, end)


def _last_finite(position: Array) -> Array:
    """Median of each joint's last samples (joints,)."""
    return np.asarray(np.nanmedian(position[-20:], axis=0), dtype=np.float64)
