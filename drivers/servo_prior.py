"""Priors for a servo's friction and rotor inertia: medians as fractions of stall torque, and spreads.

Based on identified X-series servos: Rhoban's bam (dry friction 1.2 to 2.5 % of stall torque, small servos up to 7 %)
and published models of XM430 arms (armature 0.005 to 0.012 kg m^2, viscous friction 0.02 to 0.06 N m s/rad at a stall
torque of 4.1 N m). Small servos with plastic gears vary most. The spreads are wide because none of these values was
measured in this project.
"""

from dataclasses import dataclass
from math import exp, log1p, sqrt

from hil.drivers.servo_model import ServoModel


@dataclass(frozen=True)
class Guess:
    """A log-normally distributed positive quantity: its median and its relative standard deviation."""

    median: float
    spread: float

    @property
    def low(self) -> float:
        """Value one standard deviation (of the logarithm) below the median."""
        return self.median * exp(-sqrt(log1p(self.spread**2)))


@dataclass(frozen=True)
class ServoPrior:
    """Prior distributions for one servo model, referred to its output shaft.

    coulomb: Coulomb friction [N m].
    viscous: viscous friction without back-EMF [N m s/rad].
    armature: reflected rotor inertia [kg m^2].
    mass: mass of the servo [kg].
    stribeck_rise: excess of breakaway friction over Coulomb friction, as a fraction of Coulomb friction [1].
    stribeck_velocity: Stribeck velocity [rad/s].
    lag: time constant of the current loop [s].
    """

    coulomb: Guess
    viscous: Guess
    armature: Guess
    mass: Guess
    stribeck_rise: Guess = Guess(0.3, 0.6)
    stribeck_velocity: Guess = Guess(0.15, 0.6)
    lag: Guess = Guess(1e-3, 0.6)


_MASS = {"XM430": 0.082, "XH430": 0.082, "XM540": 0.165, "XL330": 0.018, "XC330": 0.023, "XL430": 0.0572}
"""Mass by servo family [kg] (e-Manual)."""

_COULOMB_SHARE = Guess(0.016, 0.5)
_SMALL_COULOMB_SHARE = Guess(0.026, 0.75)
_SMALL = ("XL330", "XC330", "XL430")
_VISCOUS_SHARE = Guess(0.009, 0.7)  # fraction of stall torque, per rad/s
_ARMATURE_SHARE = Guess(2.5e-3, 0.5)  # kg m^2 per N m


def servo_prior(model: ServoModel) -> ServoPrior:
    stall, family = stall_torque(model), model.name.split("-")[0]
    share = _SMALL_COULOMB_SHARE if family in _SMALL else _COULOMB_SHARE

    def of_stall(guess: Guess) -> Guess:
        return Guess(guess.median * stall, guess.spread)

    return ServoPrior(
        of_stall(share), of_stall(_VISCOUS_SHARE), of_stall(_ARMATURE_SHARE), Guess(_MASS.get(family, 0.082), 0.1)
    )


def stall_torque(model: ServoModel) -> float:
    """Return the stall torque [N m] at the median of the published voltages."""
    torques = sorted(stall.torque for stall in model.stalls)
    return torques[len(torques) // 2]
