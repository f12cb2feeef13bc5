"""How a joint's fault is explained: the supply, altered goals, or torque that is off."""

from collections.abc import Callable
from itertools import pairwise
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
        (0.1, 0.035, "Its goals are being altered in transit"),
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


def test_a_broken_motor_wire_is_no_reason_for_a_voltage_that_does_not_follow() -> None:
    """In PWM mode, the servo reports the voltage that it applies, whether or not a motor is connected."""
    said = {}
    for name in ("xl430_two_link", "xm430_two_link"):
        guard = Guard(load_config(CONFIGS / f"{name}.toml"))
        off = STILL._replace(goal_current=(0.0, 0.5))
        with pytest.raises(SafetyStop, match="Its torque is off") as stop:
            for number in range(200):
                guard.look(at(number, off))
        said[name] = str(stop.value)
    assert "a motor wire is broken" in said["xm430_two_link"]
    assert "wire" not in said["xl430_two_link"] and "0.500 V" in said["xl430_two_link"]


@pytest.mark.parametrize(
    ("rate", "reads", "said"),
    [
        (100.0, lambda _: 0.07, "stays the same"),
        (20.0, lambda _: 0.07, "Its goals are being altered in transit"),
        (400.0, lambda goal: 0.8 * goal - 0.24, "Its torque is not as commanded"),
        (400.0, lambda goal: 0.4 * goal - 0.12, "Its torque is off"),
    ],
    ids=["four readings", "three", "an offset", "neither offset nor share"],
)
def test_several_readings_tell_how_a_current_differs_from_its_goal(
    arm: Arm, rate: float, reads: Callable[[float], float], said: str
) -> None:
    """The latest readings go back 20 ms at least, and four are needed. What varies by half as much as the goal is no
    offset.
    """
    slow = ("rate = 400.0", f"rate = {rate}"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]")
    guard, goals = Guard(arm(*slow), (0.85, 0.85)), [0.2 + 0.1 * (n % 5) / 5 for n in range(400)]
    with pytest.raises(SafetyStop, match=said) as stop:
        for n, (before, goal) in enumerate(pairwise(goals)):
            state = STILL._replace(time_before_write=n / rate, time_after_read=n / rate + 0.001)
            guard.look(state._replace(goal_current=(0.0, goal), current=(0.0, reads(before))))
    assert stop.value.cause is Cause.NOT_FOLLOWING


@pytest.mark.parametrize(("held", "is_named"), [(0.05, True), (-0.05, True), (-0.15, False)])
def test_a_goal_register_that_explains_a_current_less_well_than_the_goal_is_not_named(
    arm: Arm, held: float, is_named: bool
) -> None:
    guard = Guard(arm())
    told = tuple(Status(4, each, 0.0, torque=True, hardware_error=0) for each in (0.0, held))
    wrong = STILL._replace(goal_current=(0.0, 0.3), current=(0.0, 0.1))
    with pytest.raises(SafetyStop) as stop:
        for number in range(60):
            state = at(number, wrong)
            guard.look(state._replace(status=told) if number == 5 else state)
    assert (f"Its goal register reads {held:.3f} A" in str(stop.value)) is is_named


@pytest.mark.parametrize(
    ("velocity", "moves", "said"),
    [
        (15.1, 1.0, r"changed by \+0\.0050 rad in the last 5 ms"),
        (19.5, 19.0, r"changed by \+0\.095 rad within 5 ms"),
    ],
    ids=["contradicts its position", "faster than its motor"],
)
def test_a_false_velocity_is_compared_with_the_latest_motion(
    arm: Arm, velocity: float, moves: float, said: str
) -> None:
    """Not with the longer span, in which the joint may have begun to move."""
    guard = Guard(arm())
    with pytest.raises(SafetyStop, match=said):
        for number in range(4):
            state = STILL._replace(velocity=(min(moves, 14.9), 0.0), position=(-1.57 + moves * number / 400, 0.0))
            guard.look(at(number, state if number < 3 else state._replace(velocity=(velocity, 0.0))))


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
