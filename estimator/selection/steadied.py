"""Correction of periods for friction that changes while they are recorded, for example because grease warms up.

A fit assumes constant friction. If friction changes by a fraction c per second, the fit lacks the torque c (t -
t_middle) F(t), where F is the friction torque. F follows from the measured motion and a first fit, and c from a later
recording (`hil.estimator.selection.drift`); the product is subtracted from the commanded torque. The fit then holds for
the middle of the period.
"""

from dataclasses import replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.identify import Estimate
from hil.estimator.models.friction import direction, dry_level, viscous
from hil.estimator.selection.drift import Drift

LEAST_WIDTH = 0.01  # rad/s: width of the Coulomb step for models without one, such as bristles


def friction_torque(period: SettledPeriod, estimate: Estimate) -> Array:
    """Return the friction (joints, samples) [N m] of `estimate` in the measured motion of `period`."""
    lines = lines_of(period.filled())
    velocity = motion_of(lines, cut_off(lines), period.fundamental, period.samples).velocity
    friction = np.empty_like(velocity)
    values = estimate.parameters
    for joint, v in enumerate(velocity, start=1):
        step = direction(v, max(values.get(f"coulomb_width_{joint}", LEAST_WIDTH), 1e-4))
        load = values.get(f"load_{joint}", 0.0) * np.abs(period.torque[joint - 1])
        friction[joint - 1] = viscous(values, joint, v, step) + (dry_level(values, joint, v) + load) * step
    return friction


def steadied(period: SettledPeriod, estimate: Estimate, drift: Drift) -> SettledPeriod:
    """Return `period` with the torque that its motion would have required had friction stayed at its mid-period value.

    estimate: fitted to this period, or to one with the same friction. drift: change in friction over `drift.seconds`.
    """
    seconds = np.arange(period.samples) / period.rate
    since = (seconds - seconds.mean()) / drift.seconds
    scale = np.array([estimate.parameters.get(f"torque_scale_{joint + 1}", 1.0) for joint in range(period.joints)])
    lacking = drift.change[:, None] * since * friction_torque(period, estimate) / scale[:, None]
    stabiliser = period.stabiliser
    if stabiliser is not None:
        stabiliser = replace(stabiliser, excitation=stabiliser.excitation - lacking)
    return replace(period, torque=period.torque - lacking, stabiliser=stabiliser)
