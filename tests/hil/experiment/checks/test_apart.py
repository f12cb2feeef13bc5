"""Two servos on one joint that no longer turn together."""

from pathlib import Path

import pytest

import hil
from hil.drivers.joint import Joint, SecondServo
from hil.drivers.servo_model import servo_model
from hil.errors import Cause, SafetyStop
from hil.experiment.checks.apart import ALLOWED_RAD, Apart, causes_of_standstill
from tests.support.edits import QUICK, replaced
from tests.support.paths import CONFIGS


def test_only_a_change_of_the_difference_counts() -> None:
    apart = Apart()
    assert apart.look([(), (1.2, -0.4)]) is None
    assert apart.look([(), (1.2 + 0.9 * ALLOWED_RAD, float("nan"))]) is None
    assert apart.look([(), (1.2, -0.4 - 1.1 * ALLOWED_RAD)]) == (1, 1, pytest.approx(-1.1 * ALLOWED_RAD))


def test_two_servos_that_stand_still_may_work_against_each_other() -> None:
    one = Joint("hip", 2, servo_model("XM430-W350"))
    two = Joint("hip", 2, servo_model("XM430-W350"), seconds=(SecondServo(7, 1),))
    assert "against" not in causes_of_standstill(one)
    assert "work against each other: is one entry of direction = [1, 1] wrong?" in causes_of_standstill(two)


@pytest.mark.parametrize("slips", [True, False])
def test_a_horn_that_slips_stops_the_arm_by_name(tmp_path: Path, slips: bool) -> None:
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    joints, fake = text.split("[fake]", 1)
    joints = joints.replace("id = 1\n", "id = [1, 3]\n", 1)
    joints = joints.replace("direction = 1 ", "direction = [1, -1] #", 1)
    joints = replaced(joints, ("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]"), *QUICK)
    shadow = '[[fake.servos]]\nid = 3\nmodel = "XM430-W350"\njoint = 1\ndirection = -1\nzero_ticks = 1000\n'
    fault = '[[fake.faults]]\nkind = "encoder_jump"\nservo = 3\nat = 3.0\namount = 150\n' if slips else ""
    arm = tmp_path / "arm.toml"
    arm.write_text(f"{joints}[fake]{fake}\n{shadow}{fault}", encoding="utf-8")
    if not slips:
        hil.record(arm, out=tmp_path / "run")
        return
    with pytest.raises(SafetyStop, match=r"ID 3 has turned .0\.\d+ rad relative to the first") as stopped:
        hil.record(arm, out=tmp_path / "run")
    assert stopped.value.cause is Cause.APART
