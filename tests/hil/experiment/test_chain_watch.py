"""What the watch of a spatial arm judges, and what it does not."""

import math
import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.dry_run.chain_prior import prior_arms
from hil.errors import Cause, SafetyStop
from hil.experiment import chain_watch
from hil.experiment.chain_watch import ChainWatch
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(CONFIGS / "leg.toml")


def look(
    config: Config,
    watch: ChainWatch,
    position: tuple[float, ...],
    goal: tuple[float, ...],
    number: int,
    knee: float = 0.0,
) -> None:
    """One sample. knee: velocity of the knee; the other joints stand still."""
    at = number / config.experiment.rate
    n = len(position)
    velocity = (*(0.0,) * (n - 1), knee)
    state: Any = SimpleNamespace(
        missing=(False,) * n, goal_current=goal, position=position, velocity=velocity, time_before_write=at
    )
    watch.look(state)


def stands(config: Config, knee: float, current: float, *, was_away: bool = True, was_below: bool = False) -> None:
    """The knee stands still under this current for half a second, while the hip is away from the rest pose."""
    watch = ChainWatch(config, [1.0, 1.0, 1.0])
    rest = np.array(config.arm.rest_pose)
    if was_away:
        look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + 0.5), (0.0, 0.0, 0.0), -100)
    if was_below:
        look(config, watch, (rest[0] + 0.3, rest[1], rest[2] - 0.2), (0.0, 0.0, 0.0), -50)
    for number in range(200):
        look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + knee), (0.0, 0.0, current), number)


def test_a_joint_on_the_stop_on_which_it_rests_is_not_blocked(config: Config) -> None:
    """The others are still on their way home."""
    stands(config, 0.02, -0.9)


@pytest.mark.parametrize("at", [0.02, 0.2])
def test_a_joint_that_comes_back_fast_may_bounce_off_that_stop(config: Config, at: float) -> None:
    """On the way back from a path at 50 Hz, an arm of another hand hit its stop at 0.8 rad/s and was stopped for it."""
    watch, supports = ChainWatch(config, [1.0, 1.0, 1.0]), []
    watch._observer = cast("Any", SimpleNamespace(observe=lambda *given: supports.append(given[-1]) or -1))
    rest = np.array(config.arm.rest_pose)
    look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + 0.5), (0.0, 0.0, 0.0), -100, -0.8)
    for number in range(round(0.3 * config.experiment.rate)):
        velocity = (-0.8, -0.2, 0.3)[number] if number < 3 else 0.1  # the impact is seen in two samples
        look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + at), (0.0, 0.0, 0.0), number, velocity)
    blocked = [support is not None and support[2] == -1.0 for support in supports]
    assert blocked[2:4] == [at < 0.1] * 2 and not blocked[-1]


@pytest.mark.parametrize(
    ("speeds", "may_be_stop"),
    [
        ((-0.3, -0.5, -0.7), [False, False, False]),  # an end stop does not speed a joint up
        ((-0.8, -0.2, 0.39), [False, True, True]),
        ((-0.8, -0.2, 0.41), [False, True, False]),  # nor does it return more than half of the speed
        ((-0.2, -0.8, -0.3, 0.39), [False, False, True, True]),
        ((-0.8, 0.39, 0.3), [False, True, True]),
    ],
)
def test_an_end_stop_slows_a_joint_down_and_returns_at_most_half_of_its_speed(
    config: Config, speeds: tuple[float, ...], may_be_stop: list[bool]
) -> None:
    watch, supports = ChainWatch(config, [1.0, 1.0, 1.0]), []
    watch._observer = cast("Any", SimpleNamespace(observe=lambda *given: supports.append(given[-1]) or -1))
    rest = np.array(config.arm.rest_pose)
    look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + 0.5), (0.0, 0.0, 0.0), -100, speeds[0])
    supports.clear()
    for number, speed in enumerate(speeds):
        look(config, watch, (rest[0] + 0.3, rest[1], rest[2] + 0.02), (0.0, 0.0, 0.0), number, speed)
    assert [support[2] == -1.0 for support in supports] == may_be_stop


def test_but_it_is_if_a_torque_away_from_that_stop_does_not_move_it(config: Config) -> None:
    with pytest.raises(SafetyStop, match="is not moving, with "):
        stands(config, 0.02, 2.0)


