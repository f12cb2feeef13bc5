"""Which friction and which drive the likelihood fits, and the names of all its parameters."""

from dataclasses import dataclass
from typing import Literal

from hil.estimator.errors import ModelError
from hil.estimator.models.regressor import parameter_names, parameter_units

Friction = Literal["coulomb", "stribeck", "stribeck_load"]
Drive = Literal["delay", "lag", "delay_lag"]

FRICTION_TERMS: dict[str, tuple[str, ...]] = {
    "coulomb": ("coulomb_width",),
    "stribeck": ("coulomb_width", "stribeck_rise", "stribeck_velocity"),
    "stribeck_load": ("coulomb_width", "stribeck_rise", "stribeck_velocity", "load"),
}
PRESLIDING = ("presliding_stiffness", "presliding_damping")
DRIVE_TERMS: dict[str, tuple[str, ...]] = {"delay": ("delay",), "lag": ("lag",), "delay_lag": ("delay", "lag")}
RIPPLE = ("ripple_sin", "ripple_cos", "ripple_cycles")
UNITS = {
    "coulomb_width": "rad/s",
    "stribeck_rise": "1",
    "stribeck_velocity": "rad/s",
    "load": "1",
    "presliding_stiffness": "N m/rad",
    "presliding_damping": "N m s/rad",
    "viscous_asymmetry": "N m s/rad",
    "ripple_sin": "1",
    "ripple_cos": "1",
    "ripple_cycles": "1",
    "zero": "rad",
    "torque_scale": "1",
    "delay": "s",
    "lag": "s",
}


@dataclass(frozen=True)
class Model:
    """The arm's equations with these terms.

    Friction: `coulomb` is viscous v + coulomb tanh(v / coulomb_width); `stribeck` multiplies coulomb by 1 +
    stribeck_rise exp(-(v / stribeck_velocity)^2); `stribeck_load` adds load |motor torque| to that level. `presliding`
    puts bristles that bend before they slip (`hil.estimator.simulation.bristles`) in the place of any of these'
    coulomb_width. Drive: `delay` is a pure delay of the torque on top of what `SettledPeriod` knows, `lag` a
    first-order lag, `delay_lag` both. `asymmetry` adds viscous_asymmetry |v|: friction that differs with direction (of
    the Coulomb level, that is the offset). `ripple` multiplies the motor torque by 1 + ripple_sin sin(ripple_cycles
    q) + ripple_cos cos(ripple_cycles q), ripple_cycles per turn of the joint. `zeros` adds the errors of the
    encoders' zeros, true angle = measured angle + zero; the first joint's shows only under gravity. `torque_scale`
    multiplies the second joint's torque: true over supposed torque constant, relative to the first joint's. One
    unknown torque constant scales all parameters; of two, the ratio shows, since both joints feel the same masses.

    Raises ModelError for other names, for other than one or two joints, and for a torque_scale of one joint.
    """

    joints: int
    friction: Friction = "coulomb"
    drive: Drive = "delay"
    presliding: bool = False
    asymmetry: bool = False
    ripple: bool = False
    zeros: bool = False
    torque_scale: bool = False

    def __post_init__(self) -> None:
        parameter_names(self.joints)
        if self.friction not in FRICTION_TERMS:
            raise ModelError(f"friction model {self.friction!r}: choose one of {', '.join(FRICTION_TERMS)}")
        if self.drive not in DRIVE_TERMS:
            raise ModelError(f"drive model {self.drive!r}: choose one of {', '.join(DRIVE_TERMS)}")
        if self.torque_scale and self.joints != 2:
            raise ModelError("torque_scale compares two joints' torque constants: it needs two joints")

    @property
    def base_names(self) -> tuple[str, ...]:
        """The base parameters."""
        return parameter_names(self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """The base parameters, then the friction terms joint by joint, then the drive's."""
        more = FRICTION_TERMS[self.friction]
        if self.presliding:
            more = (*more[1:], *PRESLIDING)
        more += ("viscous_asymmetry",) * self.asymmetry + RIPPLE * self.ripple + ("zero",) * self.zeros
        terms = (f"{term}_{joint + 1}" for term in more for joint in range(self.joints))
        return (*self.base_names, *terms, *(("torque_scale_2",) * self.torque_scale), *DRIVE_TERMS[self.drive])

    @property
    def description(self) -> str:
        """In words, for a person."""
        words = {
            "presliding": self.presliding,
            "asymmetry": self.asymmetry,
            "ripple": self.ripple,
            "zeros": self.zeros,
            "torque scale": self.torque_scale,
        }
        return " + ".join((self.friction, *(word for word, there in words.items() if there), self.drive))

    @property
    def units(self) -> tuple[str, ...]:
        """Units of `names`."""
        more = (UNITS[name.rstrip("_12")] for name in self.names[len(self.base_names) :])
        return (*parameter_units(self.joints), *more)
