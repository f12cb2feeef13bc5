"""Deadlines on a scripted clock with known late wake-ups and stalls."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.drivers.clock import WallClock
from hil.drivers.rate import FixedRate
from hil.fakes.bus.clock import VirtualClock


def test_deadlines_are_absolute_and_none_is_missed_by_late_wake_ups() -> None:
    clock = VirtualClock(100.0)
    ticks = FixedRate(clock, 500.0)
    for index in range(1000):
        tick = ticks.wait()
        assert tick.deadline == pytest.approx(100.002 + 0.002 * index, abs=1e-9)
        assert not tick.missed
        clock.wait_until(clock.now() + 0.0019)  # what the work takes
    assert ticks.missed == 0


@pytest.mark.parametrize(("periods", "misses"), [(0.9, 0), (1.5, 0), (2.5, 1), (10.5, 9), (1000.5, 999)])
def test_a_stall_is_counted_to_the_last_period(periods: float, misses: int) -> None:
    """Work lasting 10.5 periods ends half a period after the tenth deadline.

    The tenth deadline is then late, and the nine before it are missed.
    """
    clock = VirtualClock()
    ticks = FixedRate(clock, 1000.0)
    ticks.wait()
    clock.wait_until(clock.now() + periods * 1e-3)
    seen = [ticks.wait() for _ in range(misses + 3)]
    assert [tick.missed for tick in seen] == [True] * misses + [False] * 3
    assert ticks.missed == misses


@given(st.lists(st.floats(0.0, 20.0), min_size=1, max_size=50))
def test_whatever_the_stalls_no_burst_follows_and_the_phase_is_kept(stalls: list[float]) -> None:
    clock = VirtualClock()
    ticks = FixedRate(clock, 1000.0)
    used = []
    count = 0
    for stall in stalls:
        tick = ticks.wait()
        count += 1
        while tick.missed:
            tick = ticks.wait()
            count += 1
        used.append(tick)
        clock.wait_until(clock.now() + stall * 1e-3)
    assert ticks.missed == count - len(stalls)
    assert all(tick.now - tick.deadline < 1e-3 for tick in used)
    assert all(tick.deadline == pytest.approx(1e-3 * round(tick.deadline * 1e3), abs=1e-9) for tick in used)
    # No two uses for one period.
    deadlines = [tick.deadline for tick in used]
    assert all(later - earlier > 0.9e-3 for earlier, later in pairwise(deadlines))


def test_the_wall_clock_never_wakes_early() -> None:
    clock = WallClock()
    ticks = FixedRate(clock, 2000.0)
    for _ in range(20):
        tick = ticks.wait()
        assert tick.now >= tick.deadline
