"""Simulation of a stabilised run for the likelihood, with the arm held to the measured motion by the stabiliser's
springs.

A stabiliser with stiffness k applied the torque k (pose - measured). In closed loop, the simulated arm would receive k
(pose - simulated) instead, which equals the commanded torque plus that of a spring, k (measured - simulated). The
simulation therefore uses the commanded torque and this spring instead of the loop. An arm that is unstable on its own
then stays close to the real one. The damper, which only determines how fast deviations decay, is left out.

The springs pull the simulated joints to where the real ones were. Therefore the measured angles are first corrected for
any encoder errors that the model includes.
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
    """Inputs for simulating a recorded run with its stabiliser."""

    run: SimulatedRun
    """The run without the stabiliser. Its `pulled_to` holds the readings to which the springs pull."""
    stiffness: Array
    """Stiffness of the stabiliser's springs (joints,) [N m/rad]."""

    @classmethod
    def of(cls, period: SettledPeriod, stabiliser: Stabilised, integration: IntegrationOptions) -> "StabilisedRun":
        """Create a run from a settled period in which `stabiliser` applied part of the torque."""
        run = SimulatedRun.of(period, integration)
        # The springs' ends are held between samples, so they are set to where the arm is in mid-interval: an error of
        # half a sample would cause a torque proportional to velocity.
        between = 0.5 * (run.measured + np.roll(run.measured, -1, axis=1))
        between[:, -1] = 1.5 * run.measured[:, -1] - 0.5 * run.measured[:, -2]
        return cls(replace(run, pulled_to=between), stabiliser.feedback.stiffness)

    @property
    def measured(self) -> Array:
        """Measured angles (joints, samples) [rad], with missing ones interpolated."""
        return self.run.measured

    def integrated(self, integration: IntegrationOptions) -> "StabilisedRun":
        """Return this run with the integration steps of `integration`."""
        return replace(self, run=self.run.integrated(integration))

    def position(
        self, physics: Physics, start: Array, tracking_stiffness: Array | None = None, horizon: float = 1.0
    ) -> Array:
        """Return the simulated encoder angles (joints, samples) [rad] without derivatives; see `pieces`."""
        return self.run.position(physics, start, self._stiffest(tracking_stiffness), horizon)

    def pieces(
        self,
        physics: Physics,
        start: Array,
        names: tuple[str, ...],
        tracking_stiffness: Array | None = None,
        horizon: float = 1.0,
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Simulate the run piece by piece, as `SimulatedRun.pieces` does.

        For each joint, the stiffer of the stabiliser's spring and `tracking_stiffness` is used.
        """
        return self.run.pieces(physics, start, names, self._stiffest(tracking_stiffness), horizon)

    def _stiffest(self, tracking_stiffness: Array | None) -> Array:
        return self.stiffness if tracking_stiffness is None else np.maximum(self.stiffness, tracking_stiffness)
