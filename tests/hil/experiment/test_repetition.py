"""The comparison of periods sample by sample gives the same result as comparing whole periods."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.estimation.settled_period import settling_difference
from hil.experiment.repetition import Repetition

INTERVAL = 0.01


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
    repetition = Repetition(samples, joints, INTERVAL)
    played(repetition, periods[0])
    for former, latest in pairwise(periods):
        played(repetition, latest)
        wanted = settling_difference(former, latest)
        if wanted < 1e-9 or not math.isfinite(wanted):
            assert repetition.difference == wanted or repetition.difference < 1e-6
        else:
            assert repetition.difference == pytest.approx(wanted, rel=1e-6)


def test_how_far_each_joint_moved() -> None:
    repetition = Repetition(4, 3, INTERVAL)
    nan = math.nan
    played(repetition, np.array([[1.0, 3.0, nan, 2.0], [nan, nan, nan, nan], [0.5, 0.5, 0.5, 0.5]]))
    first, second, third = repetition.moved
    assert first == 2.0 and math.isnan(second) and third == 0.0


def test_a_shorter_period_after_a_longer_one() -> None:
    repetition = Repetition(6, 1, INTERVAL)
    played(repetition, np.arange(6.0)[None])
    short = np.array([[1.0, 2.0, 1.0, 5.0]])
    played(repetition, short)
    played(repetition, short)
    assert repetition.difference == 0.0


def unlike_at(periods: np.ndarray, interval: float = INTERVAL) -> tuple[int, int, int] | None:
    """Period, sample and joint at which the motion first counts as not repeated; periods (periods, joints, samples)."""
    repetition = Repetition(periods.shape[2], periods.shape[1], interval)
    for number, period in enumerate(periods):
        repetition.begin(period.shape[1])
        for index, sample in enumerate(period.T.tolist()):
            repetition.add(index, sample)
            if (joint := repetition.unlike) is not None:
                return number, index, joint
    return None


def drifting(seed: int, rms: float, samples: int = 200) -> np.ndarray:
    """Four periods of two joints that differ from one another by random deviations of this RMS [rad]."""
    random = np.random.default_rng(seed)
    motion = np.sin(np.linspace(0, 2 * np.pi, samples)) * np.array([[1.0], [0.4]])
    return motion + rms / math.sqrt(2) * random.standard_normal((4, 2, samples))


@pytest.mark.parametrize("rms", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("seed", range(5))
def test_noise_and_drift_repeat_the_motion(seed: int, rms: float) -> None:
    assert unlike_at(drifting(seed, rms)) is None


@pytest.mark.parametrize("rms", [0.0, 0.01])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_joint_that_is_elsewhere_than_a_period_before_is_seen_after_the_shortest_time(joint: int, rms: float) -> None:
    periods = drifting(1, rms)
    deviation = 10.0 * rms * 1.4 + 1.01 * 0.05
    periods[2, joint, 50:] += deviation
    number, index, seen = unlike_at(periods) or (0, 0, -1)
    assert (number, seen) == (2, joint) and index == 52, "the third sample of 10 ms"
    periods = drifting(1, rms)
    periods[2, joint, 50:52] -= deviation  # too short
    assert unlike_at(periods) is None


def test_slow_rates_take_two_samples_and_missing_ones_say_nothing() -> None:
    periods = drifting(2, 0.0)
    periods[2, 0, 50] += 1.0
    assert unlike_at(periods, 0.05) is None
    periods[2, 0, 51] = math.nan
    periods[2, 0, 52] -= 1.0
    assert unlike_at(periods, 0.05) == (2, 52, 0)


def test_the_second_period_may_differ_from_the_first() -> None:
    periods = drifting(3, 0.0)
    periods[0] += 1.0
    assert unlike_at(periods) is None
    assert unlike_at(periods + np.array([0.0, 0.0, 11.0, 0.0])[:, None, None]) is not None


@pytest.mark.parametrize("rms", [0.0, 0.01])
def test_in_the_second_half_of_the_second_period_differences_no_longer_grow(rms: float) -> None:
    periods = drifting(6, rms)
    periods[1, 0, :100] += 0.01  # a transient
    allowed = 10.0 * math.hypot(rms, 0.01) + 0.05
    periods[1, 0, 150:] += 1.3 * allowed
    assert unlike_at(periods) == (1, 152, 0)
    periods[1, 0, 150:] -= 0.6 * allowed
    assert unlike_at(periods[:2]) is None
    earlier = drifting(6, rms)
    earlier[1, 0, 50:] += 1.0
    assert unlike_at(earlier[:2]) is None, "it may be a transient"


@pytest.mark.parametrize("size", [0.05, 0.06])
def test_a_disturbance_that_begins_before_the_end_of_a_period_is_not_accepted_in_the_next(size: float) -> None:
    periods = drifting(7, 0.001)
    periods[2, 0, -20:] += np.linspace(0.0, size, 20)
    assert unlike_at(periods[:3]) is None
    periods[3, 0] += size + 0.03
    assert unlike_at(periods) == (3, 2, 0)


@pytest.mark.parametrize(("size", "found"), [(0.199, None), (0.201, (3, 2, 0))])
def test_what_happened_before_the_last_fifth_of_a_second_is_accepted_in_the_next_period(
    size: float, found: tuple[int, int, int] | None
) -> None:
    """The 80 samples before it differed by 30 mrad in a quarter of them, 15 mrad RMS."""
    periods = np.zeros((4, 1, 200))
    periods[2, 0, 160:180] = 0.03
    periods[3, 0, :100] = size
    assert unlike_at(periods) == found


@pytest.mark.parametrize(("size", "found"), [(0.149, None), (0.151, (1, 152, 0))])
@pytest.mark.parametrize("known", [100, 1])
def test_the_tolerance_in_the_second_period_is_that_of_all_known_samples_in_its_first_half(
    known: int, size: float, found: tuple[int, int, int] | None
) -> None:
    """10 mrad RMS, of however few replies."""
    periods = np.zeros((2, 1, 200))
    periods[1, 0, :100] = math.nan
    periods[1, 0, 100 - known : 100] = 0.01
    periods[1, 0, 150:] = size
    assert unlike_at(periods) == found


def test_other_torques_may_give_another_motion() -> None:
    """A held-out segment follows the one that is fitted."""
    first, second = drifting(4, 1e-3), drifting(5, 1e-3) * 0.3 + 0.5
    repetition = Repetition(first.shape[2], 2, INTERVAL)
    for periods in (first, second):
        for number, period in enumerate(periods):
            repetition.begin(period.shape[1], anew=number == 0)
            for index, sample in enumerate(period.T.tolist()):
                repetition.add(index, sample)
                assert repetition.unlike is None
    assert repetition.difference < 0.02


def test_the_floor_of_the_tolerance() -> None:
    periods = drifting(1, 0.0)
    periods[2, 0, 50:] += 0.049
    assert unlike_at(periods) is None
    periods[2, 0, 50:] += 0.002
    assert unlike_at(periods) == (2, 52, 0)


def test_a_joint_at_zero_from_the_first_sample_on_is_compared_too() -> None:
    """The initial contents of the buffers must not count as a motion."""
    periods = np.zeros((3, 1, 10))
    assert unlike_at(periods) is None
    repetition = Repetition(10, 1, INTERVAL)
    assert repetition.unlike is None and math.isnan(repetition.moved[0])
    played(repetition, periods[0])
    assert repetition.moved == [0.0] and repetition.difference == math.inf, "there is no period before"
    played(repetition, periods[1])
    assert repetition.difference == 0.0, "neither moved"
    periods[2] += np.linspace(0.0, 1e-3, 10)
    played(repetition, periods[2])
    assert 0.0 < repetition.difference < math.inf


def test_a_new_torque_compares_with_nothing() -> None:
    repetition = Repetition(10, 1, INTERVAL)
    played(repetition, np.full((1, 10), 0.5))
    repetition.begin(10, anew=True)
    for index in range(10):
        repetition.add(index, [0.7])
    assert repetition.difference == math.inf and repetition.unlike is None


def test_a_standstill_elsewhere_is_infinitely_different() -> None:
    repetition = Repetition(10, 1, INTERVAL)
    played(repetition, np.full((1, 10), 0.5))
    played(repetition, np.full((1, 10), 0.6))
    assert repetition.difference == math.inf


@pytest.mark.parametrize(("count", "unlike"), [(2, None), (3, 0)])
def test_a_period_begins_without_a_doubt_from_the_one_before(count: int, unlike: int | None) -> None:
    repetition = Repetition(10, 1, INTERVAL)
    still = np.zeros((1, 10))
    for _ in range(3):
        played(repetition, still)
    repetition.begin(10)
    for index in range(count):  # 30 ms are three samples
        repetition.add(index, [0.06])
    assert repetition.unlike == unlike


def test_the_tolerance_of_the_third_period_is_that_of_two_whole_periods() -> None:
    """The first half of the second period was the same, the second half differed by less than the floor."""
    samples = 100
    first, second, third = np.zeros((3, 1, samples))
    second[0, samples // 2 :] = 0.04
    third[0, samples // 2 :] = 0.04 + 0.2
    repetition = Repetition(samples, 1, INTERVAL)
    played(repetition, first)
    played(repetition, second)
    repetition.begin(samples)
    for index, sample in enumerate(third.T.tolist()):
        repetition.add(index, sample)
        assert repetition.unlike is None, "0.2 rad is less than 0.05 rad plus ten times an RMS of 0.028 rad"
