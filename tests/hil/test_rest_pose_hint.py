"""A joint that is not at rest where the configuration says: the hint names what is most likely wrong."""

from hil.rest_pose_hint import rest_pose_hint


def test_a_wrong_direction_is_recognised_by_its_mirror_image() -> None:
    assert "check direction first" in rest_pose_hint(1.55, -1.57, 0.1, 3072)


def test_otherwise_the_arm_is_moved_first_and_the_zero_set_only_at_rest() -> None:
    said = rest_pose_hint(0.4, -1.57, 0.1, 3330)
    assert said.startswith("Move it there by hand")
    assert "direction or id" in said and "Only if it is in its rest pose now, set zero_ticks = 3330." in said
