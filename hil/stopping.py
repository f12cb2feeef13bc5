"""How far a joint still goes when it passes a limit at speed and is stopped: braked, cut, or by its watchdog."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.closed_loop import Feedback, respond, resting
from estimator.physics import Physics
from hil.config import Config
from hil.damping import braking_gains
from hil.dry_run import scaled_feedback
from hil.ensemble import Ensemble
from hil.stabiliser import feedback_of

Array = NDArray[np.float64]

_LONGEST_S = 1.0
_ARMS = 48


@dataclass(frozen=True)
class Stopping:
    """Largest way beyond a limit over the ensemble (joints,) [rad], by how the arm is stopped.

    braked: braking, then cut. cut: torque off at the next sample. watchdog: the last goal current, at its largest and
    outwards, for the watchdog's time, then none.
    """

    braked: Array
    cut: Array
    watchdog: Array

    @property
    def worst(self) -> Array:
        longest: Array = np.maximum(np.maximum(self.braked, self.cut), self.watchdog)
        return longest


def stopping_distance(config: Config, ensemble: Ensemble, velocity: Array, current: Array) -> Stopping:
    """From each limit, outwards at `velocity` (joints,) [rad/s] with at most `current` (joints,) [A] in force."""
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    joints = len(config.joints)
    ways = np.zeros((3, joints))
    few = ensemble.first(_ARMS)
    for physics, scale in zip(few.physics, few.torque_scale, strict=True):
        for joint in range(joints):
            for side in (0, 1):
                outward = 1.0 if side else -1.0
                state = _at_limit(config, joint, side, outward * float(velocity[joint]))
                last = np.zeros(joints)
                last[joint] = outward * current[joint] * constants[joint]
                for kind, way in enumerate(_ways(config, physics, scale, state, last, joint, outward)):
                    ways[kind, joint] = max(ways[kind, joint], way)
    return Stopping(*ways)


def _at_limit(config: Config, joint: int, side: int, velocity: float) -> Array:
    """One joint on its limit and moving outwards, the others at rest."""
    pose = np.array(config.arm.rest_pose)
    pose[joint] = config.joints[joint].position_limit[side]
    state = resting(pose)
    state[1, joint] = state[4, joint] = velocity
    return state


def _ways(
    config: Config, physics: Physics, scale: Array, state: Array, last: Array, joint: int, outward: float
) -> tuple[float, float, float]:
    rate = config.experiment.rate
    samples = round(_LONGEST_S * rate)
    clamp = feedback_of(config).limit
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    brake = Feedback(np.zeros_like(clamp), np.array(braking_gains(config)) * constants, state[0], clamp)
    braking = max(1, round(config.safety.damp_time * rate))
    start = state.copy()
    start[2] = last * scale

    def way(pieces: tuple[tuple[Array, Feedback, int], ...]) -> float:
        at, farthest = start, 0.0
        for command, feedback, count in pieces:
            if count == 0:
                continue
            held = np.repeat((command * scale)[:, None], count, axis=1)
            moved = respond(physics, at, held, rate, scaled_feedback(feedback, scale))
            beyond = outward * (moved.position[joint] - start[0, joint])
            turned = np.flatnonzero(outward * moved.velocity[joint] < 0)
            farthest = max(farthest, float(beyond[: turned[0] + 1 if turned.size else None].max()))
            if turned.size:
                break
            at = moved.state
        return farthest

    nothing, none = np.zeros_like(last), Feedback.none(len(last))
    silent = round(config.safety.watchdog * rate) + 1
    free = (nothing, none, samples)
    # One more sample passes before the guard has looked and the stop is under way.
    reaction = (last, none, 2)
    return (
        way((reaction, (nothing, brake, braking), free)),
        way((reaction, free)),
        way(((last, none, silent), free)),
    )
