"""Which servo moves which joint: one each as a rule, two where a joint is driven by a pair.

Two servos on one joint share its angle; the plant is given the sum of their motor currents. What each of them measures
as its own is what it was told, and its part of what the plant's current is off that (the current loop's lag).
"""

from collections.abc import Sequence

from hil.fakes.plants.plant import Plant
from hil.fakes.servo.servo import Servo

States = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Positions [rad], velocities [rad/s] and motor currents [A], one each per servo."""


class Joints:
    """The servos as the plant's joints see them. `of` gives each servo's joint, counted from 0."""

    def __init__(self, servos: Sequence[Servo], plant: Plant, of: Sequence[int] | None = None) -> None:
        self.of = tuple(range(len(servos)) if of is None else of)
        if len(self.of) != len(servos) or set(self.of) != set(range(plant.joints)):
            raise ValueError(f"{len(servos)} servos for a plant of {plant.joints} joints: one servo per joint at least")
        self._servos = tuple(servos)
        self._plant = plant
        self.one_each = self.of == tuple(range(plant.joints))
        """Whether servo i moves joint i, the usual case."""

    def of_joint(self, joint: int) -> list[Servo]:
        """The servos that move a joint."""
        return [servo for servo, moved in zip(self._servos, self.of, strict=True) if moved == joint]

    def commands(self) -> list[float]:
        """What the plant is told: a motor current per joint [A]."""
        commands = [0.0] * self._plant.joints
        for servo, joint in zip(self._servos, self.of, strict=True):
            commands[joint] += servo.motor_current_a
        return commands

    def states(self) -> States:
        """The joints' states as the servos meet them."""
        plant = self._plant
        if self.one_each:
            return plant.position, plant.velocity, plant.current
        position, velocity = plant.position, plant.velocity
        return [position[joint] for joint in self.of], [velocity[joint] for joint in self.of], self._currents()

    def _currents(self) -> list[float]:
        count = [0] * self._plant.joints
        told = [0.0] * self._plant.joints
        strength = [0.0] * self._plant.joints
        for servo, joint in zip(self._servos, self.of, strict=True):
            count[joint] += 1
            told[joint] += servo.motor_current_a
            strength[joint] += abs(servo.motor_current_a)
        current = self._plant.current
        return [
            servo.motor_current_a
            + (current[joint] - told[joint])
            * (abs(servo.motor_current_a) / strength[joint] if strength[joint] else 1.0 / count[joint])
            for servo, joint in zip(self._servos, self.of, strict=True)
        ]