def test_a_joint_that_has_been_on_both_sides_of_its_rest_angle_has_no_stop_there(config: Config) -> None:
    with pytest.raises(SafetyStop, match="is not moving, with "):
        stands(config, 0.02, -0.9, was_below=True)


def test_one_that_never_left_it_is(config: Config) -> None:
    """It is blocked from the start, or its encoder is frozen."""
    with pytest.raises(SafetyStop, match="is not moving, with "):
        stands(config, 0.02, -2.0, was_away=False)


def falling(goal: float) -> None:
    """A joint of a well-known arm lies on its stop under this current, while joint 1 is away from its rest angle."""
    config = load_config(CONFIGS / "fake_open_manipulator_x.toml")
    arms = prior_arms(config, known_chain(config), 24)
    watch = ChainWatch(config, [0.1] * 4, replace(arms, rigid=0.0 * arms.rigid + 3.0 * arms.rigid.mean(axis=0)))
    rest = np.array(config.arm.rest_pose)
    for number in range(200):
        look(config, watch, (rest[0] + 0.3, *rest[1:]), (0.0, 0.0, goal, 0.0), number)


def test_one_that_never_left_its_stop_is_not_blocked_while_nothing_is_commanded() -> None:
    falling(0.0)


def test_but_it_is_if_it_cannot_be_lifted_from_it() -> None:
    with pytest.raises(SafetyStop, match=r"joint3.* is not moving, with -"):
        falling(-2.0)


def test_the_same_joint_elsewhere_is(config: Config) -> None:
    with pytest.raises(SafetyStop, match="is not moving, with "):
        stands(config, 0.5, -0.9)


def test_nor_does_it_keep_others_from_being_judged(config: Config) -> None:
    watch = ChainWatch(config, [1.0, 1.0, 1.0])
    rest = config.arm.rest_pose
    with pytest.raises(SafetyStop, match="hip_roll"):
        for number in range(200):
            look(config, watch, (rest[0] + 0.5, rest[1] + 0.3, rest[2]), (1.0, 0.0, 0.0), number)


class Observer:
    """Records what the watch passes on, and reports the joint `found`."""

    def __init__(self, *given: Any) -> None:
        self.given = given
        self.found = -1
        self.lacking = [0.25, 0.0, 0.0]
        self.seen: Any = None

    def observe(self, position: Any, velocity: Any, torque: Any, seconds: float, is_free: bool, support: Any) -> int:
        self.seen = SimpleNamespace(torque=list(torque), seconds=seconds, is_free=is_free, support=support)
        return self.found


def arms(drive: Any, rigid: Any) -> Any:
    names = ["mass_1", "inertia_2", "moment_2"]
    base = SimpleNamespace(names=names, count=3, regressor=lambda angle, *_: np.zeros((len(angle), 1, 3)))
    return SimpleNamespace(drive=np.array(drive), rigid=np.array(rigid), size=len(rigid), base=base)


