"""Physical description of a fake arm: links, drives, and the parameters that identification should find."""

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from hil.toml_errors import Described

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]

PI = 3.1425
"""Pi, rounded up, so that bounds based on it accept rounded angles such as 1.5708, 6.284 or 12.57 [rad]."""

Angle = Annotated[float, Field(ge=-4 * PI, le=4 * PI, allow_inf_nan=False)]


class Link(Described):
    """One rigid link, without the servo bodies."""

    length: Positive = Field(le=3, description="distance from its joint to the next joint [m]")
    mass: NotNegative = Field(le=20, description="mass [kg]")
    centre: Finite = Field(ge=-3, le=3, description="distance from its joint to its centre of mass [m]")
    inertia: NotNegative = Field(le=10, description="inertia about its centre of mass [kg m^2]")


class Drive(Described):
    """One servo: body, rotor and gears, current loop, friction."""

    mass: NotNegative = Field(le=5, description="mass of the servo's body, which is located at its joint [kg]")
    rotor_inertia: NotNegative = Field(
        le=1e-3, description="inertia of the rotor on the motor side of the gears [kg m^2]"
    )
    gear_ratio: Positive = Field(le=10000, description="turns of the rotor per turn of the joint")
    torque_constant: Positive = Field(le=100, description="torque at the output shaft per motor current [N m/A]")
    current_lag: NotNegative = Field(0.0, le=0.1, description="time constant of the current loop, first order [s]")
    saturation: Annotated[float, Field(ge=0.0, lt=1.0)] = Field(
        0.0, description="fraction of the torque lost at saturation_current"
    )
    saturation_current: Positive = Field(
        1.0, le=100, description="current at which the fraction `saturation` is lost [A]"
    )
    viscous: NotNegative = Field(0.0, le=20, description="viscous friction, warm [N m s/rad]")
    coulomb: NotNegative = Field(0.0, le=20, description="Coulomb friction, warm [N m]")
    cold_viscous: NotNegative = Field(
        0.0, le=10, description="excess of viscous friction at time 0, as a fraction of its warm value"
    )
    cold_coulomb: NotNegative = Field(
        0.0, le=10, description="excess of Coulomb friction at time 0, as a fraction of its warm value"
    )
    warm_up_time: Positive = Field(60.0, le=36000, description="time constant of the warm-up [s]")
    coulomb_width: NotNegative = Field(
        0.0,
        le=1,
        description="0: stiction; above 0: smooth friction, coulomb * tanh(velocity / width) [rad/s]",
    )
    stribeck_rise: NotNegative = Field(
        0.0, le=10, description="excess of static over Coulomb friction, as a fraction of the latter"
    )
    stribeck_velocity: Positive = Field(
        0.1, le=5, description="velocity at which stribeck_rise has fallen to 1/e [rad/s]"
    )
    load: NotNegative = Field(0.0, le=1, description="additional dry friction per unit of motor torque [N m per N m]")
    presliding_stiffness: NotNegative = Field(
        0.0, le=100000, description="stiffness of the presliding contact; 0 for rigid stiction [N m/rad]"
    )
    presliding_damping: NotNegative = Field(0.0, le=100, description="damping of the presliding contact [N m s/rad]")
    offset: Finite = Field(0.0, ge=-20, le=20, description="constant load torque [N m]")
    cable_stiffness: NotNegative = Field(
        0.0, le=100, description="stiffness of a cable that pulls the joint to cable_angle [N m/rad]"
    )
    cable_angle: Angle = Field(0.0, description="joint angle at which the cable is slack [rad]")
    ripple: NotNegative = Field(
        0.0, le=1, description="amplitude of the angle-dependent torque ripple, as a fraction of the torque"
    )
    ripple_cycles: Positive = Field(7.0, description="cycles of torque ripple per turn of the joint")
    cogging: NotNegative = Field(0.0, le=10, description="amplitude of the cogging torque at the output shaft [N m]")
    cogging_cycles: Positive = Field(1.0, description="cycles of cogging per turn of the joint")
    backlash: NotNegative = Field(0.0, le=0.2, description="total backlash of the gears [rad]")
    gear_stiffness: Positive = Field(
        1500.0, le=1e06, description="stiffness of the gears in contact; only with backlash [N m/rad]"
    )
    gear_damping: NotNegative = Field(
        2.0, le=10000, description="damping of the gears in contact; only with backlash [N m s/rad]"
    )
    stops: tuple[Angle, Angle] | None = Field(None, strict=False, description="joint angles of the hard stops [rad]")
    stop_stiffness: Positive = Field(200.0, le=1e06, description="stiffness of a hard stop [N m/rad]")
    stop_damping: NotNegative = Field(1.0, le=10000, description="damping of a hard stop [N m s/rad]")

    @property
    def warms_up(self) -> bool:
        """Whether the friction changes with time."""
        return bool(self.cold_viscous or self.cold_coulomb)

    def coldness(self, time: float) -> tuple[float, float]:
        """Return viscous and dry friction at `time` [s] since power-up, as multiples of the warm values."""
        cold = math.exp(-time / self.warm_up_time)
        return 1.0 + self.cold_viscous * cold, 1.0 + self.cold_coulomb * cold

    @model_validator(mode="after")
    def _width_is_resolved(self) -> Self:
        if 0.0 < self.coulomb_width < 1e-3:
            raise ValueError(
                f"coulomb_width is {self.coulomb_width:g} rad/s: give 0 for stiction, or at least 0.001 rad/s for "
                "smooth friction"
            )
        if self.presliding_stiffness and self.coulomb_width:
            raise ValueError(
                "presliding_stiffness and coulomb_width both define friction near standstill: give only one of them"
            )
        if self.presliding_stiffness and not self.coulomb:
            raise ValueError("presliding_stiffness needs a coulomb greater than 0: otherwise nothing holds the joint")
        if self.presliding_damping and not self.presliding_stiffness:
            raise ValueError(
                "presliding_damping needs a presliding_stiffness greater than 0: there is no spring to damp"
            )
        if self.stops is not None and self.stops[0] >= self.stops[1]:
            raise ValueError(f"stops = [{self.stops[0]:g}, {self.stops[1]:g}]: the first must be less than the second")
        if self.backlash and not self.rotor_inertia:
            raise ValueError("backlash needs a rotor_inertia greater than 0: within the gap the rotor moves on its own")
        return self


