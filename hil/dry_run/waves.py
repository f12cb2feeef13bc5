"""Which waves a full run plays: low-crest ones that use the room between the limits well, or designed ones."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.amplitude import with_peaks
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.excitation.optimal_design import Limits, Problem, design_optimal, smoothed
from hil.estimator.models.parameters import Physics
from hil.plan.plan import Plan, Segment, period_current
from hil.plan.stabiliser import feedback_of

WAVES = 6
"""Seeds tried for each multisine: how evenly an arm swings to both sides depends on the phases."""


def roomy_plan(config: Config, physics: Physics) -> Plan:
    """The configuration's plan with those low-crest waves that use most of the position range on the arm `physics`."""
    problem = design_problem(config, physics, ())
    plan = with_peaks(config, _torque_limits(config))
    candidates = []
    for seed in range(config.experiment.seed, config.experiment.seed + WAVES):
        segment = _plain_segment(config, seed)
        wave = problem.scaled(segment.multisine, np.ones(len(config.joints)))
        candidates.append((_range_used(problem, wave), _with_wave(config, segment, wave)))
    best = sorted(candidates, key=lambda each: -each[0])
    chosen = tuple(replace(best[place][1], role=segment.role) for place, segment in enumerate(plan.segments))
    return replace(plan, segments=chosen)


def designed_plan(config: Config, physics: Physics, names: list[str]) -> Plan:
    """The same with the first multisine designed for small standard errors of `names`."""
    plan = roomy_plan(config, physics)
    first = plan.segments[0]
    problem = design_problem(config, physics, tuple(names))
    wave = design_optimal(first.multisine, problem, config.experiment.seed).multisine
    return replace(plan, segments=(_with_wave(config, first, wave), *plan.segments[1:]))


def design_problem(config: Config, physics: Physics, names: tuple[str, ...]) -> Problem:
    """Limits and arm as the estimator's design wants them."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    velocity = np.array([joint.velocity_limit for joint in config.joints])
    step = np.array([joint.joint.servo.position_unit for joint in config.joints])
    limits = Limits(low, high, velocity, _torque_limits(config))
    return Problem(smoothed(physics), names, limits, np.array(config.arm.rest_pose), step, feedback_of(config))


def _plain_segment(config: Config, seed: int) -> Segment:
    experiment = config.experiment.model_copy(update={"seed": seed, "held_out": False})
    return with_peaks(config.model_copy(update={"experiment": experiment}), _torque_limits(config)).segments[0]


def _with_wave(config: Config, segment: Segment, wave: Multisine) -> Segment:
    return replace(segment, multisine=wave, period_current=period_current(config, wave))


def _range_used(problem: Problem, wave: Multisine) -> float:
    """Share of the allowed positions that the motion covers, the worst joint's."""
    covered = np.ptp(problem.positions(wave), axis=1)
    allowed = problem.limits.high - problem.limits.low
    return float((covered / allowed).min())


def _torque_limits(config: Config) -> NDArray[np.float64]:
    return np.array([0.97 * joint.goal_limit * joint.torque_per_goal for joint in config.joints])
