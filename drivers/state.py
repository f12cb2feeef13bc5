"""One sample of the arm in SI units, and how raw answers become it."""

from collections.abc import Sequence
from typing import NamedTuple

from hil.drivers.control_table import ControlTable
from hil.drivers.exchange import Reply
from hil.drivers.joint import Joint
from hil.drivers.servo_model import VOLTAGE_UNIT, Mode
from hil.drivers.sync_read import Answer, Span

NAN = float("nan")


class Slow(NamedTuple):
    """What is read in turn, a few times a second; NaN where it was not this one's turn, or the servo is silent.

    tick: the servo's own clock [s], which wraps at 32.768 s. voltage: supply [V]. temperature: [degrees C].
    """

    tick: tuple[float, ...]
    voltage: tuple[float, ...]
    temperature: tuple[float, ...]


class State(NamedTuple):
    """One sample of the arm; NaN where a servo did not answer.

    time_before_write, time_after_read: s on the port's clock. goal_current: what was sent, a whole number of ticks,
    and current: what the servo measured [A] (under PWM both are voltages [V], sent and applied); velocity [rad/s];
    position [rad]; error: the ERR bytes, 0 where missing; missing: no values from this servo; slow: in turn, else None.
    """

    time_before_write: float
    time_after_read: float
    goal_current: tuple[float, ...]
    current: tuple[float, ...]
    velocity: tuple[float, ...]
    position: tuple[float, ...]
    error: tuple[int, ...]
    missing: tuple[bool, ...]
    slow: Slow | None = None


_DRIVE = {Mode.CURRENT: "Present Current", Mode.PWM: "Present PWM"}


def spans(mode: Mode, tables: Sequence[ControlTable]) -> tuple[Span, Span, Span]:
    """What is read in each cycle, and the two longer spans read now and then: with the tick, with voltage and heat."""
    always = (_DRIVE[mode], "Present Velocity", "Present Position")
    return (
        Span.of(tables, always),
        Span.of(tables, ("Realtime Tick", *always)),
        Span.of(tables, (*always, "Present Input Voltage", "Present Temperature")),
    )


class Converter:
    """Turns replies into States and goals into ticks. drive_units: A or V per tick, with each joint's sign."""

    def __init__(self, joints: Sequence[Joint], drive_units: Sequence[float]) -> None:
        self._joints = tuple(joints)
        self._drive_units = tuple(drive_units)
        self._scales = [
            (drive, joint.velocity_unit, joint.position_unit, joint.zero_ticks)
            for joint, drive in zip(joints, drive_units, strict=True)
        ]

    def ticks(self, goals: Sequence[float]) -> list[int]:
        """The nearest goals in ticks. Raises ValueError for a goal that is no number."""
        try:
            return [round(goal / unit) for goal, unit in zip(goals, self._drive_units, strict=True)]
        except (ValueError, OverflowError):
            raise self._wrong(goals) from None

    def state(self, ticks: Sequence[int], reply: Reply) -> State:
        sent = tuple([unit * tick for unit, tick in zip(self._drive_units, ticks, strict=True)])
        # The tick stands in front of the three that are always read, voltage and temperature behind them.
        at = 2 if reply.span == 1 else 1
        drive, velocity, position, error, missing = [], [], [], [], []
        for answer, (drive_unit, velocity_unit, position_unit, zero) in zip(reply.servos, self._scales, strict=True):
            if answer is None or len(answer) == 1:
                drive.append(NAN)
                velocity.append(NAN)
                position.append(NAN)
                error.append(0 if answer is None else answer[0])
                missing.append(True)
            else:
                drive.append(answer[at] * drive_unit)
                velocity.append(answer[at + 1] * velocity_unit)
                position.append((answer[at + 2] - zero) * position_unit)
                error.append(answer[0])
                missing.append(False)
        return State(
            reply.time_before_write,
            reply.time_after_read,
            sent,
            tuple(drive),
            tuple(velocity),
            tuple(position),
            tuple(error),
            tuple(missing),
            _slow(reply) if reply.span else None,
        )

    def _wrong(self, goals: Sequence[float]) -> ValueError:
        if len(goals) != len(self._joints):
            return ValueError(f"{len(goals)} goals for {len(self._joints)} joints: one for each is needed.")
        for joint, goal in zip(self._joints, goals, strict=True):
            if not abs(goal) < float("inf"):
                return ValueError(
                    f"{joint.title} was given a goal of {goal} {joint.mode.goal_unit}: that is no number."
                )
        return ValueError(f"goals {list(goals)} cannot be sent.")


def _slow(reply: Reply) -> Slow:
    nothing = (NAN,) * len(reply.servos)
    if reply.span == 1:
        return Slow(_column(reply.servos, 1, 1e-3), nothing, nothing)
    return Slow(nothing, _column(reply.servos, 4, VOLTAGE_UNIT), _column(reply.servos, 5, 1.0))


def _column(answers: Sequence[Answer], index: int, unit: float) -> tuple[float, ...]:
    return tuple([NAN if answer is None or len(answer) == 1 else answer[index] * unit for answer in answers])
