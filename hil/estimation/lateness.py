"""A settled period as it would have been on time: the effect of the computer's lateness is corrected.

Every goal leaves a little after its deadline, and the positions that answer it are as late. The estimator's grid is
that of the deadlines. So each angle is moved by velocity times lateness, and each held torque becomes the mean of what
really acted between its deadline and the next: the former one until the write, its own from there. What is left is of
second order: half of acceleration times lateness squared, a hundredth of an encoder step at 0.5 ms and 50 rad/s^2.

Not seen from here, and so not corrected, is what passes between the write call and the wire (the adapter's buffer), and
between the request's arrival and the servo's own sampling.
"""

import numpy as np
from numpy.typing import NDArray

from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod

Values = NDArray[np.float64]


def lateness(rows: NDArray[np.void]) -> Values:
    """s from each row's deadline to its write, shaped as `rows`; 0 where no write was tried."""
    sent = rows["time_after_read"] > rows["time_before_write"]
    late: Values = np.where(sent, rows["time_before_write"] - rows["deadline"], 0.0)
    return late


def acting_torque(goals: Values, late: Values, rate: float) -> Values:
    """Mean torque between deadlines (joints, samples) of `goals` (joints, samples + 1), the first the one before.

    `late` (samples,): lateness of all but the first [s].
    """
    before = np.clip(late * rate, 0.0, 1.0)
    mean: Values = goals[:, 1:] + (goals[:, :-1] - goals[:, 1:]) * before
    return mean


def velocity_of(period: SettledPeriod) -> Values:
    """Velocities (joints, samples) [rad/s] by the lines of the motion up to where it meets the noise."""
    lines = lines_of(period.filled())
    return motion_of(lines, cut_off(lines), period.fundamental, period.samples).velocity
