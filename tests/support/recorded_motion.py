"""A simulated arm's motion as somebody else would record it: no bus, no periods that settle."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from hil.estimator.excitation.multisine import design_multisine, zippered_lines
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant

STEP = 2.0 * math.pi / 4096
RATE = 200.0
CURRENT_STEP = 2.69e-3
FRICTION = {"stribeck_rise": 0.4, "stribeck_velocity": 0.3, "load": 0.03}
LINKS = (
    {"length": 0.147, "mass": 0.180, "centre": 0.081, "inertia": 7.0e-4},
    {"length": 0.180, "mass": 0.200, "centre": 0.112, "inertia": 2.9e-4},
)
DRIVES = (
    {"viscous": 0.045, "coulomb": 0.055, "offset": 0.004},
    {"viscous": 0.040, "coulomb": 0.050, "offset": -0.003},
)
SERVO = {"mass": 0.082, "rotor_inertia": 8.0e-8, "gear_ratio": 353.5, "torque_constant": 1.8}


@dataclass(frozen=True)
class Motion:
    """time (samples,) [s]; torque, commanded and held, and rounded position (joints, samples) [N m, rad]."""

    arm: Arm
    time: np.ndarray
    torque: np.ndarray
    position: np.ndarray


@cache
def two_joints(seconds: float) -> Motion:
    """One multisine of 0.1 to 5 Hz from rest, at 200 Hz."""
    drives = [{**SERVO, **drive, **FRICTION} for drive in DRIVES]
    arm = Arm.model_validate({"start": (-math.pi / 2, 0.0), "links": LINKS, "drives": drives})
    wave = design_multisine(RATE, seconds, zippered_lines(seconds, (max(0.1, 1.0 / seconds), 5.0), 2), (0.9, 0.35), 3)
    current = np.round(wave.torque / SERVO["torque_constant"] / CURRENT_STEP) * CURRENT_STEP
    plant = make_plant(arm)
    position = np.empty(current.shape)
    for k, command in enumerate(current.T.tolist()):
        plant.advance(k / RATE + 3e-4, command)
        position[:, k] = plant.position
        plant.advance((k + 1) / RATE, command)
    time = np.arange(current.shape[1]) / RATE
    return Motion(arm, time, current * SERVO["torque_constant"], np.round(position / STEP) * STEP)
