"""The limit that kept the pilot from raising the torque further. If a pilot chose the torque, the user cannot raise
peak_torque, so messages name this limit instead.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array
from hil.estimator.selection.verdict import TorqueLimit
from hil.plan.supply_speed import within_supply

REACHED = 0.5  # if a smaller fraction of every limit was reached, something else limited the torque


def torque_limit(config: Config, samples: NDArray[np.void], index: int | None = None) -> TorqueLimit | None:
    """The limit that the pilot approached most closely, and the fraction of it that was reached.

    index: the joint whose limits count; None for all joints. Returns None without a pilot, because the user then gave
    peak_torque.
    """
    if not config.experiment.pilot or not len(samples):
        return None
    shares: dict[TorqueLimit, float] = {}
    for place, (joint, slower) in enumerate(zip(config.joints, within_supply(config).joints, strict=True)):
        if index not in (None, place):
            continue
        low, high = joint.position_limit
        rest = config.arm.rest_pose[place]
        position: Array = samples["position"][:, place]
        goals: Array = samples["goal_current"][:, place]
        velocity: Array = samples["velocity"][:, place]
        goal = "voltage_limit" if joint.drive_mode is Mode.PWM else "current_limit"
        below, above = rest - np.nanmin(position), np.nanmax(position) - rest
        fastest = TorqueLimit(f"velocity_limit of {joint.name}")
        if slower.velocity_limit < joint.velocity_limit:
            fastest = TorqueLimit(f"{slower.velocity_limit:g} rad/s that the supply allows {joint.name}", False)
        shares |= {
            TorqueLimit(f"{goal} of {joint.name}"): float(np.nanmax(np.abs(goals))) / joint.goal_limit,
            fastest: float(np.nanmax(np.abs(velocity))) / slower.velocity_limit,
            TorqueLimit(f"position_limit of {joint.name}"): float(max(below / (rest - low), above / (high - rest))),
        }
    limit = max(shares, key=lambda each: shares[each])
    reached = f"{100 * shares[limit]:.0f} %"
    if shares[limit] < REACHED:
        said = f"the pilot's safety rules limited the torque; it reached at most {reached} of any limit"
        return TorqueLimit(said, can_be_raised=False)
    if not limit.can_be_raised:
        return TorqueLimit(f"the pilot reached {reached} of the {limit.said}", can_be_raised=False)
    return TorqueLimit(f"the {limit.said} (the pilot reached {reached} of it, which limited its torque)")
