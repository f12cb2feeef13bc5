"""The true parameters of a fake arm."""

import math
from collections.abc import Sequence

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.fakes.description import FakeArm
from hil.fakes.plants.arm import Drive, base_parameters
from hil.fakes.servo.registers import load_model


def true_parameters(config: Config, time: float = math.inf) -> dict[str, float] | None:
    """The base parameters by name [SI]; None for a real arm, empty for a plant that does not state them.

    time: time since the arm was switched on [s], for drives whose friction changes as they warm up. The back-EMF of a
    voltage-driven joint counts as viscous friction.
    """
    fake = config.fake
    if not config.is_fake or fake is None:
        return None
    truth = base_parameters(fake.arm, time)
    if fake.arm is None:
        return truth
    for name, damping in back_emf(config, fake, fake.arm.drives).items():
        truth[name] += damping
    return truth


def back_emf(config: Config, fake: FakeArm, drives: Sequence[Drive]) -> dict[str, float]:
    """Back-EMF of each voltage-driven joint as viscous friction [N m s/rad], by the name of that parameter."""
    found: dict[str, float] = {}
    for servo, moved in zip(fake.servos, fake.joints, strict=True):
        if config.joints[moved].drive_mode is Mode.PWM:
            motor = load_model(servo.model)
            name = f"viscous_{moved + 1}"
            damping = drives[moved].torque_constant * motor.back_emf_v_s / motor.resistance_ohm
            found[name] = found.get(name, 0.0) + damping
    return found
