"""What will be played: the multisines of an experiment as goal currents, sample by sample, ramps included."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.excitation import Multisine, design_multisine, zippered_lines
from hil.config import Config

IDENTIFY, HELD_OUT = "identify", "held_out"
ROLES = (IDENTIFY, HELD_OUT)


@dataclass(frozen=True)
class Segment:
    """One multisine and what it is for. `period_current`: goal currents of one period, (samples, joints) [A]."""

    role: str
    multisine: Multisine
    period_current: NDArray[np.float64]
    ramp_samples: int

    @property
    def ramp_in(self) -> NDArray[np.float64]:
        """Goal currents before the first period: its end, faded in, so that the period itself starts whole."""
        count = self.ramp_samples
        fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
        return self._before(count) * fade[:, None]

    @property
    def ramp_out(self) -> NDArray[np.float64]:
        """Goal currents after the last period: its beginning, faded out."""
        count = self.ramp_samples
        fade = 0.5 + 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
        index = np.arange(count) % len(self.period_current)
        return self.period_current[index] * fade[:, None]

    def _before(self, count: int) -> NDArray[np.float64]:
        index = np.arange(-count, 0) % len(self.period_current)
        return self.period_current[index]


@dataclass(frozen=True)
class Plan:
    """Everything that the stream will play, in order."""

    rate: float
    segments: tuple[Segment, ...]
    rest_samples: int
    end_samples: int
    max_settling_periods: int
    periods: int
    settle_within: float

    @property
    def capacity(self) -> int:
        """The largest number of samples that playing can take."""
        longest = self.max_settling_periods + self.periods
        played = sum(longest * len(s.period_current) + 2 * s.ramp_samples for s in self.segments)
        return self.rest_samples + played + self.end_samples

    @property
    def expected(self) -> int:
        """The number of samples when the second period is settled, as on most arms."""
        played = sum((1 + self.periods) * len(s.period_current) + 2 * s.ramp_samples for s in self.segments)
        return self.rest_samples + played


def make_plan(config: Config) -> Plan:
    """Design the excitation of a configuration; the same seed gives the same plan."""
    experiment = config.experiment
    roles = ROLES if experiment.held_out else (IDENTIFY,)
    return Plan(
        rate=experiment.rate,
        segments=tuple(_segment(config, role, experiment.seed + offset) for offset, role in enumerate(roles)),
        rest_samples=max(1, round(experiment.rest * experiment.rate)),
        end_samples=max(1, round(config.safety.rest_time * experiment.rate)),
        max_settling_periods=experiment.max_settling_periods,
        periods=experiment.periods,
        settle_within=experiment.settle_within,
    )


def _lines(config: Config) -> Sequence[Sequence[int]]:
    """The harmonics of each joint; the configuration has either a band or the lines themselves."""
    experiment = config.experiment
    if experiment.band is None:
        return experiment.lines or []
    low, high = experiment.band
    return zippered_lines(experiment.period, (low, high), len(config.joints))


def _segment(config: Config, role: str, seed: int) -> Segment:
    experiment = config.experiment
    multisine = design_multisine(experiment.rate, experiment.period, _lines(config), experiment.peak_torque, seed)
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    limits = np.array([joint.goal_limit for joint in config.joints])
    current = np.clip(multisine.torque.T / constants, -limits, limits)
    return Segment(role, multisine, current, round(experiment.ramp * experiment.rate))
