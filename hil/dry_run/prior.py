"""Prior knowledge of an arm before identification: masses, lengths and friction, each with its spread.

`[arm.prior]` gives what the user knows. The rest is estimated from link lengths by the rules of thumb below, and from
the servo models (hil.drivers.servo_prior).
"""

from dataclasses import dataclass

import numpy as np

from hil.config.schema import Config, PriorConfig
from hil.drivers.servo_model import Mode
from hil.drivers.servo_prior import servo_prior, stall_torque
from hil.errors import ConfigError
from hil.estimation.model_from_config import voltage_driven
from hil.estimator.arrays import Array
from hil.estimator.models.terms import term_of

_LINK_MASS_PER_LENGTH = 1.1  # kg/m, for XM430 servos with printed or aluminium brackets
_USUAL_STALL = 4.1  # N m, stall torque of those servos; weaker servos carry lighter links
_STALL_POWER = 0.4
_CENTRE_SHARE = 0.6  # fraction of the length; a gripper or weight shifts the centre of mass outwards
_CENTRE_SPREAD = 0.3
_INERTIA_SHARE = 1 / 12  # fraction of mass times length squared, as for a rod
_ROUGH_SPREAD = 0.5
_OFFSET_PER_COULOMB = 0.1  # standard deviation of the offset relative to the Coulomb friction
_ZERO_STD = 0.03  # rad, typical error of a zero set by eye
_GEAR_EFFICIENCY = 0.6
_GENERATED_SPREAD = 0.25  # relative standard deviation of the back-EMF
_COULOMB_WIDTH = 0.01  # rad/s


@dataclass(frozen=True)
class Quantity:
    """One physical quantity for every joint or link (joints,), with its relative standard deviation (joints,)."""

    value: Array
    spread: Array

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """Draw `count` samples (count, joints) from log-normal distributions with median `value`."""
        log_spread = np.sqrt(np.log1p(self.spread**2))
        drawn: Array = self.value * np.exp(log_spread * random.standard_normal((count, self.value.size)))
        return drawn


def base_draws(config: Config, count: int, seed: int) -> dict[str, Array]:
    """Draw `count` values (count,) [SI] of each base parameter, friction term, encoder zero and lag, keyed by the
    estimator's names.

    Raises ConfigError if the link lengths are missing.
    """
    lengths = config.arm.link_lengths
    if lengths is None:
        raise ConfigError(
            f"{config.path}: the effect of a torque on this arm cannot be predicted without its link lengths. Measure "
            "from joint to joint and to the tip with a ruler, and set arm.link_lengths = [...] in m, one per "
            "[[joints]] table; or use an earlier identification in the dry run (--result)."
        )
    random = np.random.default_rng((seed, 5))
    drawn = {name: quantity.draw(random, count) for name, quantity in quantities(config, np.array(lengths)).items()}
    offset = _OFFSET_PER_COULOMB * drawn["coulomb"] * random.standard_normal(drawn["coulomb"].shape)
    zero = _ZERO_STD * random.standard_normal(offset.shape)
    base = _base(drawn, np.array(lengths), config.arm.gravity)
    for joint in range(offset.shape[1]):
        base |= {f"offset_{joint + 1}": offset[:, joint], f"zero_{joint + 1}": zero[:, joint]}
    for joint in voltage_driven(config):
        base[f"back_emf_{joint}"] = np.full(count, term_of("back_emf").initial)
    # The model has one lag for all joints: the servos are similar, so the first joint's is used.
    return base | {"lag": drawn["lag"][:, 0]}


def quantities(config: Config, lengths: Array) -> dict[str, Quantity]:
    """The quantities to draw, keyed by the names in `[arm.prior]`, plus the Stribeck terms and the lag."""
    given = config.arm.prior or PriorConfig()
    models = [joint.joint.servo for joint in config.joints]
    priors = [servo_prior(model) for model in models]
    size = np.array([(stall_torque(model) / _USUAL_STALL) ** _STALL_POWER for model in models])

    def quantity(name: str, value: Array, spread: float | Array) -> Quantity:
        known = getattr(given, name, None)
        if known is not None:
            return Quantity(np.array(known), np.full(len(models), given.spread))
        return Quantity(
            value, np.broadcast_to(spread if given.rough_spread is None else given.rough_spread, len(models))
        )

    def of_servo(name: str, more: Array | float = 0.0) -> Quantity:
        guesses = [getattr(prior, name) for prior in priors]
        value, spread = np.array([(guess.median, guess.spread) for guess in guesses]).T
        return quantity(name, value + more, np.hypot(spread * value, _GENERATED_SPREAD * more) / (value + more))

    chosen = {
        "link_mass": quantity("link_mass", _LINK_MASS_PER_LENGTH * size * lengths, _ROUGH_SPREAD),
        "link_centre": quantity("link_centre", _CENTRE_SHARE * lengths, _CENTRE_SPREAD),
        "servo_mass": of_servo("mass"),
        "armature": of_servo("armature"),
        "viscous": of_servo("viscous", _generated(config)),
        "coulomb": of_servo("coulomb"),
        "stribeck_rise": of_servo("stribeck_rise"),
        "stribeck_velocity": of_servo("stribeck_velocity"),
        "lag": of_servo("lag"),
    }
    rod = _INERTIA_SHARE * chosen["link_mass"].value * lengths**2
    chosen["link_inertia"] = quantity("link_inertia", rod, _ROUGH_SPREAD)
    return chosen


def _generated(config: Config) -> Array:
    """Back-EMF under voltage control, expressed as viscous friction (joints,) [N m s/rad].

    The back-EMF constant [V s/rad] equals the torque constant [N m/A] before gear losses. The result is zero under
    current control.
    """
    emf = np.array([joint.joint.servo.torque_per_ampere.value / _GEAR_EFFICIENCY for joint in config.joints])
    per_volt = [joint.torque_per_goal if joint.drive_mode is Mode.PWM else 0.0 for joint in config.joints]
    return np.asarray(np.array(per_volt) * emf)


def _base(drawn: dict[str, Array], lengths: Array, gravity: float) -> dict[str, Array]:
    """Convert physical quantities to base parameters, following the table in docs/model.md."""
    mass, centre, inertia = drawn["link_mass"], drawn["link_centre"], drawn["link_inertia"]
    about = inertia + mass * centre**2
    base = {
        "inertia_1": about[:, 0] + drawn["armature"][:, 0],
        "gravity_1": mass[:, 0] * centre[:, 0] * gravity,
    }
    if mass.shape[1] == 2:
        beyond = mass[:, 1] + drawn["servo_mass"][:, 1]
        base |= {
            "inertia_1": base["inertia_1"] + beyond * lengths[0] ** 2,
            "gravity_1": base["gravity_1"] + beyond * lengths[0] * gravity,
            "coupling": mass[:, 1] * lengths[0] * centre[:, 1],
            "inertia_2": about[:, 1],
            "armature_2": drawn["armature"][:, 1],
            "gravity_2": mass[:, 1] * centre[:, 1] * gravity,
        }
    for joint in range(mass.shape[1]):
        for term in ("viscous", "coulomb", "stribeck_rise", "stribeck_velocity"):
            base[f"{term}_{joint + 1}"] = drawn[term][:, joint]
        base[f"coulomb_width_{joint + 1}"] = np.full(len(mass), _COULOMB_WIDTH)
    return base
