"""Bundled spatial arms: an arm cannot lie, or be led to its path, with one part inside another."""

from pathlib import Path

import numpy as np
import pytest

from hil.clearance.space import Space
from hil.config.schema import load_config
from hil.errors import ConfigError
from hil.plan.chain_plan import check_rest_pose

CONFIGS = Path(__file__).parents[3] / "configs"
SPATIAL = sorted(path.stem for path in CONFIGS.glob("*.toml") if "urdf = " in path.read_text(encoding="utf-8"))
MOST_M = 0.02
"""Largest overlap of capsules, which are larger than the parts they enclose [m]."""


@pytest.mark.parametrize("name", SPATIAL)
def test_the_rest_pose_is_one_in_which_the_arm_can_lie(name: str) -> None:
    config = load_config(CONFIGS / f"{name}.toml")
    assert Space.of(config).nearest(np.array(config.arm.rest_pose)[:, None]).distance > -MOST_M


def test_a_rest_pose_inside_the_floor_is_refused() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    below = config.arm.model_copy(update={"rest_pose": [0.0, 1.2, 0.3, 0.0, 0.3, 0.0]})
    wrong = config.model_copy(update={"arm": below})
    with pytest.raises(ConfigError, match=r"arm.rest_pose puts .* mm into floor"):
        check_rest_pose(wrong)
    check_rest_pose(config)


def test_all_of_them_are_looked_at() -> None:
    assert len(SPATIAL) >= 7