#                viscous     dry friction  offset      -           scale of the commanded torque
ONE = arms([[[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [9.0, 9.0], [2.0, 4.0]]], [[1.0, 2.0, 3.0]])
TWO = arms([*ONE.drive, *ONE.drive], [[1.0, 2.0, 3.0], [1.4, 2.0, 3.0]])


def test_parameters_are_in_units_of_the_commanded_torque() -> None:
    (told,) = chain_watch.linear_parameters(ONE)
    assert told.tolist() == pytest.approx([0.5, 0.5, 0.75, 0.05, 0.05, 0.15, 0.1, 0.25, 0.15])


def test_the_prior_is_the_ensemble_widened() -> None:
    """Widened by half as much again, 5 % of each value, and half of the dry friction for the offset."""
    mean, covariance = chain_watch.observed_parameters(TWO)
    assert mean.tolist() == pytest.approx([0.6, 0.5, 0.75, 0.05, 0.05, 0.15, 0.1, 0.25, 0.15])
    wanted = (0.05 * mean) ** 2
    wanted[0] += 1.5**2 * 0.02  # the variance of 0.5 and 0.7
    wanted[7:] += np.array([0.075, 0.05]) ** 2
    assert np.allclose(covariance, np.diag(wanted), rtol=1e-6, atol=1e-11)
    nothing = arms(np.tile([[[0.0], [0.0], [0.0], [0.0], [1.0]]], (2, 1, 2)), np.zeros((2, 3)))
    assert chain_watch.observed_parameters(nothing)[1] == pytest.approx(1e-12 * np.eye(9), rel=1e-9, abs=1e-15)


@pytest.fixture
def watch(config: Config, monkeypatch: pytest.MonkeyPatch) -> ChainWatch:
    monkeypatch.setattr(chain_watch, "ChainObserver", Observer)
    return ChainWatch(config, [0.5, 1.0, 2.0], cast(Any, TWO))


def sees(config: Config, watch: ChainWatch, at: float, **changed: Any) -> Any:
    """What the observer is given for a sample at this time [s]; angles are relative to the rest pose."""
    away = np.array(changed.pop("away", (0.0, 0.0, 0.0)))
    said = {
        "missing": (False,) * 3,
        "goal_current": (0.0,) * 3,
        "position": tuple(np.array(config.arm.rest_pose) + away),
        "velocity": (0.0,) * 3,
        **changed,
    }
    watch.look(cast(Any, SimpleNamespace(time_before_write=at, **said)))
    return cast(Any, watch._observer).seen


def test_the_observer_is_given_the_planned_torque_and_the_interval(config: Config, watch: ChainWatch) -> None:
    base, mean, covariance, largest, interval, frictions = cast(Any, watch._observer).given
    constants = [joint.torque_per_goal for joint in config.joints]
    assert base is TWO.base and len(mean) == len(covariance) == 9
    assert list(largest) == pytest.approx(np.array(constants) * [0.5, 1.0, 2.0])
    assert interval == 1 / config.experiment.rate and frictions == 8.0
    given = ChainWatch(config, [0.5, 1.0, 2.0], cast(Any, TWO), 0.007)
    assert cast(Any, given._observer).given[4] == 0.007


def test_what_explains_the_lack_of_torque_is_asked_first(config: Config, watch: ChainWatch) -> None:
    asked: list[Any] = []
    watch._explain = lambda *given: asked.append(given)
    sees(config, watch, 1.0)
    watch._observer.found = 0  # type: ignore[attr-defined]
    with pytest.raises(SafetyStop, match="does not move like any arm"):
        sees(config, watch, 1.5, velocity=(1.0, 0.0, 0.0))
    (joint, lacking, recent), *_ = asked
    assert (joint, lacking, [each.time_before_write for each in recent]) == (0, 0.25, [1.0, 1.5])


def test_each_sample_is_judged_by_the_goal_before_it(config: Config, watch: ChainWatch) -> None:
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    seen = sees(config, watch, 1.0, goal_current=(0.1, 0.2, 0.3))
    assert seen.seconds == np.inf and seen.torque == pytest.approx(constants * (0.1, 0.2, 0.3))
    seen = sees(config, watch, 1.5, goal_current=(0.4, 0.5, 0.6))
    assert seen.seconds == 0.5 and seen.torque == pytest.approx(constants * (0.1, 0.2, 0.3))
    assert sees(config, watch, 1.7, missing=(False, True, False)) is seen, "not judged"
    seen = sees(config, watch, 2.0)
    assert seen.seconds == 0.5 and seen.torque == pytest.approx(constants * (0.4, 0.5, 0.6))


def test_an_arm_in_its_rest_pose_may_be_supported(config: Config, watch: ChainWatch) -> None:
    assert not sees(config, watch, 0.0, away=(0.079, -0.079, 0.0)).is_free
    for away in ((0.0, 0.081, 0.0), (0.0, 0.0, -0.081)):
        assert sees(config, watch, 0.0, away=away).is_free


def test_the_stop_of_a_joint_lies_where_it_has_not_been(config: Config, watch: ChainWatch) -> None:
    seen = sees(config, watch, 0.0, away=(0.081, -0.081, 0.3))
    assert seen.is_free and seen.support is None, "none is at home"
    home = {"away": (0.07, -0.07, 0.3), "velocity": (0.06, -0.06, 0.0)}
    assert sees(config, watch, 0.1, **home).support.tolist() == [-1.0, 1.0, 0.0]
    moving = {"away": (0.0, 0.0, 0.3), "velocity": (0.061, -0.061, 0.0)}
    assert sees(config, watch, 0.2, **moving).support.tolist() == [0.0, 0.0, 0.0]
    sees(config, watch, 0.3, away=(-0.1, 0.0, 0.3))
    assert sees(config, watch, 0.4, **home).support.tolist() == [0.0, 1.0, 0.0], "the first has been on both sides"


def test_a_joint_that_gravity_does_not_pull_rests_on_no_stop(config: Config, watch: ChainWatch) -> None:
    assert sees(config, watch, 0.0, away=(0.0, 0.0, 0.3)).support.tolist() == [0.0, 0.0, 0.0]


def test_what_is_said_of_a_joint_at_rest_and_of_one_that_moves(config: Config, watch: ChainWatch) -> None:
    constant = config.joints[0].torque_per_goal
    interval = 1 / config.experiment.rate
    steps = math.ceil(0.3 / interval)
    for number in range(steps + 20):  # the goal of sample n is judged, and stored, with sample n + 1
        sees(config, watch, interval * number, goal_current=(0.01 * number, 0.0, 0.0))
    cast(Any, watch._observer).found = 0
    last = steps + 20
    with pytest.raises(SafetyStop, match="is not moving, with ") as stop:
        sees(config, watch, interval * last, velocity=(0.059, 0.0, 0.0))
    least, most = 0.01 * (last - steps) * constant, 0.01 * (last - 1) * constant
    assert f"with {least:+.3f} to {most:+.3f} N m" in str(stop.value) and stop.value.cause is Cause.UNEXPECTED
    described, hardware = str(stop.value).split(" Otherwise, ")
    assert "direction, zero_ticks or axis" in described and "end stop on which it rests" in described
    assert hardware.startswith("something is blocking it") and "encoder is frozen" in hardware
    with pytest.raises(SafetyStop, match=r"does not move like any arm .*: \+0\.250 N m"):
        sees(config, watch, interval * (last + 1), velocity=(-0.06, 0.0, 0.0))


@pytest.mark.parametrize(("away", "may_be"), [(0.07, True), (0.1, False), (-0.1, False)])
def test_a_wrong_direction_presses_only_a_joint_against_its_stop_that_has_not_left_it(
    config: Config, watch: ChainWatch, away: float, may_be: bool
) -> None:
    interval = 1 / config.experiment.rate
    sees(config, watch, 0.0, away=(away, 0.0, 0.0))
    for number in range(1, math.ceil(0.3 / interval) + 5):
        sees(config, watch, interval * number, goal_current=(0.01 * number, 0.0, 0.0))
    cast(Any, watch._observer).found = 0
    with pytest.raises(SafetyStop, match="is not moving, with ") as stop:
        sees(config, watch, interval * (number + 1))
    assert ("end stop on which it rests" in str(stop.value)) is may_be


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_once_the_arm_has_moved_as_described_the_description_is_doubted_last(
    config: Config, monkeypatch: pytest.MonkeyPatch, speed: float
) -> None:
    monkeypatch.setattr(chain_watch, "ChainObserver", Observer)
    watch = ChainWatch(config, [0.5, 1.0, 2.0], cast(Any, TWO), has_moved=True)
    interval = 1 / config.experiment.rate
    for number in range(math.ceil(0.3 / interval) + 5):
        sees(config, watch, interval * number, goal_current=(0.01 * number, 0.0, 0.0))
    cast(Any, watch._observer).found = 0
    with pytest.raises(SafetyStop) as stop:
        sees(config, watch, interval * (number + 1), velocity=(speed, 0.0, 0.0))
    hardware, described = str(stop.value).split(" If none of this applies: ")
    assert "the arm may not be the one described" in described and "described" not in hardware.split("moving: ")[-1]
    assert re.search("something is (blocking it|pushing or holding it)", hardware, re.IGNORECASE)


def test_a_joint_bounces_off_its_stop_for_a_moment_only(config: Config, watch: ChainWatch) -> None:
    """It has come from below; the recoil of the impact at 0.02 s is over after 50 ms, even if it gets faster."""
    sees(config, watch, 0.0, away=(-0.1, 0.0, 0.3))
    bounces = []
    for at, velocity in ((0.01, 1.0), (0.02, -0.4), (0.05, -0.41), (0.08, -0.42)):
        seen = sees(config, watch, at, away=(-0.05, 0.0, 0.3), velocity=(velocity, 0.0, 0.0))
        bounces.append(seen.support[0])
    assert bounces == [0.0, 1.0, 1.0, 0.0]
