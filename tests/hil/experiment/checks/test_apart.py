"""Two servos on one joint that no longer turn together."""

from pathlib import Path

import pytest

import hil
from hil.config.schema import load_config
from hil.drivers.joint import Joint, SecondServo
from hil.drivers.servo_model import Mode, servo_model
from hil.errors import Cause, SafetyStop
from hil.experiment.checks.apart import ALLOWED_RAD, Apart, causes_of_standstill
from hil.experiment.guard import Guard
from tests.support.edits import QUICK, replaced, with_second_servo
from tests.support.motion import STILL, at
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


def paired(arm: Path, fault: str = "") -> Path:
    """Write the file of an arm with two servos on its first joint, IDs 1 and 3."""
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    short = ("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]"), *QUICK
    arm.write_text(f"{with_second_servo(replaced(text, *short))}\n{fault}", encoding="utf-8")
    return arm


def test_the_guard_stops_at_the_sample_in_which_two_servos_are_apart(tmp_path: Path) -> None:
    guard = Guard(load_config(paired(tmp_path / "arm.toml")))
    for number, apart in enumerate((0.3, 0.3 + 0.9 * ALLOWED_RAD)):
        guard.look(at(number, STILL._replace(apart=((apart,), ()))))
    with pytest.raises(SafetyStop, match=r"'shoulder'.* ID 3 has turned \+0\.\d+ rad relative to the first") as stopped:
        guard.look(at(2, STILL._replace(apart=((0.3 + 1.1 * ALLOWED_RAD,), ()))))
    assert stopped.value.cause is Cause.APART


def test_two_servos_that_turn_together_are_not_stopped(tmp_path: Path) -> None:
    hil.record(paired(tmp_path / "arm.toml"), out=tmp_path / "run")


def test_a_horn_that_slips_stops_the_arm_by_name(tmp_path: Path) -> None:
    slips = paired(tmp_path / "arm.toml", '[[fake.faults]]\nkind = "encoder_jump"\nservo = 3\nat = 3.0\namount = 150\n')
    with pytest.raises(SafetyStop, match=r"ID 3 has turned .0\.\d+ rad relative to the first") as stopped:
        hil.record(slips, out=tmp_path / "run")
    assert stopped.value.cause is Cause.APART


@pytest.mark.parametrize(
    ("model", "mode", "may_be_dead"),
    [("XM430-W350", Mode.CURRENT, False), ("XM430-W350", Mode.PWM, True), ("XL430-W250", Mode.PWM, True)],
)
def test_a_dead_motor_is_named_where_its_current_is_not_measured(model: str, mode: Mode, may_be_dead: bool) -> None:
    said = causes_of_standstill(Joint("hip", 2, servo_model(model), mode=mode))
    assert ("its motor delivers no torque (a broken wire" in said) == may_be_dead
    assert ("its gear does not transmit" in said) != may_be_dead


@pytest.mark.parametrize("servo", [1, 3])
def test_an_alert_without_a_hardware_error_names_the_servo_that_raised_it(tmp_path: Path, servo: int) -> None:
    fault = f'[[fake.faults]]\nkind = "status_error"\nservo = {servo}\nat = 3.0\nduration = 0.02\namount = 128\n'
    said = rf"^Joint 'shoulder' \(ID {servo}, XM430-W350\) raised its alert, but reports no hardware error now\."
    with pytest.raises(SafetyStop, match=said) as stopped:
        hil.record(paired(tmp_path / "arm.toml", fault), out=tmp_path / "run")
    assert stopped.value.cause is Cause.ALERT
