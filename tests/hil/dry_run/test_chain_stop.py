"""A dry run of a spatial arm is only "safe" if a stop would lower the arm to its rest pose."""

import numpy as np

from hil.clearance.space import Nearest
from hil.config.schema import load_config
from hil.dry_run.chain_stop import ChainStops, Fall, LoweringForeseen, _helps
from hil.plan.chain_model import limit_names
from tests.support.paths import CONFIGS

FALL = Fall(0.0, None, 1.0, 0.1, 1.0, np.zeros(3))
HELPS = "Raise its voltage_limit to 7 V if the servo tolerates that"
FREE = Nearest(0.05, 0.01, ("hand", "floor"), 0)


def test_a_lowering_with_room_that_lays_the_arm_down_is_safe() -> None:
    assert ChainStops(FALL, LoweringForeseen(5.0, FREE, 1.0, "knee", 0.02, HELPS)).unsafe == ""


def test_too_little_room_on_the_way_down_is_not() -> None:
    near = Nearest(-0.005, 0.01, ("hand", "floor"), 0)
    assert (
        "hand and floor: -5 mm; at least 10 mm required"
        in ChainStops(FALL, LoweringForeseen(5.0, near, 1.0, "knee", 0.02, HELPS)).unsafe
    )


def test_arms_that_do_not_reach_the_rest_pose_are_not() -> None:
    why = ChainStops(FALL, LoweringForeseen(5.0, FREE, 0.83, "knee", 0.4, HELPS)).unsafe
    assert "83 % of the simulated stops" in why
    assert why.endswith(f"rad away from it. {HELPS}")
    assert "'knee' ends up to 0.4 rad away" in why


def test_the_setting_that_counts_is_named() -> None:
    koch, leg = load_config(CONFIGS / "koch.toml"), load_config(CONFIGS / "leg.toml")
    assert limit_names(leg) == "current_limit"
    assert limit_names(koch).endswith("voltage_limit")


def test_what_helps_depends_on_what_keeps_a_joint_from_the_rest_pose() -> None:
    leg = load_config(CONFIGS / "leg.toml")
    joint, most = leg.joints[1], leg.safety.lower_time
    limit = joint.goal_limit * joint.torque_per_goal
    assert _helps(leg, 1, 0.5 * most, 1.0, 2.0 * limit).startswith(
        f"Raise its current_limit to {2.2 * joint.goal_limit:.2g} A if the servo tolerates that, choose a rest_pose in "
        "which"
    )
    assert "Raise its current_limit, lower safety.lower_speed, " in _helps(leg, 1, 0.9 * most, 1.0, 0.5 * limit)
    assert "Raise its current_limit, raise safety.lower_time, " in _helps(leg, 1, 1.1 * most, 1.0, 0.5 * limit)
    assert f"Raise experiment.rate above {leg.experiment.rate:g}" in _helps(leg, 1, 0.9 * most, 0.4, 0.5 * limit)


def test_an_arm_without_parts_that_could_collide_has_no_clearance_to_state() -> None:
    assert str(Nearest(np.inf, 0.0, ("nothing", "nothing"), 0)) == "no parts that could collide"
    assert str(FREE) == "hand and floor: 50 mm"
