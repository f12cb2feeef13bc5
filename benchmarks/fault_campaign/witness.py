"""The emulated servos' own record: goals, motor currents and motion, every millisecond."""

import math
from array import array
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.fault_campaign.attack import Attack, Kind
from hil.fakes.bus.bus import FakeBus
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.servo import EmulatedServo
from hil.fakes.servo.write_rules import WATCHDOG_TRIPPED

STEP_S = 1e-3
CURRENT_MODE, PWM_MODE = 0, 16
GRIP_RAD_S = 0.1
"""Velocity of the arm at which a hand that grips it brakes with most of its force [rad/s]."""

SLIPS_S = 0.05
"""Time that a joint takes to slip on its shaft [s]."""

HALF = 0.5
"""Fraction of the torque constant that a motor loses when its magnet overheats."""

SOFT_RAD = 0.02
"""Distance over which an obstacle, or a cable that snags, reaches its full force [rad]."""

PUSH_RISES_S = 0.03
"""Rise time of a push [s]: no hand is faster."""

RECORD = np.dtype(
    [
        ("time", "f8"),
        ("driven", "?"),
        ("torque", "?"),
        ("goal", "i4"),
        ("id", "i4"),
        ("current", "f8"),
        ("position", "f8"),
        ("velocity", "f8"),
    ]
)


class Witness:
    """Wraps the plant and records every step. Its only effects on the plant are those requested with `disturb`."""

    def __init__(self, bus: FakeBus) -> None:
        self._plant = bus.plant
        self._servos = bus._servos
        self._tell = [_teller(servo) for servo in bus._servos]
        self._next = bus.time + STEP_S
        self._times: list[float] = []
        self._goals: list[tuple[tuple[bool, bool, int, int], ...]] = []
        self._motion = array("d")  # currents, positions and velocities of all joints, row by row
        self._disturbed: list[tuple[int, Attack]] = []
        self._missing = [0.0] * bus.plant.joints
        self._turned_at = [(0.0, -1.0)] * bus.plant.joints  # sign of the current, and when it changed
        self._largest = [0.0] * bus.plant.joints
        self._found_at: dict[tuple[int, Attack], float] = {}
        self._slipped = [0.0] * bus.plant.joints
        self._slips = [0.0] * bus.plant.joints
        self.joints = bus.plant.joints
        bus.plant = self

    @property
    def position(self) -> Sequence[float]:
        """Angles of the servos' shafts: those of the joints, unless one has slipped."""
        if not any(self._slipped):
            return self._plant.position
        return tuple(angle + slipped for angle, slipped in zip(self._plant.position, self._slipped, strict=True))

    @property
    def velocity(self) -> Sequence[float]:
        if not any(self._slips):
            return self._plant.velocity
        return tuple(speed + slips for speed, slips in zip(self._plant.velocity, self._slips, strict=True))

    @property
    def current(self) -> Sequence[float]:
        """Motor currents as sensed by the servos: a weak motor carries its full current; an external push adds none."""
        if not self._disturbed:
            return self._plant.current
        return tuple(current + missing for current, missing in zip(self._plant.current, self._missing, strict=True))

    def disturb(self, joint: int, attack: Attack) -> None:
        """Apply an attack to the joint's motor for the duration of the attack."""
        self._disturbed.append((joint, attack))

    def _driven_by(self, current: Sequence[float], now: float) -> Sequence[float]:
        """Currents that have the same effect on the undisturbed plant as `current` has on the disturbed arm."""
        felt = list(current)
        self._missing = [0.0] * self.joints
        for joint, each in self._disturbed:
            self._largest[joint] = max(self._largest[joint], abs(current[joint]))
            if not each.start <= now < each.end:
                continue
            before, most = felt[joint], each.amount * self._largest[joint]
            match each.kind:
                case Kind.WEAK:
                    # A weaker motor induces less voltage, and a reversed motor the opposite voltage.
                    before += (1.0 - each.amount) * self._held_back(joint)
                    felt[joint] = each.amount * before
                    self._missing[joint] += before - felt[joint]
                case Kind.SATURATED:
                    felt[joint] = max(-most, min(most, before))
                case Kind.GRIPPED:
                    felt[joint] = before - most * math.tanh(self._plant.velocity[joint] / GRIP_RAD_S)
                    self._missing[joint] += before - felt[joint]
                case Kind.PLAY:
                    felt[joint] = 0.0 if self._turns(joint, before, now) < each.amount else before
                    self._missing[joint] += before - felt[joint]
                case Kind.PUSHED:
                    felt[joint] = before + most * min(1.0, (now - each.start) / PUSH_RISES_S)
                    self._missing[joint] += before - felt[joint]
                case Kind.SLIP:
                    self._slip(joint, each, now)
                case Kind.FADING:
                    felt[joint] = before * (1.0 - HALF * min(1.0, (now - each.start) / each.amount))
                    self._missing[joint] += before - felt[joint]
                case _:
                    felt[joint] = before + most * self._resists(joint, each)
                    self._missing[joint] += before - felt[joint]
        return felt

    def _held_back(self, joint: int) -> float:
        """Current lost to back-EMF in a voltage-driven motor [A]; 0 for a current-driven motor."""
        servo = self._servos[joint]
        if servo.operating_mode != PWM_MODE:
            return 0.0
        return servo.model.back_emf_v_s * self._plant.velocity[joint] / servo.model.resistance_ohm

    def _slip(self, joint: int, attack: Attack, now: float) -> None:
        done = min(1.0, (now - attack.start) / SLIPS_S)
        self._slips[joint] = attack.amount / SLIPS_S if done < 1.0 else 0.0
        self._slipped[joint] = attack.amount * done

    def _resists(self, joint: int, attack: Attack) -> float:
        """Force of an obstacle, a snagged cable, or a changed load, as a fraction of the attack's amount."""
        angles = self._plant.position
        found = self._found_at.setdefault((joint, attack), angles[joint])
        way = max(-1.0, min(1.0, (angles[joint] - found) / SOFT_RAD))
        if attack.kind == Kind.SNAG:
            return -way
        if attack.kind == Kind.OBSTACLE:
            forward = math.copysign(1.0, attack.amount)
            return -max(0.0, forward * way)
        return math.cos(sum(angles[: joint + 1]))

    def _turns(self, joint: int, current: float, now: float) -> float:
        """Time since the current last changed sign [s]."""
        sign, since = self._turned_at[joint]
        if current * sign < 0.0 or sign == 0.0:
            self._turned_at[joint] = sign, since = math.copysign(1.0, current), now
        return now - since

    def jam(self, joint: int, jammed: bool) -> None:
        self._plant.jam(joint, jammed)  # type: ignore[attr-defined]

    def advance(self, until: float, current: Sequence[float]) -> None:
        plant, now = self._plant, self._next
        if now <= until:  # the attributes are looked up once, since most of a campaign's runs are spent here
            told = tuple([tell() for tell in self._tell])  # no servo receives anything within this time
            advance, record, disturbed = plant.advance, self._motion.extend, self._disturbed
            while now <= until:
                advance(now, self._driven_by(current, now) if disturbed else current)
                self._times.append(now)
                self._goals.append(told)
                record(plant.current)
                record(plant.position)
                record(plant.velocity)
                now += STEP_S
            self._next = now
        plant.advance(until, self._driven_by(current, until) if self._disturbed else current)

    def record(self) -> NDArray[Any]:
        """The record so far (milliseconds, joints), with dtype `RECORD`."""
        record = np.empty((len(self._times), self.joints), RECORD)
        record["time"] = np.array(self._times)[:, None]
        goals = np.array(self._goals, dtype=np.int64).reshape(-1, self.joints, 4)
        record["driven"], record["torque"], record["goal"], record["id"] = np.moveaxis(goals, -1, 0)
        motion = np.frombuffer(self._motion).reshape(-1, 3, self.joints)
        record["current"], record["position"], record["velocity"] = np.moveaxis(motion, 1, 0)
        return record


