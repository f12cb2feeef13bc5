"""Whether the sample rate of a spatial arm is high enough for the gains with which its joints are held and lowered."""

from math import ceil

import numpy as np

from hil.config.schema import Config, PriorConfig
from hil.drivers.servo_prior import Guess, servo_prior
from hil.estimator.arrays import Array
from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.simulation.rollout import mass_matrices
from hil.plan.chain_model import known_chain
from hil.plan.drive_prior import low_armatures, low_viscous
from hil.plan.sampled_loop import SampledLoop

_POSES = 40
_HIGHEST_HZ = 5000.0
"""Upper end of the search for a sufficient rate [Hz]."""


def chain_too_slow(config: Config) -> str:
    """Explain why the rate is too low for the stabiliser of a spatial arm, and what to do; "" if it is high enough."""
    assert config.stabiliser is not None
    rate, loop = config.experiment.rate, sampled_loop(config)
    if loop.is_stable(rate):
        return ""
    at = loop.fastest_growing(rate)
    wanted = loop.sufficient_rate(rate, _HIGHEST_HZ)
    raised = "" if wanted is None else f"Raise the rate to at least {ceil(wanted)} Hz, or lower"
    return (
        f"experiment.rate = {rate:g} is too low for the stabiliser: each torque is based on a state that was read "
        f"{1e3 / rate:.0f} ms earlier, and is then held for the same time. With a stiffness of "
        f"{config.stabiliser.stiffness[at]:g} N m/rad and a damping of {config.stabiliser.damping[at]:g} N m s/rad, "
        f"joint {config.joints[at].name!r} may oscillate more and more if the arm is lighter than described and has "
        f"less friction than expected. {raised or 'Lower'} stabiliser.stiffness and stabiliser.damping."
    )


def sampled_loop(config: Config) -> SampledLoop:
    """The control loop of an arm whose masses and friction are one standard deviation below their expected values."""
    assert config.stabiliser is not None
    known, given = known_chain(config), config.arm.prior or PriorConfig()
    links = Guess(1.0, given.spread).low * known.described.reshape(-1, TERMS)[:, :-1]
    return SampledLoop(
        mass_matrices(known.base.chain, links, low_armatures(config), _poses(config)),
        np.array(config.stabiliser.stiffness),
        np.array(config.stabiliser.damping),
        low_viscous(config),
        np.array([servo_prior(joint.joint.servo).lag.median for joint in config.joints]),
    )


def _poses(config: Config) -> Array:
    """Poses between the rest pose and the path (poses, joints) [rad] or, if the path is not known yet, poses within the
    position limits.
    """
    rest, path = np.array(config.arm.rest_pose), config.joint_path
    if path is None:
        low, high = np.array([joint.position_limit for joint in config.joints]).T
    else:
        centre, swing = np.array(path.centre), np.array(path.swing)
        low, high = np.minimum(rest, centre - swing), np.maximum(rest, centre + swing)
    drawn = np.random.default_rng(2).uniform(low, high, (_POSES, len(rest)))
    return np.vstack((rest, drawn))
