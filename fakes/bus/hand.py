"""A hand that moves joints of the fake arm whose torque is off, as a person calibrating an arm does.

    bus.hand.move(Move(servo=2, to=0.5))                        # joint of servo 2 to 0.5 rad, one second from now
    bus.hand.move(Move(servo=2, ticks=3000, at=4.0, duration=2.0))
    bus.hand.release(2)

The same from TOML, `[[fake.moves]]` with the same keys, and from the command line: `--move 2:to=0.5,at=4`, and while
the terminal is served `hil fake --at /tmp/arm --move 2:to=0.5`.

The hand overcomes friction and gravity but never opposes motor torque, so it releases a joint as soon as the
torque of one of its servos comes on, and does not take one whose torque is on.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hil.fakes.bus.joints import Joints
from hil.fakes.plants.plant import CanBeHeld, Plant, PlantError

_PULL_S = 0.01
"""How fast the hand makes up for where the joint is not yet where the hand is [s]."""


class Move(BaseModel):
    """One movement of the hand. It holds the joint at its end for `hold`, without an end unless given."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    servo: Annotated[int, Field(ge=0, le=252, description="bus ID of a servo of the joint")]
    to: Annotated[float | None, Field(allow_inf_nan=False, description="joint angle at the end [rad]")] = None
    ticks: Annotated[int | None, Field(description="Present Position at the end, instead of `to`")] = None
    at: Annotated[float, Field(ge=0, allow_inf_nan=False, description="when it begins [s]; see where it is used")] = 0.0
    duration: Annotated[float, Field(gt=0, allow_inf_nan=False, description="how long it takes [s]")] = 1.0
    hold: Annotated[float, Field(ge=0, description="how long the joint is held then [s]")] = math.inf

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if (self.to is None) == (self.ticks is None):
            raise ValueError("give either to (an angle, rad) or ticks (a Present Position)")
        return self


@dataclass(slots=True)
class _Grip:
    """A joint in the hand: from where [rad], to where, from when [s of the bus], how long, and until when."""

    joint: int
    start: float
    end: float
    began: float
    duration: float
    until: float


class Hand:
    """The hand of one bus. Times are seconds since the bus was made.

    tell: called whenever it has begun or ended to need the bus's ticks.
    """

    def __init__(self, joints: Joints, plant: Plant, time: Callable[[], float], tell: Callable[[], None]) -> None:
        self._joints = joints
        self._plant = plant
        self._time = time
        self._tell = tell
        self._to_come: list[Move] = []
        self._grips: dict[int, _Grip] = {}

    @property
    def busy(self) -> bool:
        """Whether it holds a joint or has a pending move."""
        return bool(self._grips or self._to_come)

    @property
    def holds(self) -> frozenset[int]:
        """The joints in the hand, counted from 0."""
        return frozenset(self._grips)

    def move(self, *moves: Move) -> None:
        """Do these, `at` seconds from now. Raises PlantError for a plant that cannot be held, ValueError for an ID."""
        now = self._time()
        for move in moves:
            self._joint_of(move)
            self._to_come.append(move.model_copy(update={"at": now + move.at}))
        if moves and not isinstance(self._plant, CanBeHeld):
            raise PlantError(f"{type(self._plant).__name__} has no hold(joint, velocity): the hand needs it")
        self._to_come.sort(key=lambda move: move.at)
        self._tell()

    def release(self, servo: int | None = None) -> None:
        """Let go of a servo's joint, or of all, and forget what was to come for it."""
        joints = set(self._joints.of) if servo is None else {self._joint(servo)}
        self._to_come = [move for move in self._to_come if self._joint_of(move) not in joints]
        for joint in joints & self._grips.keys():
            self._let_go(joint)
        self._tell()

    def tick(self, now: float) -> None:
        """One period of the servos' loops ends, `now` [s since the bus was made]: move what is held."""
        while self._to_come and self._to_come[0].at <= now:
            self._take(self._to_come.pop(0), now)
        for grip in list(self._grips.values()):
            if now >= grip.until or self._driven(grip.joint):
                self._let_go(grip.joint)
                continue
            share = min((now - grip.began) / grip.duration, 1.0)
            away = grip.end - grip.start
            # Of all ways from rest to rest the one with the least jerk (Flash and Hogan 1985): as people move.
            wanted = grip.start + away * share**3 * (10 - 15 * share + 6 * share**2)
            rate = away * 30 * share**2 * (1 - share) ** 2 / grip.duration
            self._hold(grip.joint, rate + (wanted - self._plant.position[grip.joint]) / _PULL_S)
        if not self.busy:
            self._tell()

    def _take(self, move: Move, now: float) -> None:
        joint = self._joint_of(move)
        if self._driven(joint):
            return
        start = self._plant.position[joint]
        end = move.to
        if end is None:
            (servo,) = (servo for servo in self._joints.of_joint(joint) if servo.id == move.servo)
            end = servo.present.angle(move.ticks or 0)
        self._grips[joint] = _Grip(joint, start, end, now, move.duration, now + move.duration + move.hold)

    def _driven(self, joint: int) -> bool:
        return any(servo.torque_enabled for servo in self._joints.of_joint(joint))

    def _let_go(self, joint: int) -> None:
        del self._grips[joint]
        self._hold(joint, None)

    def _hold(self, joint: int, velocity: float | None) -> None:
        assert isinstance(self._plant, CanBeHeld)  # looked at when the move was asked for
        self._plant.hold(joint, velocity)

    def _joint_of(self, move: Move) -> int:
        return self._joint(move.servo)

    def _joint(self, servo_id: int) -> int:
        for joint in set(self._joints.of):
            if any(servo.id == servo_id for servo in self._joints.of_joint(joint)):
                return joint
        raise ValueError(f"no servo has the ID {servo_id}")


def parse_move(text: str) -> Move:
    """A move as on the command line, `ID:key=value,key=value`; raises ValueError."""
    servo, _, rest = text.partition(":")
    keys = {name: int if name in ("servo", "ticks") else float for name in Move.model_fields}
    values: dict[str, object] = {}
    for part in (f"servo={servo}", *filter(None, rest.split(","))):
        key, equals, value = part.partition("=")
        if key not in keys or not equals:
            raise ValueError(f'move "{text}": "{part}" is not KEY=VALUE with a key of {", ".join(keys)}')
        try:
            values[key] = keys[key](value)
        except ValueError:
            raise ValueError(f'move "{text}": {key} = {value!r}: must be a number; write ID:to=ANGLE') from None
    try:
        return Move.model_validate(values)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        about = ".".join(map(str, detail["loc"]))
        raise ValueError(f'move "{text}": {about + ": " if about else ""}{detail["msg"]}') from None
