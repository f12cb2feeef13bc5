"""A settled period as a recording, for methods that do not exploit its periodicity."""

import numpy as np

from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod


def joined(period: SettledPeriod, periods: int) -> Recording:
    """Return the settled period, repeated `periods` times, as a recording with commands held between samples."""
    count = period.samples * periods
    return Recording(
        np.arange(count) / period.rate,
        np.tile(period.torque, periods),
        np.tile(period.position, periods),
        period.position_step,
        between="held",
        command_to_sample=period.command_to_sample,
    )
