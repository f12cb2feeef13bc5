"""Jumps in recordings without a velocity: found from 8 encoder steps on, and nothing else is mistaken for one."""

from collections.abc import Callable

import numpy as np
import pytest

from hil.estimation.slips.recorded_jumps import jump_sentences, recorded_jumps
from hil.estimator.data.recording import Recording

STEP = 2 * np.pi / 4096
SECONDS = 8.0


def recorded(seed: int, rate: float, disturb: Callable[[np.ndarray, np.ndarray], np.ndarray], lost: bool) -> Recording:
    """A joint that swings by about a radian, with times that jitter, read by an encoder; `lost`: without 3 % of it."""
    random = np.random.default_rng(seed)
    time = (np.arange(round(SECONDS * rate)) + random.uniform(-0.1, 0.1, round(SECONDS * rate))) / rate
    tones = zip(random.uniform(0.2, 3.0, 5), random.uniform(0.0, 6.0, 5), strict=True)
    position = np.sum([0.25 * np.sin(2 * np.pi * f * time + phase) for f, phase in tones], axis=0)
    position = np.round(disturb(time, position) / STEP) * STEP
    position[random.random(time.size) < 0.03 * lost] = np.nan
    return Recording(time, np.ones((1, time.size)), position[None], np.array([STEP]), between="held")


@pytest.mark.parametrize(
    ("rate", "lost"),
    [
        (100.0, False),
        (100.0, True),
        (250.0, True),
        (500.0, False),
        pytest.param(250.0, False, marks=pytest.mark.slow),
        pytest.param(500.0, True, marks=pytest.mark.slow),
    ],
)
def test_a_jump_is_found_with_its_time_and_size(rate: float, lost: bool) -> None:
    found = 0
    for seed in range(10):
        random = np.random.default_rng(seed)
        steps = random.choice([-1, 1]) * random.integers(9, 60)
        at = random.uniform(1.0, SECONDS - 1.0)
        assert recorded_jumps([recorded(seed, rate, lambda _, position: position, lost)]) == []
        recording = recorded(seed, rate, lambda time, row, at=at, size=steps: row + size * STEP * (time >= at), lost)
        for jump in recorded_jumps([recording]):
            found += 1
            assert jump.time == pytest.approx(at, abs=3.0 / rate)
            assert jump.size == pytest.approx(steps * STEP, abs=2.0 * STEP)
    assert 9 <= found <= 10, "one may fall into lost samples"


def spike(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    return position + 40 * STEP * (np.arange(time.size) == 700)


def impact(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """The joint bounces off a stop: its velocity changes within a sample."""
    return np.abs(position)


def slide(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """A quick motion that takes six samples."""
    return position + 40 * STEP * np.clip((time - 7.0) * 250.0 / 6.0, 0.0, 1.0)


@pytest.mark.parametrize("disturb", [spike, impact, slide])
def test_what_is_no_jump_is_not_taken_for_one(disturb: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
    assert recorded_jumps([recorded(seed, 250.0, disturb, False) for seed in range(20)]) == []


def test_the_sentence_names_recording_joint_time_and_size() -> None:
    recording = recorded(1, 250.0, lambda time, row: row + 40 * STEP * (time >= 7.0), False)
    (said,) = jump_sentences([recording], ["a.csv"], [True])
    assert said.startswith("a.csv: Joint 1: the position jumps by +0.06") and " encoder steps) at 7.00" in said
    (said,) = jump_sentences([recording], ["a.csv"], [False], ["elbow"])
    assert "a.csv: elbow: " in said and "encoder steps" not in said
