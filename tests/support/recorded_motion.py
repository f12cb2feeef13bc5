"""A simulated arm's motion as another tool would record it: no bus, no settled periods."""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from hil.estimator.excitation.multisine import design_multisine, zippered_lines
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant
from tests.support.recorded_arm import CURRENT_STEP, DRIVES, LINKS, SERVO, STEP

RATE = 200.0
FRICTION = {"stribeck_rise": 0.4, "stribeck_velocity": 0.3, "load": 0.03}


@dataclass(frozen=True)
class Motion:
    """time (samples,) [s]; torque, commanded and held, and rounded position (joints, samples) [N m, rad]."""

    arm: Arm
    time: np.ndarray
    torque: np.ndarray
    position: np.ndarray


@cache
def two_joints(seconds: float, limit: float = math.inf) -> Motion:
    """One multisine of 0.1 to 5 Hz from rest, at 200 Hz. limit: of joint 1's torque; commands exceed it [N m]."""
    drives = [{**SERVO, **drive, **FRICTION} for drive in DRIVES]
    arm = Arm.model_validate({"start": (-math.pi / 2, 0.0), "links": LINKS, "drives": drives})
    wave = design_multisine(RATE, seconds, zippered_lines(seconds, (max(0.1, 1.0 / seconds), 5.0), 2), (0.9, 0.35), 3)
    current = np.round(wave.torque / SERVO["torque_constant"] / CURRENT_STEP) * CURRENT_STEP
    plant = make_plant(arm)
    position = np.empty(current.shape)
    most = limit / SERVO["torque_constant"]
    driven = np.stack((np.clip(current[0], -most, most), current[1]))
    for k, command in enumerate(driven.T.tolist()):
        plant.advance(k / RATE + 3e-4, command)
        position[:, k] = plant.position
        plant.advance((k + 1) / RATE, command)
    time = np.arange(current.shape[1]) / RATE
    return Motion(arm, time, current * SERVO["torque_constant"], np.round(position / STEP) * STEP)
