"""Which friction and which drive the likelihood fits, and the names of all its parameters."""

from collections.abc import Collection
from dataclasses import dataclass, replace

from hil.estimator.errors import ModelError
from hil.estimator.models.terms import (
    DRIVES,
    FRICTIONS,
    OPTIONS,
    Drive,
    Friction,
    Option,
    base_names,
    extra_names,
    units_of,
)

LEVER_STD = 0.05
"""Relative standard deviation of a link's length by a ruler, over gravity by the tilt that somebody gave."""


@dataclass(frozen=True)
class Model:
    """The arm's equations with these terms, which `hil.estimator.models.terms` declares.

    Friction: `coulomb` is viscous v + coulomb tanh(v / coulomb_width); `stribeck` multiplies coulomb by 1 +
    stribeck_rise exp(-(v / stribeck_velocity)^2); `stribeck_load` adds load |motor torque| to that level. Drive:
    `delay` is a pure delay of the torque on top of what `SettledPeriod` knows, `lag` a first-order lag, `delay_lag`
    both. Options: `presliding` puts bristles that bend before they slip (`hil.estimator.simulation.bristles`) instead
    of any friction's coulomb_width. `asymmetry` adds viscous_asymmetry |v|: friction that differs with direction
    (of the Coulomb level, that is the offset). `ripple` multiplies the motor torque by 1 + ripple_sin sin(ripple_cycles
    q) + ripple_cos cos(ripple_cycles q), ripple_cycles per turn of the joint. `zeros` adds the errors of the
    encoders' zeros, true angle = measured angle + zero; the first joint's is observable only under gravity.
    `torque_scale` multiplies the second joint's torque: true over assumed torque constant, relative to the first
    joint's. One unknown torque constant scales all parameters; of two, the ratio is identifiable, since both joints
    feel the same masses. `saturation` takes the share saturation torque^2 off the torque, `cable` adds cable_stiffness
    q to what holds the joint (where it is slack is part of the offset), and `encoder` says that a joint at q is
    measured to be at q + encoder_sin_once sin q + encoder_cos_once cos q + encoder_sin_twice sin 2q + encoder_cos_twice
    cos 2q. `lags` lets the second joint's torque lag by lag + lag_difference.

    Raises ModelError for other names, for other than one or two joints, and for a torque_scale of one joint.
    """

    joints: int
    friction: Friction = "coulomb"
    drive: Drive = "delay"
    options: Collection[Option] = frozenset()
    """A frozenset once the model exists."""
    by_voltage: Collection[int] = frozenset()
    """Joints, from 1, that are driven by voltage, whose back-EMF passes the drive's lag as the voltage does: a share
    back_emf of their viscous friction (`hil.estimator.simulation.back_emf`). A frozenset once the model exists."""
    lever: float | None = None
    """Length of link 1 over gravity [s^2], where a ruler and the arm's tilt tell it: coupling is that times gravity_2.
    It is expected to `LEVER_STD`, no more, so that it decides only where the motion does not."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "options", frozenset(self.options))
        object.__setattr__(self, "by_voltage", frozenset(self.by_voltage))
        base_names(self.joints)
        if self.friction not in FRICTIONS:
            raise ModelError(f"friction model {self.friction!r}: choose one of {', '.join(FRICTIONS)}")
        if self.drive not in DRIVES:
            raise ModelError(f"drive model {self.drive!r}: choose one of {', '.join(DRIVES)}")
        for option in self.options:
            if option not in OPTIONS:
                raise ModelError(f"model option {option!r}: choose from {', '.join(OPTIONS)}")
        if "torque_scale" in self.options and self.joints != 2:
            raise ModelError("torque_scale compares two joints' torque constants: it needs two joints")

    def having(self, *options: Option) -> "Model":
        """This model with these options besides its own."""
        return replace(self, options={*self.options, *options})

    def without(self, *options: Option) -> "Model":
        """This model without these options."""
        return replace(self, options=set(self.options) - set(options))

    @property
    def base_names(self) -> tuple[str, ...]:
        """The base parameters."""
        return base_names(self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """The base parameters, then the other terms joint by joint, in the order in which they are declared."""
        laws = FRICTIONS[: FRICTIONS.index(self.friction) + 1]
        voltage = ("voltage",) if self.by_voltage else ()
        parts = frozenset((*laws, *self.options, *DRIVES[self.drive], *voltage))
        return (*self.base_names, *extra_names(self.joints, parts, frozenset(self.by_voltage)))

    @property
    def description(self) -> str:
        """Human-readable description."""
        return " + ".join(
            (self.friction, *(each.replace("_", " ") for each in OPTIONS if each in self.options), self.drive)
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Units of `names`."""
        return units_of(self.names)
