"""Prior knowledge of a servo's friction and rotor: medians as fractions of stall torque, and spread.

From identified X-series servos: Rhoban's bam (dry friction of 1.2 to 2.5 % of stall torque, small servos up to 7 %),
published models of XM430 arms (armature 0.005 to 0.012 kg m^2, viscous 0.02 to 0.06 N m s/rad at 4.1 N m). Plastic
gears of small servos vary most. None of it was measured here, hence the wide spread.
"""

from dataclasses import dataclass

from hil.drivers.servo_model import ServoModel


@dataclass(frozen=True)
class Guess:
    """A positive quantity: its median, and the relative standard deviation of a log-normal about it."""

    median: float
    spread: float


@dataclass(frozen=True)
class ServoPrior:
    """Of one model, at its output shaft.

    coulomb [N m], viscous without back-EMF [N m s/rad], armature [kg m^2], mass [kg], stribeck_rise [1],
    stribeck_velocity [rad/s], lag of the current loop [s].
    """

    coulomb: Guess
    viscous: Guess
    armature: Guess
    mass: Guess
    stribeck_rise: Guess = Guess(0.3, 0.6)
    stribeck_velocity: Guess = Guess(0.15, 0.6)
    lag: Guess = Guess(1e-3, 0.6)


_MASS = {"XM430": 0.082, "XH430": 0.082, "XM540": 0.165, "XL330": 0.018, "XC330": 0.023, "XL430": 0.0572}
"""kg, by family (e-Manual)."""

_COULOMB_SHARE = Guess(0.016, 0.5)
_SMALL_COULOMB_SHARE = Guess(0.026, 0.75)
_SMALL = ("XL330", "XC330", "XL430")
_VISCOUS_SHARE = Guess(0.009, 0.7)  # of stall torque per rad/s
_ARMATURE_SHARE = Guess(2.5e-3, 0.5)  # kg m^2 per N m


def servo_prior(model: ServoModel) -> ServoPrior:
    """The guesses for a model."""
    stall, family = stall_torque(model), model.name.split("-")[0]
    share = _SMALL_COULOMB_SHARE if family in _SMALL else _COULOMB_SHARE

    def of_stall(guess: Guess) -> Guess:
        return Guess(guess.median * stall, guess.spread)

    return ServoPrior(
        of_stall(share), of_stall(_VISCOUS_SHARE), of_stall(_ARMATURE_SHARE), Guess(_MASS.get(family, 0.082), 0.1)
    )


def stall_torque(model: ServoModel) -> float:
    """N m at the middle one of the published voltages."""
    torques = sorted(stall.torque for stall in model.stalls)
    return torques[len(torques) // 2]
