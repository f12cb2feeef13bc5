"""One stabilised run as the likelihood simulates it: in closed loop, its derivatives by finite differences."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.models.parameters import CONSTANTS, Physics
from hil.estimator.options import IntegrationOptions
from hil.estimator.simulation.closed_loop import Stabilised

RTOL, ATOL = 1e-5, 1e-7
"""A difference is taken over this much of a parameter's value, and this much of its unit."""


@dataclass(frozen=True)
class StabilisedRun:
    """What a run's simulation in closed loop takes from its recording."""

    stabiliser: Stabilised
    measured: Array
    """Angles (joints, samples) [rad], the missing ones interpolated."""
    rate: float
    command_to_sample: float

    @classmethod
    def of(cls, period: SettledPeriod, stabiliser: Stabilised) -> "StabilisedRun":
        """Of this period, during which `stabiliser` gave part of the torque."""
        return cls(stabiliser, period.filled(), period.rate, period.command_to_sample)

    def integrated(self, _: IntegrationOptions) -> "StabilisedRun":
        """Itself: it has one step only."""
        return self

    def position(self, physics: Physics, start: Array) -> Array:
        """Angles (joints, samples) [rad] from the state `start` (2, joints) at the first sample."""
        return self.stabiliser.positions(physics, start, self.rate, self.command_to_sample)

    def pieces(
        self,
        physics: Physics,
        start: Array,
        names: tuple[str, ...],
        _tracking_stiffness: Array | None = None,
        horizon: float = 1.0,
    ) -> Iterator[tuple[slice, Array, Array]]:
        """The whole run, or the share `horizon` from its beginning, as one piece, as `SimulatedRun.pieces` gives them.

        Its stabiliser keeps it near the measured motion: it needs no springs.
        """
        position = self.position(physics, start)
        derivatives = []
        for name in names:
            step = ATOL + RTOL * abs(_value(physics, name))
            derivatives.append((self.position(_nudged(physics, name, step), start) - position) / step)
        for index in np.ndindex(*start.shape):
            nudged = start.copy()
            nudged[index] += ATOL
            derivatives.append((self.position(physics, nudged) - position) / ATOL)
        count = round(horizon * self.measured.shape[1])
        yield slice(0, count), position[:, :count], np.stack(derivatives, axis=-1)[:, :count]


def _value(physics: Physics, name: str) -> float:
    return float(physics.vector[CONSTANTS.index(name)]) if name in CONSTANTS else float(getattr(physics, name))


def _nudged(physics: Physics, name: str, step: float) -> Physics:
    if name == "delay":
        return replace(physics, delay=physics.delay + step)
    if name == "lag":
        return replace(physics, lag=physics.lag + step)
    vector = physics.vector.copy()
    vector[CONSTANTS.index(name)] += step
    return replace(physics, vector=vector)
