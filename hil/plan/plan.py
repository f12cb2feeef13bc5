"""The excitation plan: the multisines of an experiment as goal currents, sample by sample, including ramps."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.config.schema import Config
from hil.drivers.preparation.cadence import exchange_interval
from hil.errors import ConfigError
from hil.estimator.arrays import Array
from hil.estimator.excitation.multisine import Multisine, design_multisine, detecting_lines, zippered_lines
from hil.plan.find_torque import how_to_find_torque
from hil.plan.stabiliser import check_rate

IDENTIFY, HELD_OUT = "identify", "held_out"
ROLES = (IDENTIFY, HELD_OUT)


@dataclass(frozen=True)
class Segment:
    """One multisine and its role. period_current: goal currents of one period (samples, joints) [A]."""

    role: str
    multisine: Multisine
    period_current: Array
    ramp_samples: int

    @property
    def ramp_in(self) -> Array:
        """Goal currents before the first period (samples, joints) [A]: the end of a period, faded in, so that the first
        period starts at full amplitude.
        """
        count = self.ramp_samples
        fade = 0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
        return self._before(count) * fade[:, None]

    @property
    def ramp_out(self) -> Array:
        """Goal currents after the last period (samples, joints) [A]: the beginning of a period, faded out."""
        count = self.ramp_samples
        fade = 0.5 + 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / max(count, 1))
        index = np.arange(count) % len(self.period_current)
        return self.period_current[index] * fade[:, None]

    @property
    def peak_torque(self) -> Array:
        """Largest commanded torque (joints,) [N m]."""
        peaks: Array = np.abs(self.multisine.torque).max(axis=1)
        return peaks

    @property
    def peak_goal(self) -> Array:
        """Largest goal that is expected to be commanded (joints,) [A, or V in PWM mode]; NaN counts as zero."""
        peaks: Array = np.nan_to_num(np.abs(self.period_current)).max(axis=0)
        return peaks

    def _before(self, count: int) -> Array:
        index = np.arange(-count, 0) % len(self.period_current)
        return self.period_current[index]


@dataclass(frozen=True)
class Plan:
    """Everything that the stream commands, in order."""

    rate: float
    segments: tuple[Segment, ...]
    rest_samples: int
    end_samples: int
    brake_samples: int
    """Maximum number of exchanges for which the joints are braked when the arm is stopped."""
    max_settling_periods: int
    periods: int
    settle_within: float
    drift_within: float
    warm_up_periods: int = 0
    """Number of warm-up periods of the first multisine, played before the periods that may be used."""
    lower_samples: int = 0
    """Maximum number of samples for lowering a spatial arm that has been stopped."""

    def first_segment(self) -> "Plan":
        return replace(self, segments=self.segments[:1])

    @property
    def capacity(self) -> int:
        """Maximum number of samples that carrying out the plan may take."""
        longest = self.max_settling_periods + self.periods
        played = sum(longest * len(s.period_current) + 2 * s.ramp_samples for s in self.segments)
        still = self.rest_samples + 3 * self.end_samples
        return still + self.warm_up_samples + played + self.brake_samples + self.lower_samples

    @property
    def warm_up_samples(self) -> int:
        return self.warm_up_periods * len(self.segments[0].period_current)

    @property
    def expected(self) -> int:
        """Number of samples if the motion has settled by the second period, as it does on most arms."""
        played = sum((1 + self.periods) * len(s.period_current) + 2 * s.ramp_samples for s in self.segments)
        return self.rest_samples + self.warm_up_samples + played


def scaled(config: Config, plan: Plan, peak_torque: Array) -> Plan:
    """The same plan with its multisines scaled to other peak torques (joints,) [N m]."""
    return replace(plan, segments=tuple(_scaled_segment(config, segment, peak_torque) for segment in plan.segments))


def _scaled_segment(config: Config, segment: Segment, peak_torque: Array) -> Segment:
    wave = segment.multisine
    factor = peak_torque / np.abs(wave.torque).max(axis=1)
    amplitudes = tuple(tuple(float(f * a) for a in each) for f, each in zip(factor, wave.amplitudes, strict=True))
    multisine = replace(wave, amplitudes=amplitudes, torque=wave.torque * factor[:, None])
    return Segment(segment.role, multisine, period_current(config, multisine), segment.ramp_samples)


def period_current(config: Config, multisine: Multisine) -> Array:
    """One period of goal currents (samples, joints) [A], clipped to the limits."""
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    limits = np.array([joint.goal_limit for joint in config.joints])
    clipped: Array = np.clip(multisine.torque.T / constants, -limits, limits)
    return clipped


def make_plan(config: Config) -> Plan:
    """Design the multisines of a planar arm; the same seed gives the same plan."""
    check_rate(config)
    return plan_with(config, _segment)


def plan_with(config: Config, segment: Callable[[Config, str, int], Segment]) -> Plan:
    """Make a plan whose segments are designed by `segment`, each for its role and with its own seed."""
    experiment = config.experiment
    roles = ROLES if experiment.held_out else (IDENTIFY,)
    return Plan(
        rate=experiment.rate,
        segments=tuple(segment(config, role, experiment.seed + offset) for offset, role in enumerate(roles)),
        rest_samples=max(1, round(experiment.rest * experiment.rate)),
        end_samples=_end_samples(config),
        brake_samples=round(config.safety.damp_time / exchange_interval(1 / experiment.rate)),
        max_settling_periods=experiment.max_settling_periods,
        periods=experiment.periods,
        settle_within=experiment.settle_within,
        drift_within=experiment.drift_within,
        warm_up_periods=experiment.warm_up_periods,
    )


def rest_window(rate: float) -> int:
    """Number of samples between two checks of whether the arm has come to rest."""
    return max(1, round(0.2 * rate))


def _end_samples(config: Config) -> int:
    """Maximum number of samples to wait until the arm is at rest: a multiple of the window."""
    rate = config.experiment.rate
    window = rest_window(rate)
    return window * max(1, math.ceil(config.safety.rest_time * rate / window))


def _lines(config: Config) -> Sequence[Sequence[int]]:
    experiment = config.experiment
    if experiment.band is None:
        return experiment.lines or []
    low, high = experiment.band
    if experiment.detection:
        return detecting_lines(experiment.period, (low, high), len(config.joints), experiment.seed)
    return zippered_lines(experiment.period, (low, high), len(config.joints))


def _segment(config: Config, role: str, seed: int) -> Segment:
    experiment = config.experiment
    if experiment.peak_torque is None:
        raise ConfigError(
            f"{config.path}: experiment.peak_torque is missing. {how_to_find_torque(config)} Or let hil find "
            "it: pilot = true."
        )
    multisine = design_multisine(experiment.rate, experiment.period, _lines(config), experiment.peak_torque, seed)
    return Segment(role, multisine, period_current(config, multisine), round(experiment.ramp * experiment.rate))
