"""An arm with gear backlash: each joint has a rotor and an output shaft, which are in contact at the ends of a gap.

The rotor, whose inertia is multiplied by the gear ratio squared, is subject to the motor's torque, all friction and the
hard stops. The links and the servos' encoders are attached to the output shafts. Within the gap, no torque is
transmitted between rotor and output shaft; at the ends of the gap, the gears act as a spring and a damper that can push
but not pull.

The contact is stiff: such an arm takes about ten times as long to simulate as one without backlash.
"""

from collections.abc import Sequence
from math import ceil, cos, isfinite, sin, sqrt
from typing import NoReturn

from hil.fakes.plants.arm import Arm, Drive, Link, armature
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.motor import Motor

STEP = 50e-6  # s: short compared with the period of the gears' vibration, unless the links are very light
_PER_RADIAN = 0.3  # largest step, relative to the time in which that vibration advances by 1 rad
_PER_DAMPING = 0.5  # the same, relative to the time constant of its damping


class GearedArm:
    """An arm of one or two joints with backlash; see `hil.fakes.plants.plant.Plant`."""

    def __init__(self, arm: Arm) -> None:
        self._rotors = [_Rotor(drive, angle) for drive, angle in zip(arm.drives, arm.start, strict=True)]
        self._links = _Links(arm)
        self._time = 0.0
        self.step = self._longest_step(arm)
        """Longest time step [s]."""

    def _longest_step(self, arm: Arm) -> float:
        """Return the longest step [s] for which integration is stable at the stiffest contact of gears and links."""
        lightness = self._links.lightness + 1.0 / min(armature(drive) for drive in arm.drives)
        stiffness = max(drive.gear_stiffness for drive in arm.drives)
        damping = max(drive.gear_damping for drive in arm.drives)
        vibration = _PER_RADIAN / sqrt(stiffness * lightness)
        return min(STEP, vibration, _PER_DAMPING / (damping * lightness) if damping else STEP)

    @property
    def joints(self) -> int:
        return len(self._rotors)

    @property
    def position(self) -> Sequence[float]:
        return self._links.angle

    @property
    def velocity(self) -> Sequence[float]:
        return self._links.velocity

    @property
    def current(self) -> Sequence[float]:
        return [rotor.motor.current for rotor in self._rotors]

    @property
    def rotor_angle(self) -> Sequence[float]:
        """Rotor angles, referred to the joints [rad]."""
        return [rotor.angle for rotor in self._rotors]

    @property
    def rotor_velocity(self) -> Sequence[float]:
        """Rotor velocities, referred to the joints [rad/s]."""
        return [rotor.velocity for rotor in self._rotors]

    def jam(self, joint: int, jammed: bool) -> None:
        self._rotors[joint].motor.jammed = jammed

    def hold(self, joint: int, velocity: float | None) -> None:
        self._rotors[joint].motor.held_at = velocity

    def advance(self, until: float, current: Sequence[float]) -> None:
        remaining = until - self._time
        if remaining <= 0.0:
            return
        for rotor in self._rotors:
            rotor.motor.warm_up(self._time)
        self._time = until
        links = self._links
        steps = ceil(remaining / self.step)
        try:
            self._move(steps, remaining / steps, current)
        except ValueError:  # the cosine of an infinite angle
            self._diverged()
        if not all(map(isfinite, (*links.angle, *links.velocity))):
            self._diverged()

    def _diverged(self) -> NoReturn:
        raise PlantError(
            f"The arm with backlash became unstable in simulation at {self._time:g} s, with a time step of "
            f"{1e6 * self.step:.2g} us: lower gear_stiffness, gear_damping or stop_stiffness, or give its links more "
            "inertia"
        ) from None

    def _move(self, steps: int, step: float, current: Sequence[float]) -> None:
        links = self._links
        for _ in range(steps):
            contact = [
                rotor.contact(angle, velocity)
                for rotor, angle, velocity in zip(self._rotors, links.angle, links.velocity, strict=True)
            ]
            for rotor, command, torque in zip(self._rotors, current, contact, strict=True):
                rotor.move(step, command, torque)
            links.move(step, contact)


