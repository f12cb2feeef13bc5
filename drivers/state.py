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


class Status(NamedTuple):
    """What a servo tells of itself a few times in 0.1 s, beside its state.

    watchdog: Bus Watchdog [20 ms], 255 when it acted. goal: the register of the goal [A, or V under PWM]. tick: the
    servo's own clock [s], which wraps at 32.768 s. torque: Torque Enable; hardware_error: Hardware Error Status; both
    None where the cycle has no time for them.
    """

    watchdog: int
    goal: float
    tick: float
    torque: bool | None = None
    hardware_error: int | None = None


class State(NamedTuple):
    """One sample of the arm; NaN where a servo did not answer.

    time_before_write, time_after_read: s on the port's clock. goal_current: what was sent, a whole number of ticks,
    and current: what the servo measured [A] (under PWM both are voltages [V], sent and applied); velocity [rad/s];
    position [rad]; error: the ERR bytes, 0 where missing; missing: no values from this servo; slow, status: in
    turn, else None.
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
    status: tuple[Status | None, ...] | None = None


_DRIVE = {Mode.CURRENT: "Present Current", Mode.PWM: "Present PWM"}


def spans(mode: Mode, tables: Sequence[ControlTable]) -> tuple[Span, Span, Span]:
    """What is read in each cycle, and the two longer spans read now and then: with the tick, with voltage and heat."""
    always = (_DRIVE[mode], "Present Velocity", "Present Position")
    return (
        Span.of(tables, always),
        Span.of(tables, ("Realtime Tick", *always)),
        Span.of(tables, (*always, "Present Input Voltage", "Present Temperature")),
    )


SLOW_SPANS = 2
"""How many of `spans` are read now and then."""

_WHOLE_STATUS = 9
"""Values of an answer with a whole status: ERR, five registers and the state."""

_DRIVEN = ("Torque Enable", "Hardware Error Status")


def status_span(mode: Mode, tables: Sequence[ControlTable], *, whole: bool) -> Span:
    """What says whether a servo is still driven and watched, and its state.

    whole: from Torque Enable on; else without what stands in front of Bus Watchdog, which takes half of the bytes.
    """
    goal = "Goal Current" if mode is Mode.CURRENT else "Goal PWM"
    more = ("Bus Watchdog", goal, "Realtime Tick", _DRIVE[mode], "Present Velocity", "Present Position")
    return Span.of(tables, (*_DRIVEN, *more) if whole else more)


class Converter:
    """Turns replies into States and goals into ticks. drive_units: A or V per tick, with each joint's sign. zeros:
    Present Positions where the joints' angles are zero, where these are not the joints' own.
    """

    def __init__(
        self, joints: Sequence[Joint], drive_units: Sequence[float], zeros: Sequence[int] | None = None
    ) -> None:
        self._joints = tuple(joints)
        self._drive_units = tuple(drive_units)
        zeros = [joint.zero_ticks for joint in joints] if zeros is None else zeros
        self._scales = [
            (drive, joint.velocity_unit, joint.position_unit, zero)
            for joint, drive, zero in zip(joints, drive_units, zeros, strict=True)
        ]

    def ticks(self, goals: Sequence[float]) -> list[int]:
        """The nearest goals in ticks. Raises ValueError for a goal that is no number."""
        try:
            return [round(goal / unit) for goal, unit in zip(goals, self._drive_units, strict=True)]
        except (ValueError, OverflowError):
            raise self._wrong(goals) from None

    def state(self, ticks: Sequence[int], reply: Reply) -> State:
        sent = tuple([unit * tick for unit, tick in zip(self._drive_units, ticks, strict=True)])
        # What is read beside the three that are always read stands in front of them, voltage and heat behind them.
        at = 1 if reply.span in (0, SLOW_SPANS) else 2 if reply.span == 1 else self._answer_length(reply) - 3
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
            _slow(reply) if 0 < reply.span <= SLOW_SPANS else None,
            self._status(reply.servos) if reply.span > SLOW_SPANS else None,
        )

    def _status(self, answers: Sequence[Answer]) -> tuple[Status | None, ...]:
        told: list[Status | None] = []
        for answer, unit in zip(answers, self._drive_units, strict=True):
            if answer is None or len(answer) == 1:
                told.append(None)
                continue
            watchdog, goal, tick = answer[-6:-3]
            driven = (bool(answer[1]), answer[2]) if len(answer) == _WHOLE_STATUS else (None, None)
            told.append(Status(watchdog, goal * unit, tick * 1e-3, *driven))
        return tuple(told)

    @staticmethod
    def _answer_length(reply: Reply) -> int:
        return max((len(answer) for answer in reply.servos if answer is not None), default=1)

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
