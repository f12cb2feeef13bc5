"""Friction and drive model of a chain, and the names of all parameters."""

from dataclasses import dataclass
from typing import Literal

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.tilt import TILT
from hil.estimator.errors import ModelError

Friction = Literal["coulomb", "stribeck", "stribeck_load"]
Drive = Literal["delay", "lag", "delay_lag"]

LINEAR = {"viscous": "N m s/rad", "coulomb": "N m", "offset": "N m"}
FRICTION: dict[str, dict[str, str]] = {
    "coulomb": {"coulomb_width": "rad/s"},
    "stribeck": {"coulomb_width": "rad/s", "stribeck_rise": "1", "stribeck_velocity": "rad/s"},
    "stribeck_load": {"coulomb_width": "rad/s", "stribeck_rise": "1", "stribeck_velocity": "rad/s", "load": "1"},
}
ADDED_MASS = "added_mass_scale"
"""Scale of the torque of a known added mass: the first joint's assumed torque constant divided by its true one."""
DRIVE = {"delay": ("delay",), "lag": ("lag",), "delay_lag": ("delay", "lag")}


@dataclass(frozen=True)
class ChainModel:
    """A chain's equations of motion with friction and drive terms as in `hil.estimator.models.model.Model`.

    zeros: estimate zero errors of the encoders of all joints but the first, as far as gravity reveals them.
    torque_scale: estimate torque scales of all joints but the first, whose torque constant is trusted.
    base_tilt: estimate the tilt of the base; `base` must come from `BaseParameters.of(..., tilts=True)`.
    lags: estimate each joint's lag, if `drive` has one, as a ratio to that of joint 1, since the joints' servo models
    may differ.
    by_voltage: joints (from 1) that are driven by voltage, so that their back-EMF lags like the drive's torque.
    added_mass: some periods were recorded with a known mass added, which reveals the first joint's torque constant too.
    Raises ModelError.
    """

    base: BaseParameters
    friction: Friction = "stribeck"
    drive: Drive = "lag"
    zeros: bool = False
    torque_scale: bool = False
    base_tilt: bool = False
    added_mass: bool = False
    lags: bool = False
    by_voltage: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.friction not in FRICTION:
            raise ModelError(f"friction model {self.friction!r}: a chain supports {', '.join(FRICTION)}")
        if self.drive not in DRIVE:
            raise ModelError(f"drive model {self.drive!r}: choose one of {', '.join(DRIVE)}")
        if self.torque_scale and self.joints == 1:
            raise ModelError("torque_scale compares joints' torque constants: it needs at least two joints")

    @property
    def joints(self) -> int:
        """Number of joints."""
        return self.base.chain.joints

    @property
    def linear_names(self) -> tuple[str, ...]:
        """Parameters found by the regression: base parameters, viscous and Coulomb friction, offsets."""
        return (*self.base.names, *(f"{term}_{joint}" for term in LINEAR for joint in self._numbers))

    @property
    def _terms(self) -> list[tuple[str, str]]:
        """Names and units of the parameters that follow `linear_names`."""
        terms = [(f"{term}_{joint}", unit) for term, unit in FRICTION[self.friction].items() for joint in self._numbers]
        if self.zeros:
            terms += [(f"zero_{joint}", "rad") for joint in self._numbers[1:]]
        if self.torque_scale:
            terms += [(f"torque_scale_{joint}", "1") for joint in self._numbers[1:]]
        if self.base_tilt:
            terms += [(name, "rad") for name in TILT]
        if self.added_mass:
            terms.append((ADDED_MASS, "1"))
        terms += [(f"back_emf_{joint}", "1") for joint in self.by_voltage]
        terms += [(name, "s") for name in DRIVE[self.drive]]
        if self._has_lags:
            terms += [(f"lag_ratio_{joint}", "1") for joint in self._numbers[1:]]
        return terms

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return (*self.linear_names, *(name for name, _ in self._terms))

    @property
    def units(self) -> tuple[str, ...]:
        """Units of all parameters."""
        linear = (unit for unit in LINEAR.values() for _ in self._numbers)
        return (*self.base.units, *linear, *(unit for _, unit in self._terms))

    @property
    def description(self) -> str:
        """Short description of the model: its friction, options and drive."""
        words = {"zeros": self.zeros, "torque scales": self.torque_scale, "base tilt": self.base_tilt}
        words |= {"added mass": self.added_mass, "lags": self._has_lags, "back-EMF": bool(self.by_voltage)}
        return " + ".join((self.friction, *(word for word, there in words.items() if there), self.drive))

    @property
    def _has_lags(self) -> bool:
        """Whether each joint has its own lag."""
        return self.lags and "lag" in DRIVE[self.drive]

    @property
    def _numbers(self) -> range:
        return range(1, self.joints + 1)