class _Rotor:
    """Motor and gears of one joint, referred to the joint."""

    def __init__(self, drive: Drive, angle: float) -> None:
        self.motor = Motor(drive)
        self.angle = angle
        self.velocity = 0.0
        self._inertia = armature(drive)
        self._half_gap = 0.5 * drive.backlash
        self._stiffness = drive.gear_stiffness
        self._damping = drive.gear_damping

    def contact(self, angle: float, velocity: float) -> float:
        """Return the torque that the gears transmit to an output shaft at this angle and velocity [N m]."""
        ahead = self.angle - angle
        if abs(ahead) <= self._half_gap:
            return 0.0
        depth = ahead - self._half_gap if ahead > 0.0 else ahead + self._half_gap
        torque = self._stiffness * depth + self._damping * (self.velocity - velocity)
        return torque if torque * depth > 0.0 else 0.0

    def move(self, step: float, command: float, contact: float) -> None:
        v = self.velocity
        push, level, slope, self.motor.current = self.motor.push(step, command, self.angle, v)
        impulse = self._inertia * v + step * (push - contact + slope * v)
        dry = step * level
        left = impulse - dry if impulse > dry else impulse + dry if impulse < -dry else 0.0
        self.velocity = left / (self._inertia + step * (self.motor.viscous + slope))
        self.motor.bend(step, 0.5 * (v + self.velocity))
        self.angle += step * self.velocity


class _Links:
    """The links alone, moved by the torques at their joints."""

    def __init__(self, arm: Arm) -> None:
        self.angle = list(arm.start)
        self.velocity = [0.0] * len(arm.links)
        first = arm.links[0]
        self._first = _about_joint(first)
        self._weight_first = first.mass * first.centre * arm.weight
        if len(arm.links) == 2:
            second = arm.links[1]
            beyond = second.mass + arm.drives[1].mass
            self._first += beyond * first.length**2
            self._weight_first += beyond * first.length * arm.weight
            self._second = _about_joint(second)
            self._swing = second.mass * first.length * second.centre
            self._weight_second = second.mass * second.centre * arm.weight

    @property
    def lightness(self) -> float:
        """Upper bound on the acceleration per unit of joint torque in any pose [1/(kg m^2)]: the largest ratio of trace
        to determinant of the mass matrix.
        """
        if len(self.angle) == 1:
            return 1.0 / self._first
        bound = 0.0
        for cosine in (-1.0, 0.0, 1.0):
            m22, m12 = self._second, self._second + self._swing * cosine
            m11 = self._first + self._swing * cosine + m12
            bound = max(bound, (m11 + m22) / (m11 * m22 - m12 * m12))
        return bound

    def move(self, step: float, torque: Sequence[float]) -> None:
        acceleration = self._one(torque[0]) if len(torque) == 1 else self._two(*torque)
        for joint, rate in enumerate(acceleration):
            self.velocity[joint] += step * rate
            self.angle[joint] += step * self.velocity[joint]

    def _one(self, torque: float) -> tuple[float]:
        return ((torque - self._weight_first * cos(self.angle[0])) / self._first,)

    def _two(self, torque_1: float, torque_2: float) -> tuple[float, float]:
        q1, q2 = self.angle
        w1 = self.velocity[0]
        w2 = w1 + self.velocity[1]
        across, turning = self._swing * cos(q2), self._swing * sin(q2)
        m22 = self._second
        m12 = m22 + across
        m11 = self._first + across + m12
        weight_2 = self._weight_second * cos(q1 + q2)
        b1 = torque_1 + turning * (w2 * w2 - w1 * w1) - self._weight_first * cos(q1) - weight_2
        b2 = torque_2 - turning * w1 * w1 - weight_2
        determinant = m11 * m22 - m12 * m12
        return (m22 * b1 - m12 * b2) / determinant, (m11 * b2 - m12 * b1) / determinant


def _about_joint(link: Link) -> float:
    return link.inertia + link.mass * link.centre**2
