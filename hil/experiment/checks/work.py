"""Check the work of the motors: a motor that only takes energy out of the arm is turning against its command.

Work is checked only without a stabiliser. Without one, the arm starts at a stable rest pose and cannot return more work
than was put in. A motor that keeps taking work out of the arm is therefore turning the wrong way.

Part of the compiled loop `joint_checks`; a record of type `MEMORY` holds a joint's state.
"""

from typing import Any

import numpy as np

from hil.estimator.compiled import inner

__all__ = ["MEMORY", "TOLERANCE_RAD", "begin", "look"]

TOLERANCE_RAD = 0.04
"""A motor is considered reversed if the work that it has taken out of the arm, divided by the joint's largest planned
torque, exceeds this [rad].

Because of delays, a healthy motor may reach 0.02 rad (with a heavy arm at 20 Hz).
"""

_OF_OTHERS = 0.5
"""Fraction of the work done by the other joints' motors that this joint's motor may take out of the arm."""

MEMORY = np.dtype([("scale", "f8"), ("least", "f8"), ("done", "f8"), ("held", "f8")])
"""Constants and state of the check of one joint.

scale: torque per goal [N m/A or N m/V]. least: lowest work that does not indicate a reversal [J]. done: work done so
far [J]. held: latest goal [A or V].
"""


def begin(memory: Any, scale: float, planned: float) -> None:
    """Initialise a zero-filled record. scale: torque per goal [N m/A or N m/V]. planned: largest goal [A or V]."""
    memory["scale"] = scale
    memory["least"] = -TOLERANCE_RAD * planned * scale


def look(joints: Any, joint: int, goal: float, moved: float) -> float:
    """Add the work done by the previous goal; return the work taken out of the arm [J] if it is too much, otherwise -1.

    joints: records of all joints, with this memory in their field `work`. goal: the new goal [A or V]. moved:
    displacement since the previous sample [rad]; 0 if the goals in between are unknown.
    """
    memory = joints[joint].work
    held, memory.held = memory.held, goal
    memory.done += memory.scale * held * moved
    done = memory.done
    if done >= memory.least:
        return -1.0
    others = 0.0
    for other in range(len(joints)):
        if other != joint and joints[other].work.done > 0.0:
            others += joints[other].work.done
    return float(-done) if done < memory.least - _OF_OTHERS * others else -1.0


look = inner(look)
