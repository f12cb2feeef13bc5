"""What the watch of a spatial arm judges, and what it does not."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.dry_run.chain_prior import prior_arms
from hil.errors import SafetyStop
from hil.experiment.chain_watch import ChainWatch
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(CONFIGS / "leg.toml")


def look(config: Config, watch: ChainWatch, position: tuple[float, ...], goal: tuple[float, ...], number: int) -> None:
    at = number / config.experiment.rate
    n = len(position)
    state: Any = SimpleNamespace(
        missing=(False,) * n, goal_current=goal, position=position, velocity=(0.0,) * n, time_before_write=at
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


def test_but_it_is_if_a_torque_away_from_that_stop_does_not_move_it(config: Config) -> None:
    with pytest.raises(SafetyStop, match="stands still, with "):
        stands(config, 0.02, 2.0)


def test_a_joint_that_has_been_on_both_sides_of_its_rest_angle_has_no_stop_there(config: Config) -> None:
    with pytest.raises(SafetyStop, match="stands still, with "):
        stands(config, 0.02, -0.9, was_below=True)


def test_one_that_never_left_it_is(config: Config) -> None:
    """It is blocked from the start, or its encoder is frozen."""
    with pytest.raises(SafetyStop, match="stands still, with "):
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
    with pytest.raises(SafetyStop, match=r"joint3.* stands still, with -"):
        falling(-2.0)


def test_the_same_joint_elsewhere_is(config: Config) -> None:
    with pytest.raises(SafetyStop, match="stands still, with "):
        stands(config, 0.5, -0.9)


def test_nor_does_it_keep_others_from_being_judged(config: Config) -> None:
    watch = ChainWatch(config, [1.0, 1.0, 1.0])
    rest = config.arm.rest_pose
    with pytest.raises(SafetyStop, match="hip_roll"):
        for number in range(200):
            look(config, watch, (rest[0] + 0.5, rest[1] + 0.3, rest[2]), (1.0, 0.0, 0.0), number)
