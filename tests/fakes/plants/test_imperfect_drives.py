"""Drives that differ from the textbook: saturating torque, pulling cables, friction that falls during warm-up."""

import math

import pytest
from pydantic import ValidationError

from hil.fakes.plants.arm import Drive, base_parameters
from hil.fakes.plants.motor import Motor
from hil.fakes.plants.plant import make_plant
from tests.fakes.plants.test_plants import DRIVE, KINDS, arm, played


def pushed(current: float, **changes: float) -> float:
    """Return the steady torque of a frictionless motor at this current [A] and at an angle of 0.3 rad."""
    motor = Motor(Drive.model_validate({**DRIVE, **changes}))
    return motor.push(1e-3, current, 0.3, 0.0)[0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_torque_saturates(sign: float) -> None:
    saturation = {"saturation": 0.05, "saturation_current": 0.8}
    assert pushed(sign * 0.8, **saturation) == pytest.approx(0.95 * pushed(sign * 0.8))
    assert pushed(sign * 0.08, **saturation) == pytest.approx(pushed(sign * 0.08), rel=1e-3)
    assert abs(pushed(sign * 1.6, **saturation)) < 0.9 * abs(pushed(sign * 1.6))


def test_a_cable_pulls_towards_its_slack_angle() -> None:
    cable = {"cable_stiffness": 0.02, "cable_angle": 0.8}
    assert pushed(0.0, **cable) == pytest.approx(0.02 * 0.5)
    pulled = arm("two links", gravity=0.0, viscous=0.05, cable_stiffness=0.5, cable_angle=0.4, start=[0.1, 0.1])
    assert played(make_plant(pulled), 8.0, lambda t: [0.0, 0.0])[-1] == pytest.approx((0.4, 0.4), abs=0.01)
    assert base_parameters(arm(**cable))["offset_1"] == pytest.approx(-0.02 * 0.8)


@pytest.mark.parametrize("kind", KINDS)
def test_friction_falls_while_the_grease_warms(kind: str) -> None:
    """At a steady speed, friction equals the whole torque, so the speed increases as friction falls."""
    count = 1 if "pendulum" in kind else 2
    warming = {"viscous": 0.2, "coulomb": 0.02, "cold_viscous": 0.25, "cold_coulomb": 0.5, "warm_up_time": 2.0}
    described = arm(kind, gravity=0.0, **warming)
    plant = make_plant(described)
    last = count - 1
    if last:
        plant.jam(0, True)  # type: ignore[attr-defined]
    torque = 0.3
    speeds = {}
    for tick in range(1, 1801):
        plant.advance(tick / 200, [0.0] * last + [torque / DRIVE["torque_constant"]])
        speeds[tick / 200] = plant.velocity[last]
    for time in (1.0, 9.0):
        truth = base_parameters(described, time)
        steady = (torque - truth[f"coulomb_{count}"]) / truth[f"viscous_{count}"]
        assert speeds[time] == pytest.approx(steady, rel=0.02)
    assert speeds[9.0] > 1.1 * speeds[1.0]


def test_the_truth_is_that_of_warm_drives_unless_a_time_is_given() -> None:
    described = arm("two links", coulomb=0.04, viscous=0.03, cold_coulomb=0.2, cold_viscous=0.1, warm_up_time=30.0)
    assert base_parameters(described)["coulomb_1"] == 0.04
    assert base_parameters(described, 0.0)["coulomb_2"] == pytest.approx(0.048)
    assert base_parameters(described, 30.0)["viscous_1"] == pytest.approx(0.03 * (1.0 + 0.1 / math.e))


@pytest.mark.parametrize("changes", [{"saturation": 1.0}, {"saturation": -0.1}, {"warm_up_time": 0.0}])
def test_what_no_drive_is_like(changes: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        arm(**changes)
