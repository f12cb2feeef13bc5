"""The comparison of periods sample by sample gives the same result as comparing whole periods."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.estimation.settled_period import settling_difference
from hil.experiment.repetition import Repetition


def played(repetition: Repetition, period: np.ndarray) -> None:
    repetition.begin(period.shape[1])
    for index, sample in enumerate(period.T.tolist()):
        repetition.add(index, sample)


@settings(max_examples=100, deadline=None)
@given(
    seed=st.integers(0, 1_000_000),
    samples=st.integers(2, 60),
    joints=st.integers(1, 3),
    lost=st.sampled_from([0.0, 0.1, 0.9]),
    moved=st.sampled_from([0.0, 1e-6, 1.0]),
)
def test_the_same_as_of_whole_periods(seed: int, samples: int, joints: int, lost: float, moved: float) -> None:
    random = np.random.default_rng(seed)
    periods = -1.5 + moved * random.standard_normal((3, joints, samples))
    periods[random.random(periods.shape) < lost] = np.nan
    repetition = Repetition(samples, joints)
    played(repetition, periods[0])
    for former, latest in pairwise(periods):
        played(repetition, latest)
        wanted = settling_difference(former, latest)
        if wanted < 1e-9 or not math.isfinite(wanted):
            assert repetition.difference == wanted or repetition.difference < 1e-6
        else:
            assert repetition.difference == pytest.approx(wanted, rel=1e-6)


def test_how_far_each_joint_moved() -> None:
    repetition = Repetition(4, 3)
    nan = math.nan
    played(repetition, np.array([[1.0, 3.0, nan, 2.0], [nan, nan, nan, nan], [0.5, 0.5, 0.5, 0.5]]))
    first, second, third = repetition.moved
    assert first == 2.0 and math.isnan(second) and third == 0.0


def test_a_shorter_period_after_a_longer_one() -> None:
    repetition = Repetition(6, 1)
    played(repetition, np.arange(6.0)[None])
    short = np.array([[1.0, 2.0, 1.0, 5.0]])
    played(repetition, short)
    played(repetition, short)
    assert repetition.difference == 0.0
