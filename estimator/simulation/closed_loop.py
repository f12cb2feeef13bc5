"""The arm's motion under commands that depend on its state: those of a software spring and damper, or of a brake.

The equations, including the torque scale, and the default integration step are those of `hil.estimator.simulation.arm`.
A command is computed once per sample from the state at the previous sample, as on the real bus, then limited and held;
the motor follows it with a first-order lag. A pure delay of the drive is added to that lag.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.arm import INTEGRATION, finer_pieces, pieces_now, step_bent, steps_per_sample
from hil.estimator.simulation.bristles import first_bend, has_bristles, without_dry_friction
from hil.estimator.simulation.encoder import measured

SETTLING_PERIODS = 4


@dataclass(frozen=True)
class Feedback:
    """Feedback: torque = command + stiffness (pose - position) - damping velocity, within +-limit.

    It uses the state at the previous sample. All arrays are (joints,) [N m/rad, N m s/rad, rad, N m].
    """

    stiffness: Array
    damping: Array
    pose: Array
    limit: Array

    @classmethod
    def none(cls, joints: int) -> "Feedback":
        """Return feedback that leaves commands unchanged."""
        nothing = np.zeros(joints)
        return cls(nothing, nothing, nothing, np.full(joints, np.inf))


@dataclass(frozen=True)
class Response:
    """A simulated motion."""

    position: Array
    """Angles at the samples (joints, samples) [rad]."""
    velocity: Array
    """Velocities at the samples (joints, samples) [rad/s]."""
    torque: Array
    """Commanded torque including feedback (joints, samples) [N m]."""
    state: Array
    """State after the last sample (6, joints), from which `respond` can continue.

    The rows are: angles [rad] and velocities [rad/s] after the last sample; motor torques [N m]; angles [rad] and
    velocities [rad/s] at the last sample; torques of the bristles [N m].
    """


@dataclass(frozen=True)
class Stabilised:
    """A period in which `feedback` applied part of the torque.

    The feedback acts on the simulated arm, so an arm that is unstable on its own can be simulated. If model and arm
    agree, the torque equals the one actually commanded.
    """

    feedback: Feedback
    excitation: Array
    """Commanded torque minus the feedback's contribution (joints, samples) [N m]."""
    former: Array
    """Angles and velocities at the sample before the first (2, joints) [rad, rad/s]."""
    former_torque: Array
    """Torque commanded before the first command (joints,) [N m]."""

    def positions(self, physics: Physics, start: Array, rate: float, command_to_sample: float) -> Array:
        """Return the simulated angles (joints, samples) [rad] from the initial state `start` (2, joints)."""
        state = np.concatenate((start, self.former_torque[None], self.former))
        return respond(_earlier(physics, command_to_sample), state, self.excitation, rate, self.feedback).position

    def continued(self, physics: Physics, state: Array, rate: float, command_to_sample: float) -> tuple[Array, Array]:
        """Return the simulated angles (joints, samples) [rad] from `state` on, and the state after them; see
        `Response.state`.
        """
        response = respond(_earlier(physics, command_to_sample), state, self.excitation, rate, self.feedback)
        return response.position, response.state

    def settled_positions(self, physics: Physics, pose: Array, rate: float, command_to_sample: float) -> Array:
        """Return the encoder readings (joints, samples) [rad] predicted without measurements, from rest in `pose`.

        The last of SETTLING_PERIODS simulated periods is returned.
        """
        state = resting(pose)
        for _ in range(SETTLING_PERIODS):
            response = respond(_earlier(physics, command_to_sample), state, self.excitation, rate, self.feedback)
            state = response.state
        return measured(physics, response.position)


def _earlier(physics: Physics, command_to_sample: float) -> Physics:
    """Lump the delay into the lag, less the time `command_to_sample` [s] by which commands act before their samples."""
    return replace(physics, lag=max(physics.lag + physics.delay - command_to_sample, 1e-5), delay=0.0)


def resting(pose: Array) -> Array:
    """Return the state of an arm at rest in `pose` (joints,) [rad], as `respond` expects it."""
    nothing = np.zeros_like(pose)
    return np.stack((pose, nothing, nothing, pose, nothing, nothing))


def respond(
    physics: Physics,
    state: Array,
    command: Array,
    rate: float,
    feedback: Feedback,
    integration: IntegrationOptions = INTEGRATION,
) -> Response:
    """Simulate the samples of `command` (joints, samples) [N m] at `rate` [1/s] from `state`.

    `state` is as in `Response.state`. Its last row may be omitted; the bristles then start with their deflection in
    steady sliding.
    """
    return Simulator.of(physics, rate, integration).respond(state, command, feedback)


