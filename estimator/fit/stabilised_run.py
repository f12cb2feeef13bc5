"""One stabilised run as the likelihood simulates it: held to the measured motion by the stabiliser's own springs.

The stabiliser gave k (pose - measured) for a spring of stiffness k; in closed loop the simulated arm would be given
k (pose - simulated), which is the torque that was commanded and a spring k (measured - simulated) beside it. So the
simulation has that spring instead of the loop: an arm that falls over by itself stays with the real one, derivatives
are those of every other run, and where model and arm agree the spring gives nothing. The stabiliser's damper is left
out: it only says how fast what is left dies away.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.closed_loop import Stabilised


@dataclass(frozen=True)
class StabilisedRun:
    """What a run's simulation takes from its recording."""

    run: SimulatedRun
    """As it would be without the stabiliser; its `pulled_to` are the springs' other ends."""
    stiffness: Array
    """Of the stabiliser's springs (joints,) [N m/rad]."""

    @classmethod
    def of(cls, period: SettledPeriod, stabiliser: Stabilised, integration: IntegrationOptions) -> "StabilisedRun":
        """Of this period, during which `stabiliser` gave part of the torque."""
        run = SimulatedRun.of(period, integration)
        # Held from sample to sample, an end must stand where the arm is in between: half a sample late is a torque in
        # proportion to velocity.
        between = 0.5 * (run.measured + np.roll(run.measured, -1, axis=1))
        between[:, -1] = 1.5 * run.measured[:, -1] - 0.5 * run.measured[:, -2]
        return cls(replace(run, pulled_to=between), stabiliser.feedback.stiffness)

    @property
    def measured(self) -> Array:
        """Angles (joints, samples) [rad], the missing ones interpolated."""
        return self.run.measured

    def integrated(self, integration: IntegrationOptions) -> "StabilisedRun":
        """The same in other steps."""
        return replace(self, run=self.run.integrated(integration))

    def position(self, physics: Physics, start: Array) -> Array:
        """Measured angles (joints, samples) [rad] from the state `start` (2, joints) at the first sample."""
        return np.concatenate([position for _, position, _ in self.pieces(physics, start, ())], axis=1)

    def pieces(
        self,
        physics: Physics,
        start: Array,
        names: tuple[str, ...],
        tracking_stiffness: Array | None = None,
        horizon: float = 1.0,
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Piece after piece, as `SimulatedRun.pieces` gives them; with springs stiffer than the stabiliser's where
        `tracking_stiffness` is."""
        stiffness = self.stiffness if tracking_stiffness is None else np.maximum(self.stiffness, tracking_stiffness)
        return self.run.pieces(physics, start, names, stiffness, horizon)
