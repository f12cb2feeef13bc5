"""A hand that moves joints of the fake arm while their torque is off, like a person calibrating an arm.

    bus.hand.move(Move(servo=2, to=0.5))  # move the joint of servo 2 to 0.5 rad within one second, starting now
    bus.hand.move(Move(servo=2, ticks=3000, at=4.0, duration=2.0))
    bus.hand.release(2)

Moves can also be given in TOML, as `[[fake.moves]]` with the same keys; on the command line, as `--move 2:to=0.5,at=4`;
and with `hil hand /tmp/arm 2:to=0.5`, while a fake terminal is being served.

The hand overcomes friction and gravity but never opposes motor torque: it does not grip a joint whose torque is on, and
releases a joint as soon as one of its servos switches torque on.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from hil.fakes.bus.joints import Joints
from hil.fakes.plants.arm import PI
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.plant import CanBeHeld, Plant
from hil.toml_errors import Described, describe

__all__ = ["Hand", "Move", "parse_move"]

_PULL_S = 0.01
"""Time constant with which the hand corrects the joint's deviation from the planned path [s]."""


_FASTEST_RAD_S = 200.0
"""Largest mean velocity of a movement [rad/s]; the simulated gears and hard stops would not withstand much more."""

_MOST_TICKS = 1 << 20
"""Largest Present Position of a servo in either direction: 256 turns."""


class Move(Described):
    """One movement of the hand, after which it holds the joint for `hold` seconds; by default, indefinitely."""

    servo: Annotated[int, Field(ge=0, le=252, description="bus ID of one of the joint's servos")]
    to: Annotated[
        float | None,
        Field(ge=-4 * PI, le=4 * PI, allow_inf_nan=False, description="joint angle at the end [rad]"),
    ] = None
    ticks: Annotated[
        int | None,
        Field(ge=-_MOST_TICKS, le=_MOST_TICKS, description="Present Position at the end, instead of `to` [ticks]"),
    ] = None
    at: Annotated[float, Field(ge=0, le=86400, allow_inf_nan=False, description="delay before the start [s]")] = 0.0
    duration: Annotated[
        float,
        Field(
            gt=0,
            le=600,
            allow_inf_nan=False,
            description="duration of the movement [s]; extended if the mean velocity would exceed 200 rad/s",
        ),
    ] = 1.0
    hold: Annotated[float, Field(ge=0, description="how long the joint is held afterwards [s]")] = math.inf

    @model_validator(mode="after")
    def _one_end(self) -> Self:
        if (self.to is None) == (self.ticks is None):
            raise ValueError("give either `to` (angle, rad) or `ticks` (Present Position)")
        return self


@dataclass(slots=True)
class _Grip:
    """A joint held by the hand.

    joint: index of the joint.
    start, end: angles between which it moves [rad].
    began: start time [s since the bus was created].
    duration: duration of the movement [s].
    until: time of release [s since the bus was created].
    """

    joint: int
    start: float
    end: float
    began: float
    duration: float
    until: float


