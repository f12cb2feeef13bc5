"""One sample of the arm in SI units, and its conversion from raw answers."""

import functools
import operator
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

from hil.drivers.control_table import ControlTable
from hil.drivers.exchange import Reply
from hil.drivers.joint import Joint
from hil.drivers.packet import ALERT
from hil.drivers.servo_model import VOLTAGE_UNIT, Mode
from hil.drivers.sync_read import Answer, Span

NAN = float("nan")


class Slow(NamedTuple):
    """Values that are read in turn, a few times a second; NaN if not read in this cycle, or if the servo did not reply.

    tick: the servo's own clock [s], which wraps at 32.768 s. voltage: supply voltage [V]. temperature: temperature
    inside the servo [degrees C].
    """

    tick: tuple[float, ...]
    voltage: tuple[float, ...]
    temperature: tuple[float, ...]


class Status(NamedTuple):
    """Values that a servo reports every few cycles in addition to its state.

    watchdog: Bus Watchdog [20 ms], 255 after it has tripped.
    goal: the goal that the servo holds [A, or V in PWM mode].
    tick: the servo's own clock [s], which wraps at 32.768 s.
    torque: Torque Enable; hardware_error: Hardware Error Status. Both are None if the cycle leaves no time to read
    them.
    """

    watchdog: int
    goal: float
    tick: float
    torque: bool | None = None
    hardware_error: int | None = None


