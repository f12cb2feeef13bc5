"""The noise of the current readings: which readings count, how uncertain it is, and how much of it is refused."""

from collections.abc import Callable, Sequence
from math import nan

import pytest

from hil.config.joint import JointConfig
from hil.config.schema import Config, load_config
from hil.drivers.state import State
from hil.errors import Cause, SafetyStop
from hil.experiment.checks.current_noise import MOST_READINGS, CurrentNoise
from hil.experiment.guard import Guard
from tests.support.motion import STILL, at
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
SIGMA = 1.4826
"""Standard deviation of normal noise, relative to its median absolute deviation."""


def joint(name: str = "xm430_two_link") -> JointConfig:
    return load_config(CONFIGS / f"{name}.toml").joints[0]


def reading(goal: float, carried: float) -> State:
    return State(0.0, 0.0, (goal,), (carried,), (0.0,), (0.0,), (0,), (False,))


def noise_of(
    goals: Sequence[float], errors: Sequence[float], name: str = "xm430_two_link"
) -> tuple[float, float, list[int]]:
    """Noise and its upper bound for these goals and errors, and the number of states after which it was due."""
    measure = CurrentNoise([joint(name)])
    due = [
        number
        for number, (goal, error) in enumerate(zip(goals, errors, strict=True), start=1)
        if measure.add(reading(goal, goal + error))
    ]
    (noise,), (most,) = measure.measured()
    return noise, most, due


def alternating(size: float, count: int) -> list[float]:
    """Errors of this size, back and forth. An even number of readings has its median in the middle."""
    return [size * (-1) ** number for number in range(count)]


def test_the_noise_of_an_arm_that_a_goal_holds_is_that_around_its_goal() -> None:
    """A goal that changes by at most two ticks (5.4 mA) from one exchange to the next, as a stabiliser's does."""
    goals = [0.3 + 0.005 * number for number in range(101)]
    noise, most, due = noise_of(goals, alternating(0.02, 101))
    assert noise == pytest.approx(0.02 * SIGMA) and due == [9, 17, 33, 65], "the first state has no goal before it"
    assert most == pytest.approx((0.02 + 0.5 * 2.69e-3) * SIGMA / (1 - 0.19))


def test_what_is_read_while_the_goal_changes_sign_is_no_noise() -> None:
    assert noise_of(alternating(0.3, 100), alternating(0.02, 100)) == (0.0, 0.0, [])


def test_only_the_latest_readings_count() -> None:
    """Noise that has ended no longer matters, and measuring often enough ends too."""
    noisy, quiet = alternating(0.02, 400), [0.0] * (MOST_READINGS - 6)
    noise, _, due = noise_of([0.0] * (len(noisy) + len(quiet)), [*noisy, *quiet])
    assert noise == 0.0 and due == [9, 17, 33, 65, 129]


@pytest.mark.parametrize(("name", "tick"), [("xm430_two_link", 2.69e-3), ("xl430_two_link", 12.0 / 885)])
@pytest.mark.parametrize(("spread", "is_seen"), [(0.2, False), (0.3, True)])
def test_noise_that_rounding_may_hide_is_below_two_ticks(name: str, tick: float, spread: float, is_seen: bool) -> None:
    """The eight readings that are needed at least say little; 200 are more certain than two ticks."""
    noise, most, _ = noise_of([0.0] * 9, alternating(spread * tick, 9), name)
    uncertain = (spread + 0.5) * tick * SIGMA / (1 - 1.9 / 8**0.5)
    assert noise < most == pytest.approx(uncertain if is_seen else 2.0 * tick, rel=1e-3)
    many, least, _ = noise_of([0.0] * 201, alternating(spread * tick, 201), name)
    assert many < least == pytest.approx((spread + 0.5) * tick * SIGMA / (1 - 1.9 / 200**0.5), rel=1e-3)


def at_rest(guard: Guard, error: float) -> list[str]:
    """What the guard says about an arm at rest whose second joint's current is off by this much, back and forth."""
    guard.rests_at(STILL.position)
    for number, carried in enumerate(alternating(error, 201)):
        state = at(number, STILL._replace(current=(0.0, carried)))
        guard.look(state)
        guard.measure_noise(state)
    return guard.noise_is_known()


@pytest.mark.parametrize("limit", [0.8, 0.4])
@pytest.mark.parametrize(("share", "is_refused"), [(0.24, False), (0.26, True)])
def test_noise_of_a_quarter_of_the_current_limit_is_refused(
    arm: Arm, limit: float, share: float, is_refused: bool
) -> None:
    config = arm(("current_limit = 0.8", f"current_limit = {limit}"), ("0.80, 0.42", "0.80, 0.1"))
    error = share * limit / SIGMA
    if is_refused:
        with pytest.raises(SafetyStop, match=rf"ID 2.*At most {limit / 4:g} A RMS.* of current_limit") as stop:
            at_rest(Guard(config), error)
        assert stop.value.cause is Cause.NOT_FOLLOWING
    else:
        (said,) = at_rest(Guard(config), error)
        assert "ID 2" in said and "current reading is noisy" in said


def test_noise_is_zero_until_it_has_been_measured(arm: Arm) -> None:
    """It is passed on to the guards of the same arm that follow, which need not measure it again."""
    guard = Guard(arm())
    assert list(guard.current_noise) == [0.0, 0.0]
    at_rest(guard, 0.03)
    assert guard.current_noise[1] == pytest.approx((0.03 + 0.5 * 2.69e-3) * SIGMA / (1 - 1.9 / 200**0.5))
    assert list(Guard(arm(), noise=guard.current_noise).current_noise) == list(guard.current_noise)
    assert list(Guard(arm()).current_noise) == [0.0, 0.0]


def test_a_missing_reply_is_no_reading() -> None:
    measure = CurrentNoise([joint()])
    for _ in range(40):
        assert not measure.add(reading(0.0, nan)._replace(missing=(True,)))
    assert measure.measured() == ([0.0], [0.0])
