"""Two servos on one joint whose readings contradict their directions are found before torque is on."""

from pathlib import Path
from typing import Any

import pytest

from hil.api.experiment import record
from hil.config.schema import load_config
from hil.drivers.errors import WrongSetting
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from tests.support.edits import replaced, with_second_servo

ZERO = 3072
"""The first servo's zero_ticks; its joint rests at -1.57 rad."""


def pair(arm_file: Any, zero_ticks: int, directions: str) -> Path:
    path: Path = arm_file(("ramp = 1.0 ", "held_out = false\nsettle_within = 0.5\nramp = 0.2 "))
    text = with_second_servo(path.read_text(encoding="utf-8"), zero_ticks)
    path.write_text(replaced(text, ("direction = [1, -1]", f"direction = {directions}")), encoding="utf-8")
    return path


def stops(path: Path) -> list[str]:
    return [each.fix for each in check_arm(load_config(path)) if each.level is Level.STOP and each.what == "direction"]


def test_a_pair_that_reads_as_mirror_images_is_refused(arm_file: Any, tmp_path: Path) -> None:
    path = pair(arm_file, ZERO + 40, "[1, 1]")
    with pytest.raises(WrongSetting, match=r"'shoulder' \(IDs 1 and 3.*set direction = \[1, -1\]") as refused:
        record(path, out=tmp_path / "run")
    assert not refused.value.after_torque and "zero_ticks = 3072" in str(refused.value)
    assert stops(path) == [str(refused.value)]


@pytest.mark.parametrize(("zero_ticks", "directions"), [(ZERO, "[1, -1]"), (1000, "[1, -1]"), (1000, "[1, 1]")])
def test_a_pair_whose_second_horn_is_mounted_at_any_other_angle_is_not(
    arm_file: Any, zero_ticks: int, directions: str
) -> None:
    assert stops(pair(arm_file, zero_ticks, directions)) == []
