"""Simulation of many arms under the same commands in one call of compiled code, for dry runs.

Equations, integration and feedback are those of `hil.estimator.simulation.closed_loop` with longer steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, embedded
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.arm import finer_pieces, steps_per_sample
from hil.estimator.simulation.bristles import has_bristles, without_dry_friction
from hil.estimator.simulation.closed_loop import Feedback, respond_compiled

COARSE = IntegrationOptions(max_step=2.6e-3, max_substeps=4)
"""Integration for peaks and overshoots: accurate to a few milliradians, and ten times as fast as the default."""
LOWEST, HIGHEST, VELOCITY, TORQUE, POWER = range(5)
"""Rows of the peak values."""


@dataclass(frozen=True)
class Commands:
    """Commanded torques of one multisine, without feedback (joints, samples) [N m]."""

    ramp_in: Array
    period: Array
    ramp_out: Array


@dataclass(frozen=True)
class SettlingRule:
    """Rule for the number of periods to simulate.

    within: two successive periods that differ by at most this fraction of the motion's RMS count as settled.
    most_periods: maximum number of periods, after the first, in which the motion may settle.
    periods: total number of settled periods that are then simulated.
    """

    within: float
    most_periods: int
    periods: int


@dataclass(frozen=True)
class ManyArms:
    """Several arms and their feedback.

    scale: ratio of true to assumed torque of each command (arms, joints).
    pose: initial pose of each arm, at rest (arms, joints) [rad].
    feedback: feedback in terms of assumed torques.
    """

    physics: Sequence[Physics]
    scale: Array
    pose: Array
    feedback: Feedback

    @property
    def joints(self) -> int:
        return int(self.scale.shape[1])

    def part(self, first: int, last: int) -> "ManyArms":
        """Return the arms with indices from `first` to `last` - 1."""
        return ManyArms(self.physics[first:last], self.scale[first:last], self.pose[first:last], self.feedback)

    def peaks(
        self, multisines: Sequence[Commands], rate: float, settling: SettlingRule
    ) -> tuple[Array, npt.NDArray[np.int64]]:
        """Return each arm's extreme values, and when it settled.

        The values (arms, 5, joints) are lowest and highest angle [rad], speed [rad/s], assumed torque [N m], and
        assumed torque times speed [W]. The second array (arms,) is the number of periods of the first multisine that
        the arm took to settle. It is 0 if the arm never settled; the experiment with this arm then ends.
        """
        count = len(self.physics)
        values, settled = np.empty((count, 5, 2)), np.zeros(count, dtype=np.int64)
        ramps_in, periods, ramps_out = (
            np.stack([_two(getattr(each, part)) for each in multisines]) for part in ("ramp_in", "period", "ramp_out")
        )
        _peaks(
            *self._arguments(rate),
            *(ramps_in, periods, ramps_out, settling.within, settling.most_periods, settling.periods, values, settled),
        )
        return values[:, :, : self.joints], settled

    def positions(self, command: Array, rate: float, every: int = 1) -> Array:
        """Return the angles (arms, joints, kept) [rad] at every `every`-th sample; command: (joints, samples) [N m]."""
        both = _two(command)
        kept = np.empty((len(self.physics), 2, -(-both.shape[1] // every)))
        _positions(*self._arguments(rate), both, every, kept)
        return kept[:, : self.joints]

    def _arguments(self, rate: float) -> tuple[Any, ...]:
        count, joints = self.scale.shape
        steps = steps_per_sample(rate, COARSE.max_step)
        step = 1.0 / (rate * steps)
        feedback = self.feedback
        gains, scale, pose = np.zeros((4, 2)), np.ones((count, 2)), np.zeros((count, 2))
        gains[:, :joints] = feedback.stiffness, feedback.damping, feedback.pose, feedback.limit
        scale[:, :joints], pose[:, :joints] = self.scale, self.pose
        return (
            np.stack([each.vector for each in self.physics]),
            np.array([has_bristles(each) for each in self.physics]),
            np.stack([without_dry_friction(each.vector) for each in self.physics]),
            np.stack([each.late for each in self.physics]),
            np.array([finer_pieces(each, step, COARSE.max_substeps) for each in self.physics]),
            *(scale, pose, gains, step, steps),
        )


def _two(torque: Array) -> Array:
    """Extend torques to two joints: a one-joint arm gets a second joint that has neither torque nor effect."""
    both = np.zeros((2, torque.shape[1]))
    both[: len(torque)] = torque
    return both


# Compiled code takes its arguments by position.
@embedded
def _resting(pose: Any) -> Any:
    state = np.zeros((6, 2))
    for joint in range(2):
        state[0, joint] = state[3, joint] = pose[joint]
    return state


@embedded
def _felt(gains: Any, scale: Any) -> Any:
    """Return the feedback as applied to an arm whose torques are `scale` times the assumed ones."""
    felt = gains.copy()
    for joint in range(2):
        for row in (0, 1, 3):
            felt[row, joint] = gains[row, joint] * scale[joint]
    return felt


@embedded
def _scaled(command: Any, scale: Any) -> Any:
    scaled = command.copy()
    for joint in range(2):
        for k in range(command.shape[1]):
            scaled[joint, k] = command[joint, k] * scale[joint]
    return scaled


@embedded
def _raise(values: Any, position: Any, velocity: Any, torque: Any, scale: Any) -> None:
    for joint in range(2):
        for k in range(position.shape[1]):
            q, v, t = position[joint, k], abs(velocity[joint, k]), abs(torque[joint, k]) / scale[joint]
            # A motion that is not finite has exceeded every limit.
            if not (abs(q) < 1e6 and v < 1e6):
                values[0, joint], values[1, joint], values[2, joint] = -1e6, 1e6, 1e6
                return
            values[0, joint] = min(values[0, joint], q)
            values[1, joint] = max(values[1, joint], q)
            values[2, joint] = max(values[2, joint], v)
            values[3, joint] = max(values[3, joint], t)
            values[4, joint] = max(values[4, joint], t * v)


@embedded
def _difference(former: Any, latest: Any) -> float:
    """Return the worst joint's RMS difference between two periods' second halves, relative to the motion's RMS."""
    samples = former.shape[1]
    half = samples // 2
    count = samples - half
    worst = 0.0
    for joint in range(2):
        mean = 0.0
        for k in range(half, samples):
            mean += latest[joint, k] / count
        away = moved = 0.0
        for k in range(half, samples):
            away += (latest[joint, k] - former[joint, k]) ** 2
            moved += (latest[joint, k] - mean) ** 2
        if away > 0.0:
            worst = max(worst, (away / moved) ** 0.5 if moved > 0.0 else np.inf)
    return worst


