"""Simulation of one recorded run for the likelihood, piece by piece, so that memory use is bounded."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.models.parameters import Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.back_emf import by_names, causes_of
from hil.estimator.simulation.drive import motor_torque, torque_and_slopes
from hil.estimator.simulation.encoder import (
    by_motion,
    measured,
    measured_and_slopes,
    slopes_without_errors,
    without_errors,
)
from hil.estimator.simulation.presliding_sensitivity import sensitive

PIECE = 8192  # samples; the derivatives of one piece are a few MiB


@dataclass(frozen=True)
class SimulatedRun:
    """Inputs for simulating a recorded run."""

    command: Array
    """Commanded torque (joints, samples) [N m], periodic."""
    measured: Array
    """Measured angles (joints, samples) [rad], with missing ones interpolated."""
    rate: float
    command_to_sample: float
    steps: int
    """Integration steps per sample."""
    max_substeps: int
    """Maximum number of substeps into which a step is divided near standstill."""
    pulled_to: Array | None = None
    """Encoder readings to which the springs pull the arm, held constant between samples (joints, samples) [rad].

    The default is `measured`, without correction for encoder errors.
    """

    @classmethod
    def of(cls, period: SettledPeriod, integration: IntegrationOptions) -> "SimulatedRun":
        """Create a run from a settled period."""
        steps = steps_per_sample(period.rate, integration.max_step)
        samples = (period.torque, period.filled(), period.rate, period.command_to_sample)
        return cls(*samples, steps, integration.max_substeps)

    def integrated(self, integration: IntegrationOptions) -> "SimulatedRun":
        """Return this run with the integration steps of `integration`."""
        steps = steps_per_sample(self.rate, integration.max_step)
        return replace(self, steps=steps, max_substeps=integration.max_substeps)

    def position(
        self, physics: Physics, start: Array, tracking_stiffness: Array | None = None, horizon: float = 1.0
    ) -> Array:
        """Return the simulated encoder angles (joints, samples) [rad] without derivatives; see `pieces`."""
        samples = round(horizon * self.command.shape[1])
        of = self.command, self.rate, self.command_to_sample, self.steps
        torque = motor_torque(*of, delay=physics.delays, lag=physics.lags)[:, :samples]
        springs = None
        if tracking_stiffness is not None:
            springs = tracking_stiffness, self._spring_ends(physics)[:, :samples]
        step = 1.0 / (self.rate * self.steps)
        return measured(physics, simulate(physics, start, torque, step, self.max_substeps, springs)[0])

    def pieces(
        self,
        physics: Physics,
        start: Array,
        names: tuple[str, ...],
        tracking_stiffness: Array | None = None,
        horizon: float = 1.0,
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Simulate the run piece by piece, with derivatives.

        Yields the samples of each piece, their angles (joints, samples) [rad], and the derivatives (joints, samples,
        causes) of these angles with respect to `names` and then the initial state.

        Args:
            physics: physical constants.
            start: state at the first sample (2, joints) [rad, rad/s].
            names: parameters with respect to which to differentiate.
            tracking_stiffness: stiffness of springs that pull the simulated arm to the measured angles (joints,) [N
                m/rad].
            horizon: fraction of the samples to simulate.
        """
        joints, samples = self.command.shape
        state = tuple(f"{what}_{joint + 1}" for what in ("position", "velocity") for joint in range(joints))
        ends, slopes_of_ends, moving = self._spring_ends(physics), None, by_motion(names)
        if self.pulled_to is not None and tracking_stiffness is not None:
            slopes_of_ends, moving = slopes_without_errors(physics, ends), names
        causes = (*causes_of(physics, moving), *state)
        step = 1.0 / (self.rate * self.steps)
        motion = sensitive(physics)(physics, start, causes, step, self.max_substeps, tracking_stiffness)
        of = self.command, self.rate, self.command_to_sample, self.steps
        torque, slopes = torque_and_slopes(*of, delay=physics.delays, lag=physics.lags)
        samples = round(horizon * samples)
        for first in range(0, samples, PIECE):
            part = slice(first, min(first + PIECE, samples))
            pulled = ends[:, part], None if slopes_of_ends is None else slopes_of_ends[:, part]
            true, slope = motion.advance(np.ascontiguousarray(torque[:, part]), slopes[:, :, part], *pulled)
            yield part, *measured_and_slopes(physics, names, moving, true, by_names(physics, moving, slope))

    def _spring_ends(self, physics: Physics) -> Array:
        """Return the angles to which springs pull the arm (joints, samples) [rad]."""
        return self.measured if self.pulled_to is None else without_errors(physics, self.pulled_to)
