"""A single jump of a position is found; real motion, delay and bad readings are not mistaken for one."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hil.estimation.slips.position_jumps import jump_disturbances, jump_warnings, position_jumps
from hil.runs.recording import Phase, sample_type

STEP = 2 * np.pi / 4096
VELOCITY_STEP = 0.229 * 2 * np.pi / 60


def swing(
    rate: float, amplitude: float, delay_s: float, seed: int, seconds: float = 20.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, position and velocity as a servo reports them: rounded, and with a delayed velocity."""
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    tones = [(0.3 + 4.0 * random.random(), 2 * np.pi * random.random()) for _ in range(6)]

    def motion(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angles = [2 * np.pi * f * at + phase for f, phase in tones]
        place = sum(np.sin(angle) for angle in angles) * amplitude / 6
        speed = sum(2 * np.pi * f * np.cos(angle) for (f, _), angle in zip(tones, angles, strict=True)) * amplitude / 6
        return np.asarray(place), np.asarray(speed)

    position, velocity = motion(time)[0], motion(time - delay_s)[1]
    return time, np.round(position / STEP) * STEP, np.round(velocity / VELOCITY_STEP) * VELOCITY_STEP


@given(
    rate=st.sampled_from([100.0, 200.0, 500.0]),
    amplitude=st.floats(0.1, 1.5),
    delay_ms=st.floats(0.0, 6.0),
    seed=st.integers(0, 999),
    ticks=st.integers(-200, 200).filter(lambda ticks: abs(ticks) >= 40),
    place=st.floats(0.05, 0.95),
    lost=st.sampled_from([0.0, 0.03]),
)
@example(rate=100.0, amplitude=1.0, delay_ms=0.0, seed=314, ticks=40, place=0.5, lost=0.03)
def test_a_jump_is_found_and_nothing_else(
    rate: float, amplitude: float, delay_ms: float, seed: int, ticks: int, place: float, lost: float
) -> None:
    time, position, velocity = swing(rate, amplitude, 1e-3 * delay_ms, seed)
    missing = np.random.default_rng(seed).random(len(time)) < lost
    position[missing] = np.nan
    assert position_jumps(time, position, velocity, STEP) == []
    at = round(place * len(time))
    missing[at - 1 : at + 1] = False  # a jump across lost samples is found only if it is large
    whole = swing(rate, amplitude, 1e-3 * delay_ms, seed)[1]
    position = np.where(missing, np.nan, whole + ticks * STEP * (np.arange(len(time)) >= at))
    ((found_at, size),) = position_jumps(time, position, velocity, STEP)
    assert found_at == pytest.approx(time[at], abs=4.0 / rate)
    assert size == pytest.approx(ticks * STEP, abs=max(6 * STEP, 0.2 * abs(ticks) * STEP))


def test_one_bad_reading_is_no_jump_and_a_short_recording_has_none() -> None:
    time, position, velocity = swing(200.0, 1.0, 0.002, 1)
    position[900] += 60 * STEP
    assert position_jumps(time, position, velocity, STEP) == []
    position[950:] += 60 * STEP
    assert len(position_jumps(time, position, velocity, STEP)) == 1
    assert position_jumps(time[900:1000], position[900:1000], velocity[900:1000], STEP) == []


def test_a_knock_that_the_velocity_follows_late_is_no_jump() -> None:
    time, position, velocity = swing(200.0, 0.3, 0.0, 2)
    pushed = np.clip((time - 10.0) / 0.01, 0.0, 1.0) * 0.08  # 8 rad/s for 10 ms
    velocity[(time > 10.005) & (time <= 10.0151)] += 8.0  # one sample late
    assert position_jumps(time, position + pushed, velocity, STEP) == []


def test_a_jump_after_the_last_used_sample_casts_no_doubt() -> None:
    """For example, the horn is knocked while the arm comes to rest; the warning still names the jump."""
    time, position, velocity = swing(200.0, 1.0, 0.0, 4)
    samples = np.zeros(len(time), sample_type(1))
    samples["deadline"], samples["velocity"][:, 0] = time, velocity
    samples["phase"] = np.where(time < 15.0, Phase.PERIODIC, Phase.COMING_TO_REST)
    config: Any = SimpleNamespace(joints=[SimpleNamespace(name="shoulder")])
    facts: Any = SimpleNamespace(position_step=[STEP])
    for at, counts in ((18.0, False), (10.0, True)):
        samples["position"][:, 0] = position + np.where(time > at, 60 * STEP, 0.0)
        assert len(jump_warnings(config, facts, samples)) == 1
        assert bool(jump_disturbances(config, facts, samples)) == counts