def _peaks_loop(
    p: Any,
    bristly: Any,
    m: Any,
    lag: Any,
    pieces: Any,
    scale: Any,
    pose: Any,
    gains: Any,
    step: float,
    steps: int,
    ramp_in: Any,
    period: Any,
    ramp_out: Any,
    within: float,
    most: int,
    periods: int,
    values: Any,
    settled: Any,
) -> None:
    former = np.empty((2, period.shape[2]))
    position, velocity, torque = np.empty_like(former), np.empty_like(former), np.empty_like(former)
    ramped = np.empty((2, ramp_in.shape[2]))
    ramped_velocity, ramped_torque = np.empty_like(ramped), np.empty_like(ramped)
    perfect = np.zeros((2, 4))  # encoders without errors
    for arm in range(p.shape[0]):
        state, felt = _resting(pose[arm]), _felt(gains, scale[arm])
        for joint in range(2):
            values[arm, :, joint] = 0.0
            values[arm, 0, joint] = values[arm, 1, joint] = pose[arm, joint]
        for segment in range(period.shape[0]):
            command = _scaled(period[segment], scale[arm])
            faded = _scaled(ramp_in[segment], scale[arm])
            respond_compiled(
                p[arm], bristly[arm], m[arm], state, faded, felt, perfect, lag[arm], step, steps, pieces[arm],
                ramped, ramped_velocity, ramped_torque,
            )  # fmt: skip
            _raise(values[arm], ramped, ramped_velocity, ramped_torque, scale[arm])
            found, left = 0, 1 + most
            played = 0
            while left > 0:
                respond_compiled(
                    p[arm], bristly[arm], m[arm], state, command, felt, perfect, lag[arm], step, steps, pieces[arm],
                    position, velocity, torque,
                )  # fmt: skip
                _raise(values[arm], position, velocity, torque, scale[arm])
                left -= 1
                if not found and played and _difference(former, position) <= within:
                    found = played
                    left = periods - 1
                played += 1
                for joint in range(2):  # assigning a slice takes 2 s to compile
                    for k in range(position.shape[1]):
                        former[joint, k] = position[joint, k]
            if segment == 0:
                settled[arm] = found
            if not found:
                break
            faded = _scaled(ramp_out[segment], scale[arm])
            respond_compiled(
                p[arm], bristly[arm], m[arm], state, faded, felt, perfect, lag[arm], step, steps, pieces[arm],
                ramped, ramped_velocity, ramped_torque,
            )  # fmt: skip
            _raise(values[arm], ramped, ramped_velocity, ramped_torque, scale[arm])


def _positions_loop(
    p: Any,
    bristly: Any,
    m: Any,
    lag: Any,
    pieces: Any,
    scale: Any,
    pose: Any,
    gains: Any,
    step: float,
    steps: int,
    command: Any,
    every: int,
    kept: Any,
) -> None:
    position = np.empty_like(command)
    velocity, torque = np.empty_like(command), np.empty_like(command)
    for arm in range(p.shape[0]):
        respond_compiled(
            p[arm], bristly[arm], m[arm], _resting(pose[arm]), _scaled(command, scale[arm]), _felt(gains, scale[arm]),
            np.zeros((2, 4)), lag[arm], step, steps, pieces[arm], position, velocity, torque,
        )  # fmt: skip
        for k in range(kept.shape[2]):
            kept[arm, 0, k] = position[0, k * every]
            kept[arm, 1, k] = position[1, k * every]


_peaks: Callable[..., None] = compiled(_peaks_loop)
_positions: Callable[..., None] = compiled(_positions_loop)
