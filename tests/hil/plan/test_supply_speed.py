"""Joints stay below the speed at which their supply no longer drives the commanded current."""

from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config, parse_config
from hil.pilot.supply import delivered_speed
from hil.plan.supply_speed import lowered, within_supply
from hil.runs.recording import Phase, sample_type
from tests.support.paths import CONFIGS


@pytest.fixture
def given() -> Config:
    return load_config(CONFIGS / "first_time.toml")


def limited(config: Config, second_only: bool = False) -> Config:
    text = Path(config.path).read_text(encoding="utf-8")
    before, first, second = text.split("[[fake.servos]]")
    limit = "\nvoltage_limited = true\n"
    second = second.replace("zero_ticks = 2048\n", f"zero_ticks = 2048{limit}", 1)
    first = first if second_only else first.rstrip() + f"{limit}\n"
    return parse_config("[[fake.servos]]".join((before, first, second)), config.path)


def test_a_motor_on_a_supply_stays_below_its_no_load_speed(given: Config) -> None:
    first, second = within_supply(limited(given, second_only=True)).joints
    assert first == given.joints[0], "a fake servo that no supply limits may turn as fast as configured"
    assert second.velocity_limit == pytest.approx(0.85 * 46 * 2 * np.pi / 60, rel=0.02)


def test_a_lower_velocity_limit_stays_and_only_changes_are_named(given: Config) -> None:
    both = limited(given)
    slow = both.model_copy(
        update={"joints": [both.joints[0].model_copy(update={"velocity_limit": 3.0}), both.joints[1]]}
    )
    after = within_supply(slow)
    assert after.joints[0].velocity_limit == 3.0
    (said,) = lowered(slow, after)
    assert "elbow 4.1 rad/s" in said
    assert "shoulder" not in said
    assert lowered(after, within_supply(after)) == ()


def test_the_speed_at_which_a_current_fell_behind_is_learned_from_the_samples(given: Config) -> None:
    samples = np.zeros(200, sample_type(2))
    samples["phase"] = Phase.PERIODIC
    samples["goal_current"] = 0.3
    samples["current"] = 0.3
    samples["velocity"] = 4.0
    samples["current"][-20:, 1], samples["velocity"][-20:, 1] = 0.1, 4.6
    samples["phase"][-5:] = Phase.BRAKING
    samples["velocity"][-5:, 1] = 6.0
    first, second = delivered_speed(given, samples)
    assert np.isinf(first)
    assert second == pytest.approx(0.9 * 4.6)


def test_a_braking_motor_has_all_the_voltage_it_needs(given: Config) -> None:
    servo = given.joints[0].joint.servo
    assert servo.is_out_of_voltage(0.3, 0.1, 4.6)
    assert servo.is_out_of_voltage(-0.3, -0.1, -4.6)
    assert not servo.is_out_of_voltage(0.3, 0.1, -4.6)
    assert not servo.is_out_of_voltage(0.3, 0.3, 4.6)
    assert not servo.is_out_of_voltage(0.3, -0.25, 4.6), "a shortfall of voltage never reverses a current"
    assert not servo.is_out_of_voltage(-0.3, 0.25, -4.6, 12.0)
