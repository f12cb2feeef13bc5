"""The speed up to which the supply can drive the commanded currents, learned from a stopped run.

Back-EMF rises with speed. If it leaves too little of the supply voltage, a motor carries less current than commanded,
and the motion no longer determines the arm's parameters.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array
from hil.experiment.checks.joint_faults import BELOW_VOLTAGE
from hil.runs.recording import Phase

_DRIVEN = (Phase.RAMP_IN, Phase.WARM_UP, Phase.PERIODIC, Phase.RAMP_OUT)
_LAST_S = 0.25
"""Time before the end of a stopped run within which to search for the sample that caused the stop [s]."""


def delivered_speed(config: Config, samples: NDArray[np.void]) -> Array:
    """Speed (joints,) [rad/s] up to which the supply can drive the commanded currents, learned from a run that was
    stopped because the supply could not drive them. Infinite for joints whose currents followed their goals.
    """
    driven = samples[np.isin(samples["phase"], _DRIVEN)]
    last = driven[-max(2, math.ceil(_LAST_S * config.experiment.rate)) :]
    speed = np.full(len(config.joints), np.inf)
    for index, joint in enumerate(config.joints):
        if joint.drive_mode is not Mode.CURRENT:
            continue
        columns = (last[name][:, index].tolist() for name in ("goal_current", "current", "velocity"))
        behind = [
            abs(velocity)
            for goal, carried, velocity in zip(*columns, strict=True)
            if abs(carried) < (1.0 - config.safety.follow_share) * abs(goal)
            and joint.joint.servo.is_out_of_voltage(goal, carried, velocity)
        ]
        if behind:
            speed[index] = BELOW_VOLTAGE * max(behind)
    return speed
