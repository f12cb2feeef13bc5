"""A joint that sticks nearly all the time is refused at once: its fit took minutes and determined nothing."""

import numpy as np
import pytest

from hil.errors import CsvError
from hil.estimation.unsettled.slips import refuse_stuck
from hil.estimator.data.recording import Recording

STEP = 2 * np.pi / 4096
TIME = np.arange(2000) / 100.0


def recorded(swing: float, share: float) -> Recording:
    """A swing of `swing` encoder steps, about a slow drift, in the last `share` of the time."""
    late = np.maximum(TIME - (1.0 - share) * TIME[-1], 0.0)
    position = np.round(0.5 * swing * np.sin(6.0 * late) + TIME) * STEP
    return Recording(TIME, np.sin(TIME)[None, :], position[None, :], np.array([STEP]), "held")


def test_a_joint_that_sticks_is_refused() -> None:
    with pytest.raises(CsvError, match=r"arm\.csv: joint 1 sticks: in 90 % of the segments of 1 s"):
        refuse_stuck([recorded(60.0, 0.05)], "arm.csv", 1.0)
    refuse_stuck([recorded(60.0, 0.3)], "arm.csv", 1.0)
    refuse_stuck([recorded(20.0, 1.0)], "arm.csv", 1.0)