class Hand:
    """The hand of one bus. Times are in seconds since the bus was created.

    tell: called whenever a move, grip or release may have changed `busy`. While the hand is busy, the bus must call
    `tick`.
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
        """Whether the hand holds a joint or has a pending move."""
        return bool(self._grips or self._to_come)

    @property
    def holds(self) -> frozenset[int]:
        """Indices of the joints that the hand holds."""
        return frozenset(self._grips)

    def move(self, *moves: Move) -> None:
        """Schedule moves, each of which starts `at` seconds from now.

        Raises PlantError if the plant's joints cannot be held, and ValueError for an ID that no servo has or for a move
        that starts now while its joint's torque is on. A move that starts later is skipped if torque is on by then.
        """
        for move in moves:
            if move.at == 0.0 and (driving := self._driving(self._joint_of(move))):
                raise ValueError(
                    f"the torque of servo {driving[0]} is on, but a hand can only move joints whose torque is off: "
                    "write 0 to its Torque Enable first"
                )
        self.schedule(*moves)

    def schedule(self, *moves: Move) -> None:
        """Schedule moves like `move`, but skip every move whose joint has torque on when the move should start."""
        now = self._time()
        free = {self._joint_of(move) for move in moves} - self._grips.keys()
        if moves and not isinstance(self._plant, CanBeHeld):
            raise PlantError(
                f"{type(self._plant).__name__} has no hold(joint, velocity), needed to move a joint by hand"
            )
        for joint in free:
            self._hold(joint, None)  # a custom plant that cannot be held is refused now, not in the middle of a run
        self._to_come += [move.model_copy(update={"at": now + move.at}) for move in moves]
        self._to_come.sort(key=lambda move: move.at)
        self._tell()

    def release(self, servo: int | None = None) -> None:
        """Release the joint of a servo, or all joints, and cancel their pending moves."""
        joints = set(self._joints.of) if servo is None else {self._joint(servo)}
        self._to_come = [move for move in self._to_come if self._joint_of(move) not in joints]
        for joint in joints & self._grips.keys():
            self._let_go(joint)
        self._tell()

    def tick(self, now: float) -> None:
        """Start moves that are due, and move the joints that are held; called once per period of the servos' loops.

        now: time since the bus was created [s].
        """
        while self._to_come and self._to_come[0].at <= now:
            self._take(self._to_come.pop(0), now)
        for grip in list(self._grips.values()):
            if now >= grip.until or self._driving(grip.joint):
                self._let_go(grip.joint)
                continue
            share = min((now - grip.began) / grip.duration, 1.0)
            away = grip.end - grip.start
            # Minimum-jerk profile, as in human reaching movements (Flash and Hogan 1985).
            wanted = grip.start + away * share**3 * (10 - 15 * share + 6 * share**2)
            rate = away * 30 * share**2 * (1 - share) ** 2 / grip.duration
            self._hold(grip.joint, rate + (wanted - self._plant.position[grip.joint]) / _PULL_S)
        if not self.busy:
            self._tell()

    def _take(self, move: Move, now: float) -> None:
        joint = self._joint_of(move)
        if self._driving(joint):
            return
        start = self._plant.position[joint]
        end = move.to
        if end is None:
            servo = next(servo for servo in self._joints.of_joint(joint) if servo.id == move.servo)
            end = servo.present.angle(move.ticks or 0)
        duration = max(move.duration, abs(end - start) / _FASTEST_RAD_S)
        self._grips[joint] = _Grip(joint, start, end, now, duration, now + duration + move.hold)

    def _driving(self, joint: int) -> list[int]:
        """Return the IDs of the joint's servos whose torque is on."""
        return [servo.id for servo in self._joints.of_joint(joint) if servo.torque_enabled]

    def _let_go(self, joint: int) -> None:
        del self._grips[joint]
        self._hold(joint, None)

    def _hold(self, joint: int, velocity: float | None) -> None:
        assert isinstance(self._plant, CanBeHeld)  # checked in `move`
        self._plant.hold(joint, velocity)

    def _joint_of(self, move: Move) -> int:
        return self._joint(move.servo)

    def _joint(self, servo_id: int) -> int:
        for joint in set(self._joints.of):
            if any(servo.id == servo_id for servo in self._joints.of_joint(joint)):
                return joint
        raise ValueError(f"no servo has the ID {servo_id}")


def parse_move(text: str) -> Move:
    """Parse a move given on the command line as `ID:key=value,key=value`; raises ValueError."""
    servo, _, rest = text.partition(":")
    keys = {name: int if name in ("servo", "ticks") else float for name in Move.model_fields}
    values: dict[str, object] = {}
    for part in (f"servo={servo}", *filter(None, rest.split(","))):
        key, equals, value = part.partition("=")
        if key not in keys or not equals:
            raise ValueError(f'move "{text}": "{part}" is not KEY=VALUE with one of the keys {", ".join(keys)}')
        try:
            values[key] = keys[key](value)
        except ValueError:
            raise ValueError(f'move "{text}": {key} = {value!r}: must be a number; write ID:to=ANGLE') from None
    try:
        return Move.model_validate(values)
    except ValidationError as error:
        raise ValueError(describe(error, f'move "{text}"', Move)) from None
