"""Uncoupled joints: each is a separate link with its own drive.

    [fake]
    plant = "hil.fakes.plants.independent:make_plant"

    [[fake.plant_options.joints]]
    start = [0.0]
    gravity = 0.0
    links = [{ length = 0.1, mass = 0.05, centre = 0.05, inertia = 1e-4 }]
    drives = [{ mass = 0.02, rotor_inertia = 8e-8, gear_ratio = 288.4, torque_constant = 0.35, viscous = 0.01 }]

Each joint is described as an arm with one joint.
"""

from collections.abc import Sequence

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hil.fakes.plants.arm import Arm
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.pendulum import Pendulum
from hil.toml_errors import describe


class _Joints(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    joints: tuple[Arm, ...] = Field(strict=False, min_length=1, description="arms of one joint each")


class Independent:
    """One pendulum per joint; see `hil.fakes.plants.plant.Plant`."""

    def __init__(self, arms: Sequence[Arm]) -> None:
        self._joints = [Pendulum(arm) for arm in arms]

    @property
    def joints(self) -> int:
        return len(self._joints)

    @property
    def position(self) -> list[float]:
        return [joint.position[0] for joint in self._joints]

    @property
    def velocity(self) -> list[float]:
        return [joint.velocity[0] for joint in self._joints]

    @property
    def current(self) -> list[float]:
        return [joint.current[0] for joint in self._joints]

    def jam(self, joint: int, jammed: bool) -> None:
        self._joints[joint].jam(0, jammed)

    def hold(self, joint: int, velocity: float | None) -> None:
        self._joints[joint].hold(0, velocity)

    def advance(self, until: float, current: Sequence[float]) -> None:
        for joint, ampere in zip(self._joints, current, strict=True):
            joint.advance(until, (ampere,))


def make_plant(**options: object) -> Independent:
    """Create the plant from `joints`: tables of arms with one link and one drive each. Raises PlantError."""
    try:
        joints = _Joints.model_validate(options).joints
    except ValidationError as error:
        raise PlantError(describe(error, "plant_options", _Joints)) from error
    for number, arm in enumerate(joints, start=1):
        if len(arm.links) != 1:
            raise PlantError(f"plant_options: joints[{number}] has {len(arm.links)} links: each joint must have one")
    return Independent(joints)
