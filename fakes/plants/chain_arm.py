"""Description of a spatial fake arm: the links of a URDF, deviations of the true links from them, and the drives."""

from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from hil.description.arm import ArmDescription, Body
from hil.description.files import read_arm
from hil.description.urdf import rotation_of
from hil.fakes.plants.arm import Angle, Drive, NotNegative, Positive
from hil.toml_errors import Described

MOST_JOINTS = 7
PLANAR_ONLY = (
    *("backlash", "presliding_stiffness", "cogging", "saturation"),
    *("cold_viscous", "cold_coulomb", "cable_stiffness"),
)
_Place = Annotated[float, Field(ge=-3, le=3)]


class ChainArm(Described):
    """A serial arm of up to seven joints in space. The servos' bodies are part of the URDF's links."""

    urdf: str = Field(description="URDF file with the links; absolute, or relative to the TOML file's folder")
    joints: tuple[str, ...] = Field(
        strict=False,
        min_length=1,
        max_length=MOST_JOINTS,
        description="joint names in the URDF, from the base outwards",
    )
    start: tuple[Angle, ...] = Field(strict=False, description="joint angles at time 0 [rad]")
    gravity: NotNegative = Field(9.81, le=30, description="acceleration of gravity [m/s^2]")
    base: Annotated[tuple[Angle, Angle, Angle], Field(strict=False)] = Field(
        (0.0, 0.0, 0.0), description="roll, pitch and yaw of the base [rad]"
    )
    mass_scale: tuple[Annotated[Positive, Field(le=100)], ...] | None = Field(
        None, strict=False, description="ratio of true mass and inertia to the URDF's, per link"
    )
    centre_shift: tuple[Annotated[float, Field(ge=-1, le=1)], ...] | None = Field(
        None, strict=False, description="shift of each link's true centre of mass along its frame's x axis [m]"
    )
    payload: NotNegative = Field(0.0, le=50, description="point mass bolted to the last link [kg]")
    payload_at: Annotated[tuple[_Place, _Place, _Place], Field(strict=False)] = Field(
        (0.0, 0.0, 0.0), description="position of the point mass in the last link's frame [m]"
    )
    drives: tuple[Drive, ...] = Field(strict=False, description="drives, one per joint; their mass is not used")

    @model_validator(mode="after")
    def _one_of_each_per_joint(self) -> Self:
        count = len(self.joints)
        for key in ("start", "drives", "mass_scale", "centre_shift"):
            values = getattr(self, key)
            if values is not None and len(values) != count:
                raise ValueError(f"{key} has {len(values)} entries for {count} joints: give one per joint")
        for name, angle, drive in zip(self.joints, self.start, self.drives, strict=True):
            told = [term for term in PLANAR_ONLY if getattr(drive, term)]
            if told:
                raise ValueError(f"drives: {told[0]} of {name} is only supported by planar fake arms; leave it out")
            if drive.stops is not None and not drive.stops[0] <= angle <= drive.stops[1]:
                raise ValueError(f"start: {angle:g} rad for joint {name} is beyond its hard stops {list(drive.stops)}")
        for joint, body in zip(self.description.joints, self.bodies, strict=True):
            least = np.linalg.eigvalsh(body.inertia)[0]
            if least < -1e-12:
                raise ValueError(
                    f'{self.urdf}: the fake arm cannot be simulated, because the inertia of link "{joint.link}" has a '
                    f"negative principal moment ({least:.2g} kg m^2): correct its inertia (ixx to izz)"
                )
        return self

    @property
    def description(self) -> ArmDescription:
        """The arm as described by its URDF; raises ArmFileError."""
        return read_arm(Path(self.urdf), self.joints)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The true mass properties of the links."""
        count = len(self.joints)
        scales, shifts = self.mass_scale or (1.0,) * count, self.centre_shift or (0.0,) * count
        bare = [
            Body(
                scale * joint.body.mass,
                joint.body.centre + np.array([shift, 0.0, 0.0]),
                scale * joint.body.inertia,
            )
            for joint, scale, shift in zip(self.description.joints, scales, shifts, strict=True)
        ]
        return (*bare[:-1], _loaded(bare[-1], self.payload, np.array(self.payload_at)))

    @property
    def gravity_vector(self) -> np.ndarray:
        """Gravity in the base's frame (3,) [m/s^2]."""
        return np.asarray(rotation_of(*self.base).T @ np.array([0.0, 0.0, -self.gravity]))


def _loaded(body: Body, mass: float, at: np.ndarray) -> Body:
    if mass == 0.0:
        return body
    total = body.mass + mass
    away = at - body.centre
    inertia = body.inertia + body.mass * mass / total * (away @ away * np.eye(3) - np.outer(away, away))
    return Body(total, (body.mass * body.centre + mass * at) / total, inertia)
