"""Simulation of the whole experiment on one arm, period by period, just as the stream runs it on a real arm."""

from dataclasses import dataclass

import numpy as np

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array
from hil.estimator.data.periodicity import settling_difference
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import Feedback, Response, respond, resting
from hil.estimator.simulation.many_arms import Commands
from hil.plan.plan import Plan, Segment


@dataclass(frozen=True)
class Motion:
    """The simulated motion (joints, samples) [rad, rad/s, N m].

    settled_after: number of periods of the first multisine until the arm settled; 0 if it never settled, in which case
    the experiment ends there.
    """

    position: Array
    velocity: Array
    torque: Array
    settled_after: int


def commands_of(config: Config, segment: Segment) -> Commands:
    """The torques sent to the servos: goals rounded to ticks, times the assumed torque constants."""
    constant = np.array([joint.torque_per_goal for joint in config.joints])
    tick = np.array(
        [abs(joint.joint.drive_unit(12.0 if joint.joint.mode is Mode.PWM else 0.0)) for joint in config.joints]
    )

    def torque(goals: Array) -> Array:
        return np.ascontiguousarray((np.round(goals / tick) * tick * constant).T)

    return Commands(torque(segment.ramp_in), torque(segment.period_current), torque(segment.ramp_out))


def simulate_experiment(
    plan: Plan, commands: list[Commands], physics: Physics, scale: Array, feedback: Feedback, pose: Array
) -> Motion:
    """Simulate all multisines, starting at rest in `pose` (joints,) [rad].

    As on the bus, the periods of a multisine repeat until one matches the previous one; if an arm has not settled after
    plan.max_settling_periods, the simulation ends there.

    Args:
        plan: the experiment.
        commands: commanded torques of each multisine.
        physics: parameters of the arm.
        scale: ratio of true to assumed torque constants (joints,).
        feedback: the stabiliser, as it acts on this arm.
        pose: initial pose (joints,) [rad].
    """
    arm = _Arm(plan, physics, scale, feedback, pose)
    settled_after = [arm.play_segment(each) for each in commands[:1]]
    for each in commands[1:]:
        if settled_after[-1]:
            settled_after.append(arm.play_segment(each))
    parts = arm.parts
    position, velocity, torque = (
        np.concatenate([getattr(part, name) for part in parts], axis=1) for name in ("position", "velocity", "torque")
    )
    return Motion(position, velocity, torque, settled_after[0])


class _Arm:
    """State of the simulated experiment on one arm; `parts` holds its motion so far."""

    def __init__(self, plan: Plan, physics: Physics, scale: Array, feedback: Feedback, pose: Array) -> None:
        self._plan, self._physics, self._scale, self._feedback = plan, physics, scale[:, None], feedback
        self._state = resting(pose)
        self.parts: list[Response] = []

    def play_segment(self, commands: Commands) -> int:
        """Simulate the ramps and periods of one segment. Returns the number of periods until the arm settled, 0 if it
        never did.
        """
        self._play(commands.ramp_in)
        settled_after = self._settle(commands.period)
        if settled_after:
            for _ in range(1, self._plan.periods):
                self._play(commands.period)
            self._play(commands.ramp_out)
        return settled_after

    def _settle(self, period: Array) -> int:
        former = self._play(period)
        for count in range(1, self._plan.max_settling_periods + 1):
            latest = self._play(period)
            if settling_difference(former, latest) <= self._plan.settle_within:
                return count
            former = latest
        return 0

    def _play(self, command: Array) -> Array:
        """Simulate the arm under these torques (joints, samples) [N m]. Returns positions (joints, samples) [rad]."""
        part = respond(self._physics, self._state, command * self._scale, self._plan.rate, self._feedback)
        self._state = part.state
        self.parts.append(part)
        return part.position