@dataclass(frozen=True)
class Simulator:
    """An arm at one sampling rate; quantities common to all its motions are computed only once."""

    physics: Physics
    bristly: bool
    moving: Array
    """Constants, with dry friction set to zero where bristles model it."""
    late: Array
    step: float
    """Integration step [s]."""
    steps: int
    """Integration steps per sample."""
    pieces: npt.NDArray[np.int64]

    @classmethod
    def of(cls, physics: Physics, rate: float, integration: IntegrationOptions = INTEGRATION) -> "Simulator":
        """Return the simulator of an arm for commands at `rate` [1/s]."""
        steps = steps_per_sample(rate, integration.max_step)
        step = 1.0 / (rate * steps)
        pieces = finer_pieces(physics, step, integration.max_substeps)
        moving = without_dry_friction(physics.vector)
        return cls(physics, has_bristles(physics), moving, physics.late, step, steps, pieces)

    def respond(self, state: Array, command: Array, feedback: Feedback) -> Response:
        """Simulate the samples of `command` (joints, samples) [N m] from `state`, as `respond` does."""
        joints, samples = command.shape
        gains = np.zeros((4, 2))
        gains[:, :joints] = feedback.stiffness, feedback.damping, feedback.pose, feedback.limit
        # A one-joint arm is simulated as a two-joint arm whose second joint has no torque and moves nothing.
        both = command
        if joints == 1 or not command.flags.c_contiguous:
            both = np.zeros((2, samples))
            both[:joints] = command
        full = np.zeros((6, 2))
        full[: len(state), :joints] = state
        if len(state) < len(full):
            full[5, :joints] = first_bend(self.physics, state[1])
        position, velocity, torque = np.empty((3, 2, samples))
        respond_compiled(
            *(self.physics.vector, self.bristly, self.moving, full, both, gains, self.physics.encoder),
            *(self.late, self.step, self.steps, self.pieces, position, velocity, torque),
        )
        return Response(position[:joints], velocity[:joints], torque[:joints], full[:, :joints])


# Compiled code takes its arguments by position.
def _loop(
    p: Any,
    bristly: bool,
    m: Any,
    state: Any,
    command: Any,
    gains: Any,
    e: Any,
    lag: Any,
    step: float,
    steps: int,
    pieces: Any,
    position: Any,
    velocity: Any,
    torque: Any,
) -> None:
    q1, q2, v1, v2 = state[0, 0], state[0, 1], state[1, 0], state[1, 1]
    t1, t2 = state[2, 0], state[2, 1]
    s1, s2, w1, w2 = state[3, 0], state[3, 1], state[4, 0], state[4, 1]
    b = state[5]
    a1 = a2 = 0.0
    finest = max(pieces[0], pieces[1])
    piece = step / finest
    fallen1 = 1.0 - math.exp(-step / lag[0]) if lag[0] > 0.0 else 1.0
    fallen2 = 1.0 - math.exp(-step / lag[1]) if lag[1] > 0.0 else 1.0
    share1, share2 = fallen1 * lag[0] / step, fallen2 * lag[1] / step
    uneven = np.any(e != 0.0)  # saves eight sines per sample if the encoders are perfect
    for k in range(command.shape[1]):
        c1 = command[0, k] + gains[0, 0] * (gains[2, 0] - s1) - gains[1, 0] * w1
        c2 = command[1, k] + gains[0, 1] * (gains[2, 1] - s2) - gains[1, 1] * w2
        c1 = min(max(c1, -gains[3, 0]), gains[3, 0])
        c2 = min(max(c2, -gains[3, 1]), gains[3, 1])
        # The feedback uses the encoder readings.
        s1, s2 = q1, q2
        if uneven:
            s1 += e[0, 0] * math.sin(q1) + e[0, 1] * math.cos(q1)
            s1 += e[0, 2] * math.sin(2.0 * q1) + e[0, 3] * math.cos(2.0 * q1)
            s2 += e[1, 0] * math.sin(q2) + e[1, 1] * math.cos(q2)
            s2 += e[1, 2] * math.sin(2.0 * q2) + e[1, 3] * math.cos(2.0 * q2)
        w1, w2 = v1, v2
        position[0, k] = q1
        position[1, k] = q2
        velocity[0, k] = v1
        velocity[1, k] = v2
        torque[0, k] = c1
        torque[1, k] = c2
        for _ in range(steps):
            # Exact mean of the motor's torque over the step, under a constant command.
            m1 = c1 + (t1 - c1) * share1
            m2 = c2 + (t2 - c2) * share2
            t1 += (c1 - t1) * fallen1
            t2 += (c2 - t2) * fallen2
            left = finest
            while left > 0:
                n = pieces_now(p, v1, v2, a1, a2, piece, pieces, left, False)
                q1, q2, v1, v2, a1, a2 = step_bent(p, bristly, m, b, q1, q2, v1, v2, a1, a2, m1, m2, n * piece)
                left -= n
    state[0, 0], state[0, 1], state[1, 0], state[1, 1] = q1, q2, v1, v2
    state[2, 0], state[2, 1] = t1, t2
    state[3, 0], state[3, 1], state[4, 0], state[4, 1] = s1, s2, w1, w2


respond_compiled: Callable[..., None] = compiled(_loop)
