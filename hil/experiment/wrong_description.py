"""After a stop, find a mistake in a spatial arm's description that explains the motion.

The samples up to the stop are compared with the description's prior ensemble of arms. This takes about a second, so it
is done only once torque is off.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.chain_prior import prior_arms
from hil.errors import Cause, SafetyStop
from hil.estimator.arrays import Array
from hil.estimator.chain.description_faults import Change, Motion, better_descriptions
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.experiment.chain_watch import ARMS, LYING_RAD, observed_parameters
from hil.plan.chain_model import known_chain
from hil.runs.recording import Phase

CONTRADICTS = frozenset({Cause.UNEXPECTED, Cause.WRONG_SIGN})
"""A stop for one of these reasons means that the motion contradicts the description."""


def doubt_spatial_description(
    config: Config, error: BaseException, samples: NDArray[np.void], *, has_moved: bool
) -> None:
    """If the guard stopped a spatial arm because its motion contradicts the description, name the changes to the
    description that would explain the motion.

    samples: all samples of the run. has_moved: whether the arm has moved as described in an earlier run, so that the
    description is doubted only if a change explains the motion.
    """
    stop = error if isinstance(error, SafetyStop) else error.__context__
    if not config.is_chain or not isinstance(stop, SafetyStop) or stop.overruled or stop.cause not in CONTRADICTS:
        return
    changes = likely_mistakes(config, samples)
    stop.doubts_description = bool(changes) or not has_moved
    if changes:
        said = ", or ".join(_said(config, each) for each in changes)
        stop.replace_remedy(
            f"The arm's whole motion contradicts its description, but would agree with it {said}. Compare the arm with "
            "its description, with torque off, before you look for a faulty servo."
        )


def likely_mistakes(config: Config, samples: NDArray[np.void]) -> tuple[Change, ...]:
    """Return the changes to the description that would explain the samples before a stop, the likeliest first."""
    known, rest = known_chain(config), np.array(config.arm.rest_pose)

    def of_chain(chain: Chain) -> tuple[BaseParameters, Array, Array]:
        base = BaseParameters.of(chain, tilts=config.model.base_tilt)
        mean, covariance = observed_parameters(prior_arms(config, replace(known, base=base), ARMS))
        return base, mean, covariance

    seen = samples[samples["phase"] != Phase.LOWERING]
    seen = seen[np.isfinite(seen["position"]).all(axis=1)]
    if not len(seen):
        return ()
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    goals = seen["goal_current"].T
    torque = constants[:, None] * np.concatenate((np.zeros((len(constants), 1)), goals[:, :-1]), axis=1)
    motion = Motion.of(seen["position"].T, torque, 1.0 / config.experiment.rate, rest, LYING_RAD)
    return better_descriptions(known.base.chain, of_chain, motion, rest)


def _said(config: Config, change: Change) -> str:
    axis = " ".join(f"{each:g}" for each in change.axis)
    if change.kind == "base":
        return f"if the arm were mounted with the direction {axis} of its base's frame pointing up (arm.base)"
    joint, rest = config.joints[change.joint], config.arm.rest_pose[change.joint]
    if change.kind == "axis":
        return f"if {joint.name!r} turned about the axis {axis} of its frame in the URDF"
    if change.kind == "direction":
        at_rest = rest if change.turned else -rest
        return f"if the direction of {joint.name!r} were reversed (its angle at rest would then be {at_rest:.3g} rad)"
    how = "larger" if change.turned > 0.0 else "smaller"
    return f"if the angle of {joint.name!r} were {abs(np.degrees(change.turned)):.0f} degrees {how} (zero_ticks)"
