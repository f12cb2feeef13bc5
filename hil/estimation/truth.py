"""The true parameters of a fake arm."""

import math

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.fakes.plants.arm import base_parameters
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
    for servo, moved in zip(fake.servos, fake.joints, strict=True):
        joint, drive, number = config.joints[moved], fake.arm.drives[moved], moved + 1
        if joint.drive_mode is Mode.PWM:
            motor = load_model(servo.model)
            truth[f"viscous_{number}"] += drive.torque_constant * motor.back_emf_v_s / motor.resistance_ohm
    return truth