class Arm(Described):
    """A planar arm of one or two joints; joint 1 is measured from the horizontal, joint 2 from link 1."""

    gravity: NotNegative = Field(9.81, le=30, description="acceleration of gravity; 0 for a horizontal arm [m/s^2]")
    tilt: Annotated[float, Field(ge=-PI / 2, le=PI / 2)] = Field(
        0.0, description="inclination of the arm's plane from the vertical; pi/2 is horizontal [rad]"
    )
    start: tuple[Angle, ...] = Field(strict=False, description="joint angles at time 0 [rad]")
    links: tuple[Link, ...] = Field(
        strict=False, min_length=1, max_length=2, description="links from the base outwards"
    )
    drives: tuple[Drive, ...] = Field(strict=False, description="drives, one per link, at its joint")

    @model_validator(mode="after")
    def _one_of_each_per_joint(self) -> Self:
        if not len(self.links) == len(self.drives) == len(self.start):
            raise ValueError(
                f"{len(self.links)} links, {len(self.drives)} drives and {len(self.start)} angles in start: "
                "give one of each per joint"
            )
        for joint, (angle, drive) in enumerate(zip(self.start, self.drives, strict=True), start=1):
            if drive.stops is not None and not drive.stops[0] <= angle <= drive.stops[1]:
                raise ValueError(f"start: {angle:g} rad for joint {joint} is beyond its hard stops {list(drive.stops)}")
        return self

    @property
    def weight(self) -> float:
        """Component of gravity within the arm's plane [m/s^2]."""
        return self.gravity * math.cos(self.tilt)


def base_parameters(arm: Arm | None, time: float = math.inf) -> dict[str, float]:
    """Return the true base parameters of this arm at `time` [s], with the estimator's names and order [SI units].

    The result is empty if `arm` is None, which stands for a plant with unknown parameters. By default, the drives are
    warm.

    Effects that no base parameter represents are left out: dry friction beyond Coulomb friction (Stribeck rise, load),
    presliding, the current loop's lag, saturation, ripple, cogging, a cable's stiffness, backlash, hard stops. The
    `gravity` values are those of the tilted plane; an offset includes a cable's torque at angle 0.
    """
    if arm is None:
        return {}
    parameters = _rigid_body(arm)
    drives = list(enumerate(arm.drives, start=1))
    parameters |= {f"viscous_{joint}": drive.viscous * drive.coldness(time)[0] for joint, drive in drives}
    parameters |= {f"coulomb_{joint}": drive.coulomb * drive.coldness(time)[1] for joint, drive in drives}
    pull = {joint: drive.cable_stiffness * drive.cable_angle for joint, drive in drives}
    parameters |= {f"offset_{joint}": drive.offset - pull[joint] for joint, drive in drives}
    return parameters


def armature(drive: Drive) -> float:
    """Return the rotor inertia referred to the joint [kg m^2]."""
    return drive.rotor_inertia * drive.gear_ratio**2


def _rigid_body(arm: Arm) -> dict[str, float]:
    first = arm.links[0]
    inertia_1 = first.inertia + first.mass * first.centre**2 + armature(arm.drives[0])
    moment_1 = first.mass * first.centre
    if len(arm.links) == 1:
        return {"inertia_1": inertia_1, "gravity_1": moment_1 * arm.weight}
    second = arm.links[1]
    beyond_elbow = second.mass + arm.drives[1].mass
    return {
        "inertia_1": inertia_1 + beyond_elbow * first.length**2,
        "coupling": second.mass * first.length * second.centre,
        "inertia_2": second.inertia + second.mass * second.centre**2,
        "armature_2": armature(arm.drives[1]),
        "gravity_1": (moment_1 + beyond_elbow * first.length) * arm.weight,
        "gravity_2": second.mass * second.centre * arm.weight,
    }
