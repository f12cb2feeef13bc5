"""Assignment of servos to joints: usually one per joint, or two if the joint is driven by a pair.

Two servos on one joint share its angle; the plant receives the sum of their motor currents. Each servo measures the
current that it commands, plus its share of the deviation due to the current loop's lag.
"""

from collections.abc import Sequence

from hil.fakes.plants.plant import Plant
from hil.fakes.servo.servo import EmulatedServo

States = tuple[Sequence[float], Sequence[float], Sequence[float]]
"""Positions [rad], velocities [rad/s] and motor currents [A], one value per servo."""


class Joints:
    """Maps between servos and the plant's joints. `of` is the joint index of each servo."""

    def __init__(self, servos: Sequence[EmulatedServo], plant: Plant, of: Sequence[int] | None = None) -> None:
        self.of = tuple(range(len(servos)) if of is None else of)
        if len(self.of) != len(servos) or set(self.of) != set(range(plant.joints)):
            raise ValueError(f"{len(servos)} servos for a plant of {plant.joints} joints: each joint needs a servo")
        self._servos = tuple(servos)
        self._plant = plant
        self.one_each = self.of == tuple(range(plant.joints))
        """Whether servo i moves joint i, as is usually the case."""

    def of_joint(self, joint: int) -> list[EmulatedServo]:
        return [servo for servo, moved in zip(self._servos, self.of, strict=True) if moved == joint]

    def commands(self) -> list[float]:
        """Return the motor current commanded to each joint of the plant [A]."""
        commands = [0.0] * self._plant.joints
        for servo, joint in zip(self._servos, self.of, strict=True):
            commands[joint] += servo.motor_current_a
        return commands

    def states(self) -> States:
        """Return the joint states, one value per servo."""
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
