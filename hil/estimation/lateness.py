"""Correction of a settled period for the computer's lateness.

The estimator assumes that goals and positions are exchanged at the deadline; in fact both are slightly late. Therefore
each angle is shifted by velocity times lateness, and each held torque is replaced by the mean torque between its
deadline and the next: the previous goal acts until the write, the new one afterwards. The remaining error is
second-order: half the acceleration times the lateness squared, a hundredth of an encoder step at 0.5 ms and 50 rad/s^2.

Delays that the host cannot see, in the adapter's buffer and before the servo's sampling, are not corrected.
"""

import numpy as np
from numpy.typing import NDArray

from hil.estimator.arrays import Array
from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod


def lateness(rows: NDArray[np.void]) -> Array:
    """Time from each row's deadline to its write [s], with the shape of `rows`; 0 if nothing was written."""
    deadline: Array = rows["deadline"]
    written: Array = rows["time_before_write"]
    read: Array = rows["time_after_read"]
    return np.where(read > written, written - deadline, 0.0)


def acting_torque(goals: Array, late: Array, rate: float) -> Array:
    """Mean torque between deadlines (joints, samples) [N m].

    goals: held torques (joints, samples + 1) [N m], starting with the one before the period. late: lateness of all
    goals but the first (samples,) [s]. rate: samples per second [Hz].
    """
    before = np.clip(late * rate, 0.0, 1.0)
    mean: Array = goals[:, 1:] + (goals[:, :-1] - goals[:, 1:]) * before
    return mean


def velocity_of(period: SettledPeriod) -> Array:
    """Velocities (joints, samples) [rad/s] from those Fourier coefficients of the motion that exceed the noise."""
    lines = lines_of(period.filled())
    return motion_of(lines, cut_off(lines), period.fundamental, period.samples).velocity
