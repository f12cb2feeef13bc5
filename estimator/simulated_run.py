"""One recorded run as the likelihood simulates it: piece by piece, so that memory does not grow with derivatives."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array
from estimator.drive import motor_torque, torque_slopes
from estimator.period import SettledPeriod
from estimator.physics import Physics
from estimator.sensitivity import Sensitive
from estimator.simulation import simulate, steps_per_sample

PIECE = 8192  # samples; the derivatives of one piece are a few MiB


@dataclass(frozen=True)
class SimulatedRun:
    """What a run's simulation takes from its recording."""

    command: Array
    """Commanded torque (joints, samples) [N m], periodic."""
    measured: Array
    """Angles (joints, samples) [rad], the missing ones interpolated."""
    rate: float
    command_to_sample: float
    steps: int
    """Integration steps in a sample."""

    @classmethod
    def of(cls, period: SettledPeriod) -> "SimulatedRun":
        """Of this period."""
        steps = steps_per_sample(period.rate)
        return cls(period.torque, period.filled(), period.rate, period.command_to_sample, steps)

    def position(self, physics: Physics, start: Array) -> Array:
        """Angles (joints, samples) [rad] from the state `start` (2, joints) at the first sample."""
        times = {"delay": physics.delay, "lag": physics.lag}
        torque = motor_torque(self.command, self.rate, self.command_to_sample, self.steps, **times)
        return simulate(physics, start, torque, 1.0 / (self.rate * self.steps))[0]

    def pieces(
        self, physics: Physics, start: Array, names: tuple[str, ...], share: float = 1.0
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Piece after piece: which samples, their angles (joints, samples) [rad], and the derivatives of these
        (joints, samples, causes) by the parameters `names` and then by the state at the first sample. Ends after
        `share` of the samples."""
        joints, samples = self.command.shape
        state = tuple(f"{what}_{joint + 1}" for what in ("position", "velocity") for joint in range(joints))
        motion = Sensitive(physics, start, (*names, *state), 1.0 / (self.rate * self.steps))
        times = {"delay": physics.delay, "lag": physics.lag}
        torque = motor_torque(self.command, self.rate, self.command_to_sample, self.steps, **times)
        slopes = torque_slopes(self.command, self.rate, self.command_to_sample, self.steps, **times)
        samples = round(share * samples)
        for first in range(0, samples, PIECE):
            part = slice(first, min(first + PIECE, samples))
            yield part, *motion.advance(np.ascontiguousarray(torque[:, part]), slopes[:, :, part])
