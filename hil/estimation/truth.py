"""The true parameters of a fake arm, as built and as scaled to the torque constants that a result assumes.

A result assumes the file's torque constants, which need not be those of the fake arm's motors.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimation.torque_constants import RATIO
from hil.estimator.chain.model.tilt import TILT
from hil.estimator.models.terms import RIGID_BODY, TERMS, joint_of, kind_of, term_of
from hil.fakes.description import FakeArm
from hil.fakes.plants.arm import Drive, base_parameters
from hil.fakes.servo.registers import load_model
from hil.results.parts import Quantity
from hil.results.result import Result

_EQUAL = 1e-4
"""Relative difference up to which two torque constants count as equal."""

_DETERMINED = 0.02
"""Largest standard error, relative to the true value, of a well-determined parameter."""


def true_parameters(config: Config, time: float = math.inf) -> dict[str, float] | None:
    """The base parameters by name [SI]; None for a real arm, empty for a fake arm whose file does not state them.

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
    """Back-EMF of each voltage-driven joint, expressed as viscous friction [N m s/rad], by parameter name."""
    found: dict[str, float] = {}
    for servo, moved in zip(fake.servos, fake.joints, strict=True):
        if config.joints[moved].drive_mode is Mode.PWM:
            motor = load_model(servo.model)
            name = f"viscous_{moved + 1}"
            damping = drives[moved].torque_constant * motor.back_emf_v_s / motor.resistance_ohm
            found[name] = found.get(name, 0.0) + damping
    return found


@dataclass(frozen=True)
class Truth:
    """True values, scaled to the file's torque constants. note: a sentence about how they differ from the arm's own
    values; "" if they do not.

    A value that depends on the torques of several joints is left out if the constants of these joints are wrong by
    different factors: no single factor converts it.
    """

    values: dict[str, float]
    note: str

    def standard_errors(self, name: str, found: Quantity) -> float | None:
        """The error of an estimate in units of its standard error; None if the true value or the standard error is
        missing.
        """
        if name not in self.values or not 0.0 < found.std < math.inf:
            return None
        return (found.value - self.values[name]) / found.std

    def is_determined(self, name: str, found: Quantity) -> bool:
        """Whether the parameter is known well enough for its relative error to be meaningful."""
        return name in self.values and found.std <= _DETERMINED * abs(self.values[name])


def truth_of(result: Result, config: Config) -> Truth:
    """The true values stored in a result, scaled to the torque constants that the result assumes."""
    return in_file_unit(result.truth or {}, config, result.extra, result.joints)


def scaled(truth: Mapping[str, float] | None, config: Config, extra: Mapping[str, Quantity]) -> dict[str, float] | None:
    """Return `truth` in the scale of a result's parameters, for its `truth_scaled`; None if that changes nothing."""
    found = in_file_unit(truth or {}, config, extra, len(config.joints))
    return found.values if found.note else None


def in_file_unit(truth: Mapping[str, float], config: Config, names: Iterable[str], joints: int) -> Truth:
    """True values scaled to the file's torque constants. names: names of the result's parameters."""
    ratios, has_ratios = _torque_ratios(config), any(kind_of(each) == RATIO for each in names)
    if not truth or all(abs(ratio - 1.0) <= _EQUAL for ratio in ratios):
        return Truth(dict(truth), "")
    factors = {name: _factor(name, ratios, has_ratios, joints) for name in truth}
    values = {name: factor * truth[name] for name, factor in factors.items() if factor is not None}
    named = [
        f"{joint.name} {100 * (1 / ratio - 1):+.2g} %"
        for joint, ratio in zip(config.joints, ratios, strict=True)
        if abs(ratio - 1.0) > _EQUAL
    ]
    note = (
        f"The torque constants in the file differ from those of the fake arm's motors ({', '.join(named)}). The result "
        "assumes the file's constants, so the true values shown are scaled to match"
    )
    left = (
        ""
        if len(values) == len(truth)
        else "; values that depend on several joints whose constants have different errors are not shown"
    )
    return Truth(values, f"{note}{left}.")


def _torque_ratios(config: Config) -> list[float]:
    """Torque per goal of each joint according to the file, divided by that of the fake arm's motor, or 1 if unknown."""
    fake = config.fake
    arm = None if not config.is_fake or fake is None else fake.arm or fake.chain
    if fake is None or arm is None:
        return [1.0] * len(config.joints)
    ratios = [1.0] * len(config.joints)
    for servo, moved in zip(fake.servos, fake.joints, strict=True):
        joint, true = config.joints[moved], arm.drives[moved].torque_constant
        if joint.drive_mode is Mode.PWM:
            true /= load_model(servo.model).resistance_ohm
        ratios[moved] = joint.torque_per_goal / true
    return ratios


def _factor(name: str, ratios: Sequence[float], has_ratios: bool, joints: int) -> float | None:
    """Factor to apply to the true value; None if the joints that determine it have different ratios."""
    if name in TILT or (kind_of(name) in TERMS and not term_of(name).of_torque):
        return 1.0
    if has_ratios:
        return ratios[0]
    last = joint_of(name) or joints
    own_row = kind_of(name) in TERMS and (name not in RIGID_BODY.get(joints, ()) or name.startswith("armature"))
    among = ratios[last - 1 : last] if own_row else ratios[:last]
    return among[0] if max(among) - min(among) <= _EQUAL * among[0] else None
