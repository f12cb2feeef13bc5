"""Presliding friction with a law other than the estimator's: parallel springs, each of which slips at its own load.

Iwan, "On a class of models for the yielding behavior of continuous and composite systems", Journal of Applied Mechanics
34 (1967) 612. Unlike bristles, this law remembers every reversal until a larger one erases it, and does not depend on
velocity.
"""

from hil.fakes.plants.arm import Drive
from hil.fakes.plants.motor import Motor

STIFFNESS = (3.0, 1.5, 0.8, 0.4)  # relative stiffness of each spring
SHARE = 1.0 / len(STIFFNESS)  # slip load of each spring, relative to the load at which all slip


class SlippingMotor(Motor):
    """A drive whose dry friction is modelled by four parallel springs that can slip, instead of by bristles."""

    def __init__(self, drive: Drive) -> None:
        super().__init__(drive)
        self._stiffness = [SHARE * each * drive.presliding_stiffness for each in STIFFNESS]
        self._torque = [0.0] * len(STIFFNESS)
        self._slips_at = SHARE * drive.coulomb

    def push(self, step: float, command: float, angle: float, velocity: float) -> tuple[float, float, float, float]:
        bristles, self.bristle_stiffness = self.bristle_stiffness, 0.0
        torque, level, slope, current = super().push(step, command, angle, velocity)
        self.bristle_stiffness = bristles
        self._slips_at = SHARE * level
        half = self._moved(0.5 * step * velocity)
        sticking = sum(k for k, t in zip(self._stiffness, half, strict=True) if abs(t) < self._slips_at)
        damping = self._bristle_damping * sticking / sum(self._stiffness)
        return torque - sum(half) - damping * velocity, 0.0, slope + 0.5 * step * sticking + damping, current

    def bend(self, step: float, velocity: float) -> None:
        self._torque = self._moved(step * velocity)

    def _moved(self, way: float) -> list[float]:
        most = self._slips_at
        return [max(-most, min(most, t + k * way)) for k, t in zip(self._stiffness, self._torque, strict=True)]
