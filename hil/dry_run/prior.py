"""What is known of an arm before anything was identified: masses, lengths and friction, each with its spread.

`[arm.prior]` gives what its author knows. The rest is guessed from link lengths and servo models by rules of thumb
(marked below); they have no better source than a look at a few arms, hence their wide spread.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config, PriorConfig
from hil.drivers.servo_model import Mode, ServoModel
from hil.errors import ConfigError

Array = NDArray[np.float64]

_LINK_MASS_PER_LENGTH = 1.1  # kg/m: printed or aluminium brackets
_CENTRE_SHARE = 0.58  # of the length; a gripper or a weight pulls it outwards
_INERTIA_SHARE = 1 / 12  # of mass times length squared: a rod
_ARMATURE_PER_STALL = 2.5e-3  # kg m^2 per N m of stall torque
_VISCOUS_PER_STALL = 1.05e-2  # N m s/rad per N m
_COULOMB_PER_STALL = 1.3e-2  # N m per N m
_OFFSET_PER_COULOMB = 0.1  # standard deviation of a torque of either sign
_GEAR_EFFICIENCY = 0.6
_STRIBECK_RISE = 0.3
_STRIBECK_VELOCITY = 0.15  # rad/s
_COULOMB_WIDTH = 0.01  # rad/s

_SERVO_MASS = {"XM430": 0.082, "XH430": 0.082, "XM540": 0.165, "XL330": 0.018, "XC330": 0.023, "XL430": 0.0572}
"""kg, by family (e-Manual)."""


@dataclass(frozen=True)
class Quantity:
    """One physical quantity of every joint or link (joints,) and its relative standard deviation."""

    value: Array
    spread: float

    def draw(self, random: np.random.Generator, count: int) -> Array:
        """`count` draws (count, joints), log-normal with median `value`."""
        log_spread = np.sqrt(np.log1p(self.spread**2))
        drawn: Array = self.value * np.exp(log_spread * random.standard_normal((count, self.value.size)))
        return drawn


def base_draws(config: Config, count: int, seed: int) -> dict[str, Array]:
    """Base parameters and friction terms by the estimator's names, `count` draws each (count,) [SI].

    Raises ConfigError without link lengths.
    """
    lengths = config.arm.link_lengths
    if lengths is None:
        raise ConfigError(
            f"{config.path}: a dry run needs arm.link_lengths = [...] in m, one for each of [[joints]], or the run "
            "folder of a former identification (--result)."
        )
    random = np.random.default_rng((seed, 5))
    drawn = {name: quantity.draw(random, count) for name, quantity in quantities(config, np.array(lengths)).items()}
    offset = _OFFSET_PER_COULOMB * drawn["coulomb"] * random.standard_normal(drawn["coulomb"].shape)
    return _base(drawn, np.array(lengths), config.arm.gravity) | {
        f"offset_{joint + 1}": offset[:, joint] for joint in range(offset.shape[1])
    }


def quantities(config: Config, lengths: Array) -> dict[str, Quantity]:
    """What is drawn, by the names of `[arm.prior]`."""
    given = config.arm.prior or PriorConfig()
    models = [joint.joint.servo for joint in config.joints]
    stall = np.array([_stall_torque(model) for model in models])
    rough = {
        "link_mass": _LINK_MASS_PER_LENGTH * lengths,
        "link_centre": _CENTRE_SHARE * lengths,
        "servo_mass": np.array([_SERVO_MASS.get(model.name.split("-")[0], 0.082) for model in models]),
        "armature": _ARMATURE_PER_STALL * stall,
        "viscous": _VISCOUS_PER_STALL * stall + _generated(config),
        "coulomb": _COULOMB_PER_STALL * stall,
    }
    chosen = {name: _chosen(given, name, guess) for name, guess in rough.items()}
    rod = _INERTIA_SHARE * chosen["link_mass"].value * lengths**2
    chosen["link_inertia"] = _chosen(given, "link_inertia", rod)
    chosen["stribeck_rise"] = Quantity(np.full(len(models), _STRIBECK_RISE), given.rough_spread)
    return chosen


def _chosen(given: PriorConfig, name: str, guess: Array) -> Quantity:
    values = getattr(given, name)
    return Quantity(guess, given.rough_spread) if values is None else Quantity(np.array(values), given.spread)


def _stall_torque(model: ServoModel) -> float:
    """N m at the middle one of the published voltages."""
    torques = sorted(stall.torque for stall in model.stalls)
    return torques[len(torques) // 2]


def _generated(config: Config) -> Array:
    """What turning motors take from the torque of an applied voltage, as viscous friction (joints,) [N m s/rad].

    A motor generates as many V s/rad as it gives N m/A before the gears' losses. Under current control: nothing.
    """
    emf = np.array([joint.joint.servo.torque_per_ampere.value / _GEAR_EFFICIENCY for joint in config.joints])
    per_volt = [joint.torque_per_goal if joint.drive_mode is Mode.PWM else 0.0 for joint in config.joints]
    return np.asarray(np.array(per_volt) * emf)


def _base(drawn: dict[str, Array], lengths: Array, gravity: float) -> dict[str, Array]:
    """From physical quantities to base parameters; the table in docs/model.md."""
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
        for term in ("viscous", "coulomb", "stribeck_rise"):
            base[f"{term}_{joint + 1}"] = drawn[term][:, joint]
        base[f"stribeck_velocity_{joint + 1}"] = np.full(len(mass), _STRIBECK_VELOCITY)
        base[f"coulomb_width_{joint + 1}"] = np.full(len(mass), _COULOMB_WIDTH)
    return base