class State(NamedTuple):
    """One sample of the arm, one value per joint; NaN if a servo did not reply.

    time_before_write, time_after_read: times on the port's clock [s].
    goal_current: the goals that were sent, rounded to whole ticks [A, or V in PWM mode].
    current: the measured current [A], or the applied voltage [V] in PWM mode.
    velocity: joint velocity [rad/s].
    position: joint angle [rad].
    error: the ERR bytes, 0 if missing.
    missing: whether the servo returned no values.
    slow, status: values that are only read in some cycles; None in all other cycles.
    apart: for each joint, the angles of its additional servos minus that of its first servo [rad], NaN if a servo did
    not reply; None for an arm with one servo per joint. Horns may be mounted at any angle, so only a change in these
    values is meaningful.
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
    apart: tuple[tuple[float, ...], ...] | None = None


_state = partial(tuple.__new__, State)  # half the time of State(...)

_DRIVE = {Mode.CURRENT: "Present Current", Mode.PWM: "Present PWM"}


Spans = Span | tuple[Span, ...]
"""One span for all servos, or one per servo if they are driven in different modes."""


def spans(mode: Mode | Sequence[Mode], tables: Sequence[ControlTable]) -> tuple[Spans, Spans, Spans]:
    """Return the registers read in most cycles, and two longer spans read occasionally.

    The second span adds the servo's clock, the third the supply voltage and temperature. mode: drive mode of all
    servos, or one per servo.
    """
    return (
        _span(mode, tables, (), ()),
        _span(mode, tables, ("Realtime Tick",), ()),
        _span(mode, tables, (), ("Present Input Voltage", "Present Temperature")),
    )


def _span(
    mode: Mode | Sequence[Mode], tables: Sequence[ControlTable], before: tuple[str, ...], behind: tuple[str, ...]
) -> Spans:
    modes = (mode,) * len(tables) if isinstance(mode, Mode) else tuple(mode)
    names = [(*before, _DRIVE[own], "Present Velocity", "Present Position", *behind) for own in modes]
    return Span.of(tables, names[0]) if len(set(modes)) == 1 else Span.each(tables, names)


SLOW_SPANS = 2
"""Number of `spans` that are read only occasionally."""

_WHOLE_STATUS = 9
"""Number of values in an answer with the whole status: ERR, five registers and the state."""

_DRIVEN = ("Torque Enable", "Hardware Error Status")


def status_span(mode: Mode | Sequence[Mode], tables: Sequence[ControlTable], *, whole: bool) -> Spans:
    """Return the registers that show whether torque and watchdog are still on, plus the state.

    mode: drive mode of all servos, or one per servo. whole: whether to start at Torque Enable; otherwise, the span
    starts at Bus Watchdog, which halves the number of bytes.
    """
    modes = (mode,) * len(tables) if isinstance(mode, Mode) else tuple(mode)
    names = [(*_DRIVEN, *_status_names(own)) if whole else _status_names(own) for own in modes]
    return Span.of(tables, names[0]) if len(set(modes)) == 1 else Span.each(tables, names)


def _status_names(mode: Mode) -> tuple[str, ...]:
    return "Bus Watchdog", mode.goal_register, "Realtime Tick", _DRIVE[mode], "Present Velocity", "Present Position"


SETTINGS = ("Drive Mode", "Operating Mode", "Homing Offset")
"""Settings that define the meaning of goals and angles. Another program may change them while torque is on, or by
rebooting the servo.
"""


LIMITS = {Mode.CURRENT: ("Goal PWM",), Mode.PWM: ()}
"""Registers between Bus Watchdog and goal that limit the motor's output. In current mode, Goal PWM limits its voltage.
"""


def read_back_spans(mode: Mode | Sequence[Mode], tables: Sequence[ControlTable]) -> tuple[Spans, Spans, Spans]:
    """Return three spans of registers: the first consists of Bus Watchdog, LIMITS and the goal, the second ends with
    SETTINGS, and the third begins with Torque Enable.

    The spans cover more addresses than necessary, so that answers to these reads differ in length from answers to the
    usual requests of other programs.
    """
    modes = (mode,) * len(tables) if isinstance(mode, Mode) else tuple(mode)
    goals = [("Bus Watchdog", *LIMITS[own], own.goal_register) for own in modes]
    goal = Span.of(tables, goals[0]) if len(set(modes)) == 1 else Span.each(tables, goals)
    return goal, Span.of(tables, ("ID", "Baud Rate", "Return Delay Time", *SETTINGS)), Span.of(tables, _DRIVEN)


class Converter:
    """Converts replies to States and goals to ticks. drive_units: A or V per tick, with each joint's sign."""

    def __init__(self, joints: Sequence[Joint], drive_units: Sequence[float]) -> None:
        self._joints = tuple(joints)
        self._drive_units = tuple(drive_units)
        self._scales = [
            (drive, joint.velocity_unit, joint.position_unit, joint.zero_ticks)
            for joint, drive in zip(joints, drive_units, strict=True)
        ]
        self._none_missing = (False,) * len(self._joints)

    def ticks(self, goals: Sequence[float]) -> tuple[int, ...]:
        """Return the goals rounded to the nearest ticks; raises ValueError for a goal that is not a finite number."""
        units = self._drive_units
        if len(goals) != len(units):
            raise self._wrong(goals)
        try:
            return tuple(map(round, map(operator.truediv, goals, units)))
        except (ValueError, OverflowError):
            raise self._wrong(goals) from None

    def state(self, ticks: Sequence[int], reply: Reply) -> State:
        before, after, span, servos = reply
        if span == 0 and len(servos) == len(ticks) == len(self._scales):
            # Most cycles: each servo answers with its ERR byte and the three values that are always read. With the cold
            # caches of a cycle, one plain loop takes half the time of a comprehension and a transposition by zip; a
            # keyword argument (strict) alone takes 2 us.
            answers: Any = servos
            sent, drive, velocity, position, error = [], [], [], [], []
            try:
                for tick, answer, scales in zip(ticks, answers, self._scales):  # noqa: B905
                    told, raw_drive, raw_velocity, raw_position = answer
                    unit, velocity_unit, position_unit, zero = scales
                    sent.append(unit * tick)
                    drive.append(raw_drive * unit)
                    velocity.append(raw_velocity * velocity_unit)
                    position.append((raw_position - zero) * position_unit)
                    error.append(told)
            except (TypeError, ValueError):
                pass  # a servo did not answer, or refused
            else:
                each = (tuple(sent), tuple(drive), tuple(velocity), tuple(position), tuple(error), self._none_missing)
                return _state((before, after, *each, None, None, None))
        return self._any_state(tuple(map(operator.mul, self._drive_units, ticks)), reply)

    def _any_state(self, sent: tuple[float, ...], reply: Reply) -> State:
        """Convert a reply as `state` does, but for any span, and even if a servo refused or did not reply."""
        # Additional registers precede the three that are always read, but voltage and temperature follow them.
        at = 1 if reply.span in (0, SLOW_SPANS) else 2 if reply.span == 1 else self._answer_length(reply) - 3
        drive, velocity, position, error, missing = [], [], [], [], []
        for answer, (drive_unit, velocity_unit, position_unit, zero) in zip(reply.servos, self._scales, strict=True):
            if answer is None or len(answer) == 1:
                missing.append(True)
                drive.append(NAN)
                velocity.append(NAN)
                position.append(NAN)
                error.append(0 if answer is None else answer[0])
            else:
                missing.append(False)
                drive.append(answer[at] * drive_unit)
                velocity.append(answer[at + 1] * velocity_unit)
                position.append((answer[at + 2] - zero) * position_unit)
                error.append(answer[0])
        slow = _slow(reply) if 0 < reply.span <= SLOW_SPANS else None
        status = self._status(reply.servos) if reply.span > SLOW_SPANS else None
        measured = (tuple(drive), tuple(velocity), tuple(position), tuple(error), tuple(missing))
        return _state((reply.time_before_write, reply.time_after_read, sent, *measured, slow, status, None))

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
            return ValueError(f"{len(goals)} goals for {len(self._joints)} joints: give one per joint.")
        for joint, goal in zip(self._joints, goals, strict=True):
            if not abs(goal) < float("inf"):
                return ValueError(
                    f"{joint.title} was given a goal of {goal} {joint.mode.goal_unit}, which is not finite."
                )
        return ValueError(f"goals {list(goals)} cannot be sent.")


