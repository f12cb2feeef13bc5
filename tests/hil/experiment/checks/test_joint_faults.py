"""How a joint's fault is explained: the supply, altered goals, or torque that is off."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.config.schema import Config, load_config
from hil.drivers.state import State, Status
from hil.errors import Cause, SafetyStop
from hil.experiment.guard import Guard
from tests.support.motion import STILL, at
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
LACKING = STILL._replace(goal_current=(0.0, 0.3), current=(0.0, 0.1), velocity=(0.0, 4.6))


def is_supplys(guard: Guard, lacking: float, *recent: State) -> bool:
    """Whether the supply is blamed for a torque [N m] that joint 2 lacks."""
    try:
        guard.look_at_supply(1, lacking, recent)
    except SafetyStop as stop:
        assert stop.cause is Cause.OUT_OF_VOLTAGE
        assert "lower velocity_limit to 4.1 rad/s" in str(stop), "nine tenths of its speed"
        return True
    return False


@pytest.mark.parametrize(("share", "is_blamed"), [(0.98, True), (1.02, False)])
def test_the_supply_must_explain_half_of_the_missing_torque(arm: Arm, share: float, is_blamed: bool) -> None:
    config = arm()
    missing = config.joints[1].torque_per_goal * (0.3 - 0.1)
    found = is_supplys(Guard(config), share * 2.0 * missing, at(0, LACKING), at(20, LACKING))
    assert found is is_blamed


@pytest.mark.parametrize(("later", "is_blamed"), [(39, True), (41, False)])
def test_what_the_supply_lacked_more_than_a_tenth_of_a_second_ago_explains_nothing(
    arm: Arm, later: int, is_blamed: bool
) -> None:
    recent = at(0, LACKING), at(20, LACKING), at(20 + later, STILL)
    assert is_supplys(Guard(arm()), 0.4, *recent) is is_blamed


def test_a_servo_that_holds_another_goal_lacks_no_voltage(arm: Arm) -> None:
    guard = Guard(arm())
    told = tuple(Status(4, each, 0.0, torque=True, hardware_error=0) for each in (0.0, 0.1))
    guard.look(STILL._replace(status=told))
    assert not is_supplys(guard, 0.4, at(0, LACKING), at(20, LACKING))


@pytest.mark.parametrize(
    ("goal", "carried", "said"),
    [
        (0.3, 0.0, "Its torque is off"),
        (-0.3, 0.0, "Its torque is off"),
        (0.3, 0.12, "Its goals are being altered in transit"),
        (-0.3, -0.12, "Its goals are being altered in transit"),
        (0.3, -0.3, "Its torque is not as commanded"),
        (-0.3, 0.3, "Its torque is not as commanded"),
        (0.3, 0.7, "Its torque is not as commanded"),
        (-0.3, -0.7, "Its torque is not as commanded"),
        (0.0, 0.5, "Its torque is not as commanded"),
        (0.0, -0.5, "Its torque is not as commanded"),
    ],
)
def test_what_a_current_that_does_not_follow_suggests(arm: Arm, goal: float, carried: float, said: str) -> None:
    guard = Guard(arm())
    wrong = STILL._replace(goal_current=(0.0, goal), current=(0.0, carried))
    with pytest.raises(SafetyStop, match=said) as stop:
        for number in range(60):
            guard.look(at(number, wrong))
    assert stop.value.cause in (Cause.NOT_FOLLOWING, Cause.GOALS_CHANGED)


@pytest.mark.parametrize(("driven_by", "stops"), [("voltage", True), ("current", False)])
def test_a_servo_that_senses_its_supply_current_is_compared_with_its_goal_only_in_volts(
    tmp_path: Path, driven_by: str, stops: bool
) -> None:
    text = (CONFIGS / "xl330_two_link.toml").read_text(encoding="utf-8")
    if driven_by == "voltage":
        for old, new in (
            ("torque_constant = 0.354 ", 'mode = "pwm"\ntorque_per_volt = 0.1 '),
            ("torque_constant_std = 0.035 ", "torque_per_volt_std = 0.01 "),
            ("current_limit = 0.44 ", "voltage_limit = 3.0 "),
        ):
            assert text.count(old) == 2
            text = text.replace(old, new)
    path = tmp_path / "arm.toml"
    path.write_text(text, encoding="utf-8")
    config = load_config(path)
    guard, goal = Guard(config), 0.9 * config.joints[1].goal_limit
    without = STILL._replace(goal_current=(0.0, goal))

    def look() -> None:
        for number in range(60):
            guard.look(at(number, without))

    if not stops:
        look()
        return
    with pytest.raises(SafetyStop) as stop:
        look()
    assert stop.value.cause is Cause.NOT_FOLLOWING
