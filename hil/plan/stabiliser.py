"""A spring and a damper in software, for arms that have no stable pose of their own: horizontal, inverted.

The estimator is given the torque that was really commanded, spring and damper included; what they did can be computed
from the recording at any time, since they act on the former sample's position and velocity alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.state import State
from hil.estimator.simulation.closed_loop import Feedback


class Stabiliser:
    """Adds its currents to a goal. A joint whose reply was missing keeps the current that it had."""

    def __init__(self, config: Config) -> None:
        assert config.stabiliser is not None
        self._gains = [
            (stiffness / joint.torque_per_goal, damping / joint.torque_per_goal, pose)
            for joint, stiffness, damping, pose in zip(
                config.joints,
                config.stabiliser.stiffness,
                config.stabiliser.damping,
                config.arm.rest_pose,
                strict=True,
            )
        ]
        self._added = [0.0] * len(self._gains)

    def add(self, goal: list[float], former: State | None) -> list[float]:
        """Goal currents [A] with the stabiliser's own added. former: the sample before this command."""
        if former is None:
            return goal
        added = self._added
        for index, (spring, damper, pose) in enumerate(self._gains):
            if not former.missing[index]:
                added[index] = spring * (pose - former.position[index]) - damper * former.velocity[index]
        return [wanted + more for wanted, more in zip(goal, added, strict=True)]


def feedback_of(config: Config) -> Feedback:
    """The stabiliser, or nothing, and the clamp [N m]."""
    limit = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
    pose = np.array(config.arm.rest_pose)
    if config.stabiliser is None:
        return Feedback(np.zeros_like(pose), np.zeros_like(pose), pose, limit)
    return Feedback(np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping), pose, limit)


@dataclass(frozen=True)
class StabiliserShare:
    """What the stabiliser did during the periods, per joint [N m]: RMS and peak of its torque, RMS of all torque."""

    rms: NDArray[np.float64]
    peak: NDArray[np.float64]
    commanded_rms: NDArray[np.float64]

    @property
    def share(self) -> NDArray[np.float64]:
        """The stabiliser's RMS over that of all torque (joints,); over 1 where the excitation worked against it."""
        return np.asarray(self.rms / np.maximum(self.commanded_rms, 1e-12))

    @classmethod
    def from_json(cls, entry: dict[str, Any]) -> "StabiliserShare":
        """From result.json."""
        return cls(*(np.array(entry[key]) for key in ("rms_torque", "peak_torque", "commanded_rms_torque")))

    def as_json(self) -> dict[str, list[float]]:
        """For result.json."""
        return {
            "rms_torque": self.rms.tolist(),
            "peak_torque": self.peak.tolist(),
            "commanded_rms_torque": self.commanded_rms.tolist(),
        }

    def said(self, names: Sequence[str]) -> str:
        """In one sentence, for the joints of these names."""
        each = ", ".join(
            f"{name} {rms:.3f} of {whole:.3f} N m RMS ({100 * part:.0f} %, peak {peak:.3f})"
            for name, rms, whole, part, peak in zip(
                names, self.rms, self.commanded_rms, self.share, self.peak, strict=True
            )
        )
        return f"Of the torque, the stabiliser gave: {each}."


def stabiliser_share(config: Config, samples: NDArray[np.void]) -> StabiliserShare:
    """From consecutive recorded rows of one multisine (hil.runs.recording)."""
    torque = feedback_torque(config, samples)
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    commanded = samples["goal_current"][1:] * constants
    return StabiliserShare(
        np.sqrt(np.nanmean(torque**2, axis=0)),
        np.nanmax(np.abs(torque), axis=0),
        np.sqrt(np.mean(commanded**2, axis=0)),
    )


def feedback_torque(config: Config, samples: NDArray[np.void]) -> NDArray[np.float64]:
    """The stabiliser's torque in all rows but the first, (rows - 1, joints) [N m]; NaN where a reply was missing."""
    assert config.stabiliser is not None
    stiffness, damping = np.array(config.stabiliser.stiffness), np.array(config.stabiliser.damping)
    former = samples[:-1]
    torque: NDArray[np.float64] = (
        stiffness * (np.array(config.arm.rest_pose) - former["position"]) - damping * former["velocity"]
    )
    return torque