def _slow(reply: Reply) -> Slow:
    nothing = (NAN,) * len(reply.servos)
    if reply.span == 1:
        return Slow(_column(reply.servos, 1, 1e-3), nothing, nothing)
    return Slow(nothing, _column(reply.servos, 4, VOLTAGE_UNIT), _column(reply.servos, 5, 1.0))


def _column(answers: Sequence[Answer], index: int, unit: float) -> tuple[float, ...]:
    return tuple([NAN if answer is None or len(answer) == 1 else answer[index] * unit for answer in answers])


def fold(state: State, of: Sequence[int], count: int) -> State:
    """Combine the values of the servos into one value per joint.

    of: the joint index of each servo, in ascending order. count: number of joints.

    Goals and currents are summed. Angle, velocity and clock are those of the joint's first servo; voltage is the lowest
    and temperature the highest of its servos. If any servo reports an error or does not reply, this applies to its
    joint. `apart` shows by how much the servos of one joint disagree.
    """
    servos = [[place for place, joint in enumerate(of) if joint == wanted] for wanted in range(count)]
    first = [places[0] for places in servos]
    slow, status = state.slow, state.status
    return state._replace(
        goal_current=tuple([sum(state.goal_current[place] for place in places) for places in servos]),
        current=tuple([sum(state.current[place] for place in places) for places in servos]),
        velocity=tuple([state.velocity[place] for place in first]),
        position=tuple([state.position[place] for place in first]),
        apart=tuple(
            [tuple([state.position[place] - state.position[places[0]] for place in places[1:]]) for places in servos]
        ),
        error=tuple([_joined(state.error[place] for place in places) for places in servos]),
        missing=tuple([any(state.missing[place] for place in places) for places in servos]),
        slow=slow
        and Slow(
            tuple([slow.tick[place] for place in first]),
            tuple([min(slow.voltage[place] for place in places) for places in servos]),
            tuple([max(slow.temperature[place] for place in places) for places in servos]),
        ),
        status=status and tuple([_told([status[place] for place in places]) for places in servos]),
    )


def _told(statuses: Sequence[Status | None]) -> Status | None:
    """Return the combined status of one joint's servos: goals are summed; a fault of any servo applies to the joint."""
    told = [status for status in statuses if status is not None]
    if len(told) < len(statuses):
        return None
    torque = [status.torque for status in told if status.torque is not None]
    errors = [status.hardware_error for status in told if status.hardware_error is not None]
    return Status(
        max(status.watchdog for status in told),
        sum(status.goal for status in told),
        told[0].tick,
        all(torque) if torque else None,
        functools.reduce(operator.or_, errors) if errors else None,
    )


def _joined(errors: Iterable[int]) -> int:
    """Return the combined ERR byte of one joint's servos: the first error number, plus Alert if any servo has it."""
    number = alert = 0
    for error in errors:
        alert |= error & ALERT
        number = number or error & ~ALERT
    return number | alert
