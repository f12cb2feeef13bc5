"""Which arms of a prior moved most like the one on the bench: where an estimate from a small motion starts.

A small motion leaves a likelihood with local minima, in which gear friction of an odd shape stands in for inertia. An
arm that was drawn from what is known, and that moved alike, lies on the right side of them.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.prediction import scaled_feedback
from hil.dry_run.rollout import commands_of, simulate_experiment
from hil.estimator.models.parameters import CONSTANTS, Physics
from hil.estimator.models.terms import term_of
from hil.plan.plan import Plan
from hil.plan.stabiliser import feedback_of
from hil.runs.recording import Phase

Array = NDArray[np.float64]


def likely_arms(
    config: Config, ensemble: Ensemble, plan: Plan, samples: NDArray[np.void], count: int
) -> list[dict[str, float]]:
    """Parameters by name [SI, by the first joint's supposed torque constant] of the `count` arms that moved most alike.

    samples: what was recorded of `plan` (hil.runs.recording); its first period is compared.
    """
    length, ramp = plan.segments[0].multisine.samples, plan.segments[0].ramp_samples
    periodic = (samples["phase"] == Phase.PERIODIC) & (samples["segment"] == 0)
    seen = samples["position"][periodic][:length].T
    size = np.nanvar(seen, axis=1)
    commands = [commands_of(config, segment) for segment in plan.segments[:1]]
    far = []
    for physics, scale in zip(ensemble.physics, ensemble.torque_scale, strict=True):
        feedback = scaled_feedback(feedback_of(config), scale)
        position = simulate_experiment(plan, commands, physics, scale, feedback).position[:, ramp : ramp + length]
        far.append(float(np.sum(np.nanmean((position - seen) ** 2, axis=1) / size)))
    nearest = np.argsort(far, kind="stable")[:count]
    return [_as_supposed(ensemble.physics[arm], ensemble.torque_scale[arm]) for arm in nearest]


def _as_supposed(physics: Physics, scale: Array) -> dict[str, float]:
    """The arm's parameters as one sees them who supposes torques 1 / `scale` (joints,) as large as they are."""
    known = dict(zip(CONSTANTS, physics.vector.tolist(), strict=True))
    supposed = {
        # What doubles when all torques are twice as large as supposed.
        name: value / float(scale[0]) if term_of(name).of_torque else value
        for name, value in known.items()
    }
    return supposed | {"torque_scale_2": float(scale[-1] / scale[0]), "lag": physics.lag}
