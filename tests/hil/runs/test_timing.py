"""Timing figures of a recording with known lateness."""

import numpy as np
import pytest

from hil.results.parts import Quantiles
from hil.runs.recording import sample_type
from hil.runs.timing import lateness_histogram, timing

RATE = 500.0


def recording(count: int = 20_000, servo_clock_ppm: float = 0.0) -> np.ndarray:
    samples = np.zeros(count, sample_type(2))
    samples["deadline"] = 1000.0 + np.arange(count) / RATE
    samples["time_before_write"] = samples["deadline"] + 1e-6
    samples["time_after_read"] = samples["time_before_write"] + 800e-6
    samples["servo_clock"] = np.nan
    read = samples[50::125]
    seconds = (read["time_before_write"] - 990.0) * (1 + 1e-6 * servo_clock_ppm)
    read["servo_clock"] = (np.floor(seconds * 1000) / 1000 % 32.768)[:, None]
    return samples


def test_a_loop_on_time() -> None:
    kept = timing(recording(), RATE)
    assert kept.lateness_us == Quantiles(p50=1.0, p99=1.0, p99_9=1.0, max=1.0)
    assert kept.round_trip_us.p50 == pytest.approx(800.0)
    assert (kept.missed_ticks, kept.lost_replies, kept.drift_us) == (0, 0, 0.0)
    assert kept.rate_held == pytest.approx(RATE)


def test_missed_and_lost_and_late_are_told_apart() -> None:
    samples = recording()
    samples["time_after_read"][100:109] = samples["time_before_write"][100:109]  # never sent
    samples["missing"][200, 1] = 1
    samples["time_before_write"][300] += 500e-6
    kept = timing(samples, RATE)
    assert (kept.missed_ticks, kept.lost_replies) == (9, 1)
    assert kept.lateness_us.max == pytest.approx(501.0, abs=0.2)
    assert kept.rate_held == pytest.approx(RATE * (1 - 9 / 20_000), abs=1e-3)


def test_a_loop_that_drifts_is_seen() -> None:
    samples = recording()
    samples["time_before_write"] += np.linspace(0, 1e-3, len(samples))
    samples["time_after_read"] += np.linspace(0, 1e-3, len(samples))
    assert timing(samples, RATE).drift_us == pytest.approx(900.0, rel=0.01)


@pytest.mark.parametrize("ppm", [-200.0, 0.0, 50.0])
def test_the_servos_clock_is_compared_over_its_wraps(ppm: float) -> None:
    assert timing(recording(servo_clock_ppm=ppm), RATE).servo_clock_ppm == pytest.approx([ppm, ppm], abs=10.0)


def test_a_clock_that_was_hardly_read_is_not_judged() -> None:
    assert timing(recording(500), RATE).servo_clock_ppm == (None, None)


def test_the_histogram_counts_every_sent_sample() -> None:
    samples = recording()
    samples["time_before_write"][:10] += 10.0
    samples["time_after_read"][:10] += 10.0
    histogram = lateness_histogram(samples)
    assert len(histogram["counts"]) == len(histogram["edges_us"])
    assert sum(histogram["counts"]) == len(samples)
    assert histogram["counts"][-1] == 10
