"""A dry run of a spatial arm is only "safe" if a stop would lower the arm to its rest pose."""

import numpy as np

from hil.clearance.space import Nearest
from hil.config.schema import load_config
from hil.dry_run.chain_stop import ChainStops, Fall, LoweringForeseen, _slower
from hil.plan.chain_model import limit_names
from tests.support.paths import CONFIGS

FALL = Fall(0.0, None, 1.0, 0.1, 1.0, np.zeros(3))
SETTINGS = "voltage_limit", "lower safety.lower_speed"
FREE = Nearest(0.05, 0.01, ("hand", "floor"), 0)


def test_a_lowering_with_room_that_lays_the_arm_down_is_safe() -> None:
    assert ChainStops(FALL, LoweringForeseen(5.0, FREE, 1.0, "knee", 0.02, *SETTINGS)).unsafe == ""


def test_too_little_room_on_the_way_down_is_not() -> None:
    near = Nearest(-0.005, 0.01, ("hand", "floor"), 0)
    assert (
        "hand and floor: -5 mm, at least 10 mm"
        in ChainStops(FALL, LoweringForeseen(5.0, near, 1.0, "knee", 0.02, *SETTINGS)).unsafe
    )


def test_arms_that_do_not_reach_the_rest_pose_are_not() -> None:
    why = ChainStops(FALL, LoweringForeseen(5.0, FREE, 0.83, "knee", 0.4, *SETTINGS)).unsafe
    assert "83 % of the simulated stops" in why
    assert "Raise its voltage_limit, lower safety.lower_speed, choose a rest_pose" in why
    assert "'knee' ends up to 0.4 rad away" in why


def test_the_setting_that_counts_is_named() -> None:
    koch, leg = load_config(CONFIGS / "koch.toml"), load_config(CONFIGS / "leg.toml")
    assert limit_names(leg) == "current_limit"
    assert limit_names(koch).endswith("voltage_limit")
    assert _slower(leg, 0.9 * leg.safety.lower_time) == "lower safety.lower_speed"
    assert _slower(leg, 1.1 * leg.safety.lower_time) == "raise safety.lower_time"
