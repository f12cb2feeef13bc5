"""Choose the waves of a full run: either multisines that have a low crest factor and make good use of the position
range, or optimally designed multisines.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from hil.config.schema import Config
from hil.dry_run.amplitude import with_peaks
from hil.estimator.arrays import Array
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.excitation.optimal_design import DesignProblem, Limits, design_optimal, smoothed
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.many_arms import ManyArms
from hil.plan.plan import Plan, Segment, period_current
from hil.plan.stabiliser import feedback_of

_EVERY = 4  # evaluate every fourth sample


def roomy_plan(config: Config, physics: Physics) -> Plan:
    """The configured plan, with the variant of each multisine that uses the largest part of the arm's position range.
    physics: parameters of the arm.

    Reversing the sign or time of a wave gives another wave with the same spectrum and peaks.
    """
    return roomy_plans(config, physics, 1)[0]


def roomy_plans(config: Config, physics: Physics, count: int) -> list[Plan]:
    """Return up to `count` plans, the best first. They differ from `roomy_plan` in the variant of the first
    multisine.
    """
    problem = design_problem(config, physics, ())
    plan = with_peaks(config, _torque_limits(config))
    first, *others = [_variants(config, problem, segment) for segment in plan.segments]
    rest = tuple(each[0] for each in others)
    return [replace(plan, segments=(each, *rest)) for each in first[:count]]


def _variants(config: Config, problem: DesignProblem, segment: Segment) -> list[Segment]:
    """Return a copy of the segment for each variant of its wave, ordered by `_evenness` of the motion, the highest
    first.
    """
    wave = problem.scaled(segment.multisine, np.ones(len(config.joints)))
    ordered = sorted(_turned(wave), key=lambda each: _evenness(problem, each), reverse=True)
    return [_with_wave(config, segment, each) for each in ordered]


def _evenness(problem: DesignProblem, wave: Multisine) -> float:
    """Range that the motion would cover if it were scaled to just reach a limit, as a fraction of the range between the
    limits, for the worse joint; 1 is ideal.
    """
    ones = np.ones((1, wave.joints))
    arms = ManyArms([problem.physics], ones, problem.pose[None], problem.feedback)
    position = arms.positions(np.tile(wave.torque, 2), wave.rate, _EVERY)[0]
    low, high = position.min(axis=1), position.max(axis=1)
    limits, pose = problem.limits, problem.pose
    share = np.maximum((low - pose) / (limits.low - pose), (high - pose) / (limits.high - pose))
    return float(((high - low) / (limits.high - limits.low) / np.maximum(share, 1e-3)).min())


def _turned(wave: Multisine) -> list[Multisine]:
    """The wave with all combinations of the joints' signs, each also reversed in time."""
    signs = np.array(list(product((1.0, -1.0), repeat=wave.joints)))
    forward = [_signed(wave, sign) for sign in signs]
    return forward + [_reversed(each) for each in forward]


def _signed(wave: Multisine, sign: Array) -> Multisine:
    phases = tuple(
        tuple(phase if s > 0 else (phase + np.pi) % (2 * np.pi) for phase in each)
        for each, s in zip(wave.phases, sign, strict=True)
    )
    return replace(wave, phases=phases, torque=wave.torque * sign[:, None])


def _reversed(wave: Multisine) -> Multisine:
    """The wave reversed in time: sample n becomes sample -1 - n, so cos(a n + phase) becomes cos(a n + a - phase)."""
    turn = 2 * np.pi / wave.samples
    phases = tuple(
        tuple(float((turn * line - phase) % (2 * np.pi)) for line, phase in zip(lines, each, strict=True))
        for lines, each in zip(wave.lines, wave.phases, strict=True)
    )
    return replace(wave, phases=phases, torque=np.ascontiguousarray(wave.torque[:, ::-1]))


def designed_plan(config: Config, physics: Physics, names: list[str]) -> Plan:
    """Like `roomy_plan`, but with the first multisine designed for small standard errors of the parameters `names`."""
    plan = roomy_plan(config, physics)
    first = plan.segments[0]
    problem = design_problem(config, physics, tuple(names))
    wave = design_optimal(first.multisine, problem, config.experiment.seed).multisine
    return replace(plan, segments=(_with_wave(config, first, wave), *plan.segments[1:]))


def design_problem(config: Config, physics: Physics, names: tuple[str, ...]) -> DesignProblem:
    """The arm and its limits in the form that the estimator's experiment design expects."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    velocity = np.array([joint.velocity_limit for joint in config.joints])
    step = np.array([joint.joint.servo.position_unit for joint in config.joints])
    limits = Limits(low, high, velocity, _torque_limits(config))
    return DesignProblem(smoothed(physics), names, limits, np.array(config.arm.rest_pose), step, feedback_of(config))


def _with_wave(config: Config, segment: Segment, wave: Multisine) -> Segment:
    return replace(segment, multisine=wave, period_current=period_current(config, wave))


def _torque_limits(config: Config) -> Array:
    return np.array([0.97 * joint.goal_limit * joint.torque_per_goal for joint in config.joints])
