"""Where a spatial arm lies, and what is said of it."""

import math

import pytest

from hil.config.schema import Config, load_config
from hil.setup.lying import from_where_it_lies, said_of_the_rest
from tests.support.paths import CONFIGS


@pytest.fixture
def leg() -> Config:
    """Its joints rest at 0; the knee's lower limit is at 0, where it lies on a stop."""
    config = load_config(CONFIGS / "leg.toml")
    knee = config.joints[2].model_copy(update={"position_limit": (0.0, 2.2)})
    return config.model_copy(update={"joints": [*config.joints[:2], knee]})


def test_only_joints_that_lie_elsewhere_are_named(leg: Config) -> None:
    lies = from_where_it_lies(leg, (0.004, -0.1, 0.0))
    assert lies.arm.rest_pose == [0.004, -0.1, 0.0]
    assert said_of_the_rest(leg, lies).startswith("The arm does not lie in arm.rest_pose: 'hip_pitch' at -0.100 rad (-")


def test_a_joint_just_beyond_the_limit_at_which_it_rests_makes_no_difference(leg: Config) -> None:
    assert from_where_it_lies(leg, (0.0, 0.0, -0.05)) is leg


def test_a_joint_that_is_read_a_turn_away_lies_where_it_can(leg: Config) -> None:
    lies = from_where_it_lies(leg, (0.0, 0.0, 0.1 - math.tau))
    assert lies.arm.rest_pose[2] == pytest.approx(0.1)


def test_an_arm_too_far_away_is_left_to_the_check_of_the_pose(leg: Config) -> None:
    assert from_where_it_lies(leg, (0.0, 1.0, 0.1)) is leg
