"""The limit that kept the pilot from raising the torque further. If a pilot chose the torque, the user cannot raise
peak_torque, so messages name this limit instead.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array

REACHED = 0.5  # if a smaller fraction of every limit was reached, something else limited the torque


def torque_limit(config: Config, samples: NDArray[np.void], index: int | None = None) -> str:
    """Describe, for a message, the limit that the pilot approached most closely: its setting, and the fraction used.

    index: the joint whose limits count; None for all joints. Returns "" without a pilot, because the user then gave
    peak_torque.
    """
    if not config.experiment.pilot or not len(samples):
        return ""
    shares: dict[str, float] = {}
    for place, joint in enumerate(config.joints):
        if index not in (None, place):
            continue
        low, high = joint.position_limit
        rest = config.arm.rest_pose[place]
        position: Array = samples["position"][:, place]
        goals: Array = samples["goal_current"][:, place]
        velocity: Array = samples["velocity"][:, place]
        goal = "voltage_limit" if joint.drive_mode is Mode.PWM else "current_limit"
        below, above = rest - np.nanmin(position), np.nanmax(position) - rest
        shares |= {
            f"{goal} of {joint.name}": float(np.nanmax(np.abs(goals))) / joint.goal_limit,
            f"velocity_limit of {joint.name}": float(np.nanmax(np.abs(velocity))) / joint.velocity_limit,
            f"position_limit of {joint.name}": float(max(below / (rest - low), above / (high - rest))),
        }
    setting = max(shares, key=lambda name: shares[name])
    reached = f"{100 * shares[setting]:.0f} %"
    if shares[setting] < REACHED:
        return f"the torque (the pilot's safety rules limited it; it reached at most {reached} of any limit)"
    return f"the {setting} (the pilot reached {reached} of it, which limited its torque)"
