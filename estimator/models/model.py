"""Friction and drive model of a planar arm, and the names of all its parameters."""

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
"""Relative standard deviation of the quotient of a measured link length and the component of gravity in the plane of
motion. That component depends on the configured tilt.
"""
LEVER_DOUBTED = 1.2
"""The prior (see `LEVER_STD`) is widened if it deviates from what the motion alone indicates by more than this number
of standard deviations of the difference.
"""


@dataclass(frozen=True)
class Model:
    """The arm's equations with a choice of the terms declared in `hil.estimator.models.terms`.

    Friction: `coulomb` is viscous v + coulomb tanh(v / coulomb_width); `stribeck` multiplies coulomb by 1 +
    stribeck_rise exp(-(v / stribeck_velocity)^2); `stribeck_load` adds load |motor torque| to the product.

    Drive: `delay` is a pure delay of the torque in addition to that in `SettledPeriod`, `lag` a first-order lag,
    `delay_lag` both.

    Options:
        presliding: replaces coulomb_width with bristles that deflect before they slip
            (`hil.estimator.simulation.bristles`).
        asymmetry: adds viscous_asymmetry |v|, friction that depends on direction (the offset covers a
            direction-dependent Coulomb level).
        ripple: multiplies the motor torque by 1 + ripple_sin sin(ripple_cycles q) + ripple_cos cos(ripple_cycles q),
            where ripple_cycles is the number of cycles per turn of the joint.
        cogging: adds cogging_sin sin(cogging_cycles q) + cogging_cos cos(cogging_cycles q) to the torque.
        zeros: adds zero errors of the encoders, true angle = measured angle + zero; the zero of the first joint is
            observable only under gravity.
        torque_scale: multiplies the second joint's torque by the ratio of true to assumed torque constant relative to
            the first joint's.
        saturation: reduces the torque by the fraction saturation torque^2.
        cable: adds cable_stiffness q to the load torque (the angle at which the cable is slack is part of the offset).
        encoder: a joint at q is measured to be at q + encoder_sin_once sin q + encoder_cos_once cos q +
            encoder_sin_twice sin 2q + encoder_cos_twice cos 2q.
        lags: adds lag_difference to the lag of the second joint's torque or, without a lag, to its delay.

    Raises ModelError for an unknown name, for torque_scale with one joint, and for arms that do not have one or two
    joints.
    """

    joints: int
    friction: Friction = "coulomb"
    drive: Drive = "delay"
    options: Collection[Option] = frozenset()
    """Options of the model, as listed above; always a frozenset after construction."""
    by_voltage: Collection[int] = frozenset()
    """Joints (from 1) that are driven by voltage.

    A fraction `back_emf` of their viscous friction is subject to the drive's lag (`hil.estimator.simulation.back_emf`).
    Always a frozenset after construction.
    """
    lever: float | None = None
    """Measured length of link 1 divided by gravity [s^2], if known.

    Coupling is expected to be this value times gravity_2, to within `LEVER_STD`. This prior only matters if the motion
    does not determine both.
    """

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
        """Return this model with `options` added."""
        return replace(self, options={*self.options, *options})

    def without(self, *options: Option) -> "Model":
        """Return this model without `options`."""
        return replace(self, options=set(self.options) - set(options))

    @property
    def base_names(self) -> tuple[str, ...]:
        return base_names(self.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the base parameters, then of the other terms joint by joint, in the order of their declaration."""
        laws = FRICTIONS[: FRICTIONS.index(self.friction) + 1]
        voltage = ("voltage",) if self.by_voltage else ()
        parts = frozenset((*laws, *self.options, *DRIVES[self.drive], *voltage))
        return (*self.base_names, *extra_names(self.joints, parts, frozenset(self.by_voltage)))

    @property
    def description(self) -> str:
        """Short description of the model: its friction, options and drive."""
        return " + ".join(
            (self.friction, *(each.replace("_", " ") for each in OPTIONS if each in self.options), self.drive)
        )

    @property
    def units(self) -> tuple[str, ...]:
        return units_of(self.names)
