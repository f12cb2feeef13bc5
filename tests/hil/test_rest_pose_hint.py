"""A joint that is not at rest where the configuration says: the hint names what is most likely wrong."""

import math

import pytest

from hil.rest_pose_hint import rest_pose_hint, within_limits


def test_a_wrong_direction_is_recognised_by_its_mirror_image() -> None:
    said = rest_pose_hint(1.55, -1.57, 0.1, 3072)
    assert said.index("it may have fallen since an earlier run") < said.index(
        "If this is the first run, check `direction`"
    )
    assert "leave them as they are" in said


def test_otherwise_the_arm_is_moved_first_and_the_zero_set_only_at_rest() -> None:
    said = rest_pose_hint(0.4, -1.57, 0.1, 3330)
    assert said.startswith("Move it there by hand")
    assert "direction or id" in said and "Only if it is in its rest pose now, set zero_ticks = 3330." in said


def test_a_joint_that_fell_is_shown_where_it_can_be() -> None:
    """The angle closest to the rest pose (-0.9 rad) would be -3.68 rad, far outside the limits."""
    assert within_limits(2.6 - math.tau, (-1.0, 2.8)) == pytest.approx(2.6)
    assert within_limits(2.6 - 3 * math.tau, (-1.0, 2.8)) == pytest.approx(2.6), "any number of turns"
    assert within_limits(-3.68, (-1.0, 1.0)) == pytest.approx(math.tau - 3.68), "none is within: the nearest"
    assert within_limits(0.5, (-7.0, 7.0)) == 0.5
