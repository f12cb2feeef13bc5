"""Where a spatial arm lies, and what is said of it."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest

from hil import fakes
from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.fakes.protocol_fake import FakeSerial
from hil.setup.lying import from_where_it_lies, moved_without_torque, said_of_the_rest
from tests.support.paths import CONFIGS


@pytest.fixture
def leg() -> Config:
    """Its joints rest at 0; the knee's lower limit is at 0, where it lies on a stop."""
    config = load_config(CONFIGS / "leg.toml")
    knee = config.joints[2].model_copy(update={"position_limit": (0.0, 2.2)})
    arm = config.arm.model_copy(update={"rest_pose": [0.0, 0.0, 0.0]})
    return config.model_copy(update={"joints": [*config.joints[:2], knee], "arm": arm})


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


def said_after_torque_off(config: Config, before: Sequence[float] | None = None) -> str:
    """What is said of an arm that is let go in its rest pose; before: where it seemed to be then."""
    fakes.register_for(config.url)
    with ServoBus.connect(config.bus) as bus:
        return moved_without_torque(config, bus, config.arm.rest_pose if before is None else before)


@pytest.mark.parametrize("name", ["koch", "leg", "open_manipulator_x", "viperx_300", "wx250s"])
def test_each_ready_arm_stays_in_its_rest_pose_without_torque(name: str) -> None:
    assert said_after_torque_off(load_config(CONFIGS / f"{name}.toml")) == ""


def test_an_arm_that_moves_once_torque_is_off_is_told_its_rest_pose(tmp_path: Path) -> None:
    text = (CONFIGS / "leg.toml").read_text(encoding="utf-8").replace("[-0.24, 0.0, 0.0]", "[0.0, 0.0, 0.0]")
    (tmp_path / "leg.urdf").write_bytes((CONFIGS / "leg.urdf").read_bytes())
    (tmp_path / "leg.toml").write_text(text, encoding="utf-8")
    config = load_config(tmp_path / "leg.toml")
    said = said_after_torque_off(config)
    assert said.startswith("Once torque was off, the arm moved: 'hip_roll' by -0.15 rad. It does not stay in its rest")
    assert "set arm.rest_pose = [-0.15, 0.00, 0.00]; otherwise" in said
    assert said_after_torque_off(config, (0.0, 0.5, 0.0)) == "", "it fell from elsewhere, which is no surprise"


def test_servos_that_do_not_answer_after_torque_off_say_nothing(leg: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    fakes.register_for(leg.url)
    with ServoBus.connect(leg.bus) as bus:
        monkeypatch.setattr(FakeSerial, "write", lambda _, data: len(data))
        assert moved_without_torque(leg, bus, leg.arm.rest_pose) == ""