def _teller(servo: EmulatedServo) -> Callable[[], tuple[bool, bool, int, int]]:
    """Return a function that returns whether the servo drives its motor, whether torque is on, its goal [ticks] and its
    ID.
    """
    memory = servo.memory
    names = "Torque Enable", "Operating Mode", "ID", "Bus Watchdog"
    torque_at, mode_at, id_at, watchdog_at = (memory.registers[name].address for name in names)
    current_at, pwm_at = (_bytes_of(memory, name) for name in ("Goal Current", "Goal PWM"))

    def tell() -> tuple[bool, bool, int, int]:
        data = memory.data  # called every millisecond: looking up registers by name takes five times as long
        torque, mode = data[torque_at] == 1, data[mode_at]
        if mode == CURRENT_MODE:
            goal = int.from_bytes(data[current_at], "little", signed=True)
        elif mode == PWM_MODE:
            goal = int.from_bytes(data[pwm_at], "little", signed=True)
        else:
            # Position and velocity control drive the motor whenever torque is on, unless the watchdog has stopped it.
            goal = int(torque and data[watchdog_at] != WATCHDOG_TRIPPED)
        return torque and goal != 0, torque, goal, data[id_at]

    return tell


def _bytes_of(memory: Memory, name: str) -> slice:
    """Slice of the register's bytes in the memory; empty if the model does not have the register."""
    register = memory.registers.get(name)
    return slice(0) if register is None else slice(register.address, register.address + register.size)
