"""The emulated servos' own record: goals, motor currents and motion, every millisecond."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.fakes.bus.bus import FakeBus
from hil.fakes.servo.servo import EmulatedServo

STEP_S = 1e-3
CURRENT_MODE, PWM_MODE = 0, 16

RECORD = np.dtype(
    [
        ("time", "f8"),
        ("driven", "?"),
        ("torque", "?"),
        ("goal", "i4"),
        ("current", "f8"),
        ("position", "f8"),
        ("velocity", "f8"),
    ]
)


class Witness:
    """Replaces the plant and forwards every step unchanged, recording it."""

    def __init__(self, bus: FakeBus) -> None:
        self._plant = bus.plant
        self._servos: tuple[EmulatedServo, ...] = bus._servos
        self._next = bus.time + STEP_S
        self._rows: list[list[tuple[Any, ...]]] = []
        self.joints = bus.plant.joints
        bus.plant = self

    @property
    def position(self) -> Sequence[float]:
        return self._plant.position

    @property
    def velocity(self) -> Sequence[float]:
        return self._plant.velocity

    @property
    def current(self) -> Sequence[float]:
        return self._plant.current

    def jam(self, joint: int, jammed: bool) -> None:
        self._plant.jam(joint, jammed)  # type: ignore[attr-defined]

    def advance(self, until: float, current: Sequence[float]) -> None:
        plant = self._plant
        while self._next <= until:
            plant.advance(self._next, current)
            self._rows.append(
                [
                    (self._next, *_told(servo), *state)
                    for servo, *state in zip(self._servos, plant.current, plant.position, plant.velocity, strict=True)
                ]
            )
            self._next += STEP_S
        plant.advance(until, current)

    def record(self) -> NDArray[Any]:
        """The record so far (milliseconds, joints), with dtype `RECORD`."""
        return np.array(self._rows, dtype=RECORD).reshape(-1, self.joints)


def _told(servo: EmulatedServo) -> tuple[bool, bool, int]:
    """Whether the servo drives its motor, whether torque is on, and the goal in its mode [ticks]."""
    memory = servo.memory
    torque = memory.get("Torque Enable") == 1
    mode = memory.get("Operating Mode")
    if mode == CURRENT_MODE:
        goal = memory.get("Goal Current")
    elif mode == PWM_MODE:
        goal = memory.get("Goal PWM")
    else:
        goal = int(torque)  # position and velocity control drive the motor whenever torque is on
    return torque and goal != 0, torque, goal
