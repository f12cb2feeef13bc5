"""Excitation by design as a plan: waves whose amplitudes and phases make the worst standard error small."""

from dataclasses import replace

import numpy as np

from estimator.optimal_excitation import Limits, design_optimal
from estimator.physics import Physics
from hil.amplitude import with_peaks
from hil.config import Config
from hil.dry_run import feedback_of
from hil.plan import IDENTIFY, Plan, Segment, period_current


def designed_plan(config: Config, physics: Physics, names: list[str]) -> Plan:
    """The configuration's plan with its first multisine designed for `names` on the arm `physics`."""
    most = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
    plain = with_peaks(config, 0.25 * most)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    limits = Limits(low, high, np.array([joint.velocity_limit for joint in config.joints]), most)
    step = np.array([joint.joint.servo.position_unit for joint in config.joints])
    segment = plain.segments[0]
    assert segment.role == IDENTIFY
    wave = design_optimal(
        segment.multisine,
        physics,
        names,
        limits,
        np.array(config.arm.rest_pose),
        step,
        config.experiment.seed,
        feedback_of(config),
    ).multisine
    designed = Segment(IDENTIFY, wave, period_current(config, wave), segment.ramp_samples)
    return replace(plain, segments=(designed, *plain.segments[1:]))
