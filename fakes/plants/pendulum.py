"""An arm with one link and one joint: the plant of `hil.fakes.plants.two_link` without its second link."""

from collections.abc import Sequence
from math import ceil, copysign, cos

from hil.fakes.plants.arm import Arm, armature
from hil.fakes.plants.motor import SHORTEST_STEP, Motor


class Pendulum:
    """A one-joint arm; see `hil.fakes.plants.plant.Plant`. `velocity` is the joint's velocity at time 0 [rad/s]."""

    def __init__(self, arm: Arm, velocity: Sequence[float] = (0.0,)) -> None:
        (link,) = arm.links
        self._motor = Motor(arm.drives[0])
        self._inertia = link.inertia + link.mass * link.centre**2 + armature(arm.drives[0])
        self._weight = link.mass * link.centre * arm.weight
        self._time = 0.0
        (self._q,) = arm.start
        (self._v,) = velocity
        self._a = 0.0

    @property
    def joints(self) -> int:
        return 1

    @property
    def position(self) -> tuple[float]:
        return (self._q,)

    @property
    def velocity(self) -> tuple[float]:
        return (self._v,)

    @property
    def current(self) -> tuple[float]:
        return (self._motor.current,)

    def jam(self, joint: int, jammed: bool) -> None:
        self._motor.jammed = jammed

    def hold(self, joint: int, velocity: float | None) -> None:
        self._motor.held_at = velocity

    def advance(self, until: float, current: Sequence[float]) -> None:
        remaining = until - self._time
        if remaining <= 0.0:
            return
        self._motor.warm_up(self._time)
        self._time = until
        (command,) = current
        steps = ceil(remaining / self._motor.longest_step)
        step = remaining / steps
        for _ in range(steps):
            taken = self._step(step, command, True)
            if taken < step:
                self._step(step - taken, command, False)

    def _step(self, step: float, command: float, cut: bool) -> float:
        """Take one step and return its length [s]; with `cut`, end the step where the velocity changes sign."""
        half = 0.5 * step
        v = self._v
        middle_v = v + half * self._a if v else 0.0
        q = self._q + half * v
        push, level, slope, current = self._motor.push(step, command, q, middle_v)
        damp = half * (self._motor.viscous + slope)
        impulse = (self._inertia - damp) * v + step * (push - self._weight * cos(q) + slope * middle_v)
        dry = step * level
        new = (impulse - (dry if v > 0.0 else -dry)) / (self._inertia + damp)
        if level and new * v <= 0.0:
            if cut and v:
                shorter = step * v / (v - new)
                if SHORTEST_STEP < shorter < step - SHORTEST_STEP:
                    return self._step(shorter, command, False)
            # Friction takes just enough of the impulse to bring the joint to rest, up to its limit.
            new = copysign(max(abs(impulse) - dry, 0.0), impulse) / (self._inertia + damp)
        self._a = (new - v) / step
        self._motor.bend(step, 0.5 * (v + new))
        self._v = new
        self._q = q + half * new
        self._motor.current = current
        return step
