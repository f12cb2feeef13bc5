"""Backlash at very light links: the step follows the vibration of the contact."""

import math

import numpy as np
import pytest

from hil.fakes.plants.arm import Arm
from hil.fakes.plants.backlash import STEP, GearedArm
from hil.fakes.plants.errors import PlantError
from tests.fakes.plants.test_plants import arm

DRIVE = {"mass": 0.018, "rotor_inertia": 1e-8, "gear_ratio": 288.35, "torque_constant": 0.37, "current_lag": 1e-3}
DRIVE |= {"viscous": 0.004, "coulomb": 0.008, "backlash": 0.008}
LINK = {"length": 0.07, "mass": 0.025, "centre": 0.045, "inertia": 8e-6}


def tiny(**changes: float) -> Arm:
    drives = ({**DRIVE, **changes},) * 2
    return Arm.model_validate({"gravity": 9.81, "start": (-math.pi / 2, 0.0), "links": (LINK,) * 2, "drives": drives})


def test_links_of_some_grams_are_simulated_with_the_default_contact() -> None:
    plant = GearedArm(tiny())
    for number in range(20):
        plant.advance(0.005 * (number + 1), [0.1, -0.1] if number < 10 else [-0.1, 0.1])
    assert np.abs(plant.velocity).max() < 50.0
    gaps = np.abs(np.subtract(plant.rotor_angle, plant.position))
    assert gaps.max() < 0.5 * 0.008 + 1e-3, "gears in contact yield by far less than the gap"


def test_an_ordinary_arm_keeps_its_step() -> None:
    plant = GearedArm(arm("pendulum with play"))
    assert plant.step == STEP


def test_an_arm_that_diverges_says_when_and_what_to_change() -> None:
    plant = GearedArm(tiny())
    plant.step = STEP  # too long for it
    with pytest.raises(PlantError, match=r"unstable in simulation at 0\.\d+ s.*lower gear_stiffness"):
        for number in range(200):
            plant.advance(0.005 * (number + 1), [0.1, -0.1])
