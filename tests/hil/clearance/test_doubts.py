"""Warnings about the pose in which a planar arm is said to rest."""

from pathlib import Path

import pytest

from hil.clearance.doubts import doubts
from hil.config.schema import load_config
from tests.support.paths import CONFIGS


@pytest.mark.parametrize(
    ("pose", "gravity", "named"),
    [
        ("[-1.5707963, 0.0]", 9.81, ""),
        ("[1.5707963, 0.0]", 9.81, ""),  # upright
        ("[-1.3, -0.2]", 9.81, ""),
        ("[-0.8, 0.0]", 9.81, "joint 'shoulder' is 44 degrees"),
        ("[-1.5707963, 0.9]", 9.81, "joint 'elbow' is 52 degrees"),
        ("[-0.8, 0.0]", 0.0, ""),
    ],
)
def test_a_planar_arm_that_cannot_rest_so_by_itself(tmp_path: Path, pose: str, gravity: float, named: str) -> None:
    text = (CONFIGS / "xm430_two_link.toml").read_text(encoding="utf-8")
    for key, value in (("rest_pose", pose), ("gravity", str(gravity))):
        start = text.index(f"\n{key} = ") + 1
        text = text.replace(text[start : text.index("\n", start)], f"{key} = {value}")
    text = text.replace("position_limit = [-3.14, 0.00]", "position_limit = [-3.14, 2.00]")
    path = tmp_path / "arm.toml"
    path.write_text(text, encoding="utf-8")
    said = [each for each in doubts(load_config(path)) if "hanging straight down" in each]
    assert len(said) == bool(named)
    assert named in "".join(said)
