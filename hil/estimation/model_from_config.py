"""Conversion of `[model]` and the joints' modes to the model that the estimator fits."""

from collections.abc import Collection

from hil.config.experiment import ModelConfig
from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.models.model import Model
from hil.estimator.models.terms import OPTIONS


def wanted_model(
    wanted: ModelConfig, joints: int, by_voltage: Collection[int] = (), lever: float | None = None
) -> Model:
    """The model requested by the file for an arm with `joints` joints; "auto" gives Stribeck friction.

    by_voltage: joints, numbered from 1, that are driven by voltage (`voltage_driven`). lever: length of link 1 divided
    by gravity (`lever_of`).
    """
    return Model(
        joints,
        wanted.fixed_friction,
        wanted.drive,
        {option for option in OPTIONS if getattr(wanted, option)},
        by_voltage,
        lever,
    )


def voltage_driven(config: Config) -> tuple[int, ...]:
    """The joints, numbered from 1, whose goal is a voltage."""
    return tuple(number for number, joint in enumerate(config.joints, start=1) if joint.drive_mode is Mode.PWM)


def lever_of(config: Config) -> float | None:
    """Length of link 1 divided by gravity [s^2]; None if either is missing or gravity is 0."""
    lengths = config.arm.link_lengths
    return None if lengths is None or len(lengths) != 2 or not config.arm.gravity else lengths[0] / config.arm.gravity
