"""Checks of the motor current: how fast lost torque is detected, and what healthy motors may do."""

import math
from collections.abc import Callable
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.config.joint import JointConfig
from hil.config.schema import Config, load_config
from hil.experiment.following import Following
from tests.support.paths import CONFIGS

RATES = (20, 100, 400, 1000)
REAL = ("xm430_two_link", "xl330_two_link", "xm540_two_link", "xl430_two_link")


def joints(name: str) -> list[tuple[JointConfig, float]]:
    config: Config = load_config(CONFIGS / f"{name}.toml")
    assert config.experiment.peak_torque is not None
    return [(j, peak / j.torque_per_goal) for j, peak in zip(config.joints, config.experiment.peak_torque, strict=True)]


def seen_after(
    follow: Following, rate: int, goal: Callable[[float], float], carried: Callable[[float, float], float]
) -> float:
    """Time of detection [s]; infinite if nothing is detected within ten seconds."""
    for index in range(10 * rate):
        now = index / rate
        if follow.look(goal(now), carried(goal(now), now), 1 / rate) is not None:
            return now
    return math.inf


@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("joint", [0, 1])
def test_lost_torque_is_seen_within_a_tenth_of_a_second_of_a_current_worth_speaking_of(
    name: str, rate: int, joint: int
) -> None:
    """The plans use a quarter and an eighth of current_limit in the configurations of real arms."""
    config, planned = joints(name)[joint]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, rate, lambda _: 0.5 * planned, lambda goal, now: 0.0) <= 0.1


@pytest.mark.parametrize("rate", RATES)
@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), noise=st.floats(0.0, 0.05), gain=st.floats(0.8, 1.2), lag=st.floats(0.0, 3e-3))
def test_a_healthy_motor_is_never_stopped(rate: int, seed: int, noise: float, gain: float, lag: float) -> None:
    """Noise relative to the planned peak, a sensor error of 20 %, a lagging current loop; multisines up to 5 Hz."""
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    random = Random(seed)
    waves = [(random.uniform(0.1, min(5.0, rate / 4.1)), random.uniform(0, math.tau)) for _ in range(8)]

    def goal(now: float) -> float:
        held = math.floor(now * rate + 1e-9) / rate
        return planned / 4 * sum(math.sin(math.tau * f * held + phase) for f, phase in waves)

    def carried(_: float, now: float) -> float:
        # Measured right after the write: mostly the previous goal, and hardly any of the newest one.
        former = goal(now - 1 / rate) if now > 0 else 0.0
        share = 1.0 if lag < 1e-6 else 1.0 - math.exp(-0.2e-3 / lag)
        return gain * (former + share * (goal(now) - former)) + random.gauss(0.0, noise * planned)

    assert seen_after(follow, rate, goal, carried) == math.inf


def test_zero_current_under_zero_goals_says_nothing() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: 0.0, lambda goal, now: 0.001) == math.inf


def test_a_current_that_is_too_large_is_seen_after_follow_time() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: planned, lambda goal, now: 1.5 * goal) == pytest.approx(0.05, abs=0.006)


def test_one_wrong_reply_in_between_is_forgiven() -> None:
    config, planned = joints("xm430_two_link")[0]
    follow = Following(config, planned, 0.3, 0.05)
    assert seen_after(follow, 400, lambda _: planned, lambda goal, now: 0.0 if now % 0.02 < 0.007 else goal) == math.inf
