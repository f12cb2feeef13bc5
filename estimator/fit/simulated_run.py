"""One recorded run as the likelihood simulates it: piece by piece, so that memory does not grow with derivatives."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.arm import MOST_PIECES, simulate, steps_per_sample
from hil.estimator.simulation.drive import motor_torque, torque_and_slopes
from hil.estimator.simulation.presliding_sensitivity import sensitive

ROUGH_STEP, ROUGH_PIECES = 2.6e-3, 16  # s
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
    most_pieces: int = MOST_PIECES
    """Into which a step is cut near standstill."""
    pulled_to: Array | None = None
    """Where springs end that draw the arm, held from sample to sample (joints, samples) [rad]; `measured` unless given.
    """

    @classmethod
    def of(cls, period: SettledPeriod) -> "SimulatedRun":
        """Of this period."""
        steps = steps_per_sample(period.rate)
        return cls(period.torque, period.filled(), period.rate, period.command_to_sample, steps)

    def roughly(self) -> "SimulatedRun":
        """The same in long steps, off by a few hundredths of an encoder's step, for a third of the time."""
        return replace(self, steps=steps_per_sample(self.rate, ROUGH_STEP), most_pieces=ROUGH_PIECES)

    def position(self, physics: Physics, start: Array) -> Array:
        """Angles (joints, samples) [rad] from the state `start` (2, joints) at the first sample."""
        times = {"delay": physics.delay, "lag": physics.lag}
        torque = motor_torque(self.command, self.rate, self.command_to_sample, self.steps, **times)
        return simulate(physics, start, torque, 1.0 / (self.rate * self.steps))[0]

    def pieces(
        self, physics: Physics, start: Array, names: tuple[str, ...], pull: Array | None = None, share: float = 1.0
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Piece after piece: which samples, their angles (joints, samples) [rad], and the derivatives of these
        (joints, samples, causes) by the parameters `names` and then by the state at the first sample. Springs of
        stiffness `pull` (joints,) [N m/rad] draw the simulated arm to the measured angles. Ends after `share` of the
        samples."""
        joints, samples = self.command.shape
        state = tuple(f"{what}_{joint + 1}" for what in ("position", "velocity") for joint in range(joints))
        motion = sensitive(physics)(
            physics, start, (*names, *state), 1.0 / (self.rate * self.steps), self.most_pieces, pull
        )
        times = {"delay": physics.delay, "lag": physics.lag}
        torque, slopes = torque_and_slopes(self.command, self.rate, self.command_to_sample, self.steps, **times)
        samples = round(share * samples)
        ends = self.measured if self.pulled_to is None else self.pulled_to
        for first in range(0, samples, PIECE):
            part = slice(first, min(first + PIECE, samples))
            yield (
                part,
                *motion.advance(np.ascontiguousarray(torque[:, part]), slopes[:, :, part], ends[:, part]),
            )
