"""One sample of the arm in SI units, and how raw answers become it."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from hil.drivers.control_table import ControlTable
from hil.drivers.exchange import Reply
from hil.drivers.joint import Joint
from hil.drivers.packet import ALERT
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
    """What one servo told of itself beside its state, in its turn.

    joint: its index. torque: whether Torque Enable is on. hardware_error: Hardware Error Status. The others are None
    where the cycle has no time for them: watchdog, Bus Watchdog [20 ms], 255 when it acted; goal: the register of the
    goal [A, or V under PWM]; tick: the servo's own clock [s], which wraps at 32.768 s.
    """

    joint: int
    torque: bool
    hardware_error: int
    watchdog: int | None = None
    goal: float | None = None
    tick: float | None = None


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
    status: Status | None = None


_DRIVE = {Mode.CURRENT: "Present Current", Mode.PWM: "Present PWM"}


Spans = Span | tuple[Span, ...]
"""One span for all servos, or where they are driven in different modes one for each."""


def spans(mode: Mode | Sequence[Mode], tables: Sequence[ControlTable]) -> tuple[Spans, Spans, Spans]:
    """What is read in each cycle, and the two longer spans read now and then: with the tick, with voltage and heat.

    mode: how all servos are driven, or how each is.
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
"""How many of `spans` are read now and then."""

_SHORT_STATUS = ("Torque Enable", "Hardware Error Status")


def status_span(mode: Mode | Sequence[Mode], tables: Sequence[ControlTable], *, short: bool = False) -> Spans:
    """What one servo is asked for in its turn: whether it is still driven, and its state.

    mode: how all servos are driven, or how each is. short: without the state, which that cycle then lacks, where a
    cycle has no time for both.
    """
    modes = (mode,) * len(tables) if isinstance(mode, Mode) else tuple(mode)
    names = [_SHORT_STATUS if short else (*_SHORT_STATUS, *_status_names(own)) for own in modes]
    return Span.of(tables, names[0]) if len(set(modes)) == 1 else Span.each(tables, names)


def _status_names(mode: Mode) -> tuple[str, ...]:
    goal = "Goal Current" if mode is Mode.CURRENT else "Goal PWM"
    return "Bus Watchdog", goal, "Realtime Tick", _DRIVE[mode], "Present Velocity", "Present Position"


_STATE_IN_STATUS = 6
"""Where the state begins in the answer of a status: behind ERR and five registers."""


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
        told = reply.span - SLOW_SPANS - 1
        # The tick stands in front of the three that are always read, voltage and temperature behind them.
        at = 2 if reply.span == 1 else 1
        drive, velocity, position, error, missing = [], [], [], [], []
        answers = reply.servos if told < 0 else _states(reply.servos, told)
        for answer, (drive_unit, velocity_unit, position_unit, zero) in zip(answers, self._scales, strict=True):
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
            self._status(told, reply.servos[told]) if told >= 0 else None,
        )

    def _status(self, joint: int, answer: Answer) -> Status | None:
        if answer is None or len(answer) == 1:
            return None
        if len(answer) <= _STATE_IN_STATUS:
            return Status(joint, bool(answer[1]), answer[2])
        _, torque, error, watchdog, goal, tick, *_ = answer
        return Status(joint, bool(torque), error, watchdog, goal * self._drive_units[joint], tick * 1e-3)

    def _wrong(self, goals: Sequence[float]) -> ValueError:
        if len(goals) != len(self._joints):
            return ValueError(f"{len(goals)} goals for {len(self._joints)} joints: one for each is needed.")
        for joint, goal in zip(self._joints, goals, strict=True):
            if not abs(goal) < float("inf"):
                return ValueError(
                    f"{joint.title} was given a goal of {goal} {joint.mode.goal_unit}: that is no number."
                )
        return ValueError(f"goals {list(goals)} cannot be sent.")


def _states(answers: Sequence[Answer], told: int) -> list[Answer]:
    """The answers with the state alone, or nothing, left of the one that told its status."""
    states = list(answers)
    status = answers[told]
    if status is not None:
        states[told] = status[:1] + status[_STATE_IN_STATUS:]
    return states


def _slow(reply: Reply) -> Slow:
    nothing = (NAN,) * len(reply.servos)
    if reply.span == 1:
        return Slow(_column(reply.servos, 1, 1e-3), nothing, nothing)
    return Slow(nothing, _column(reply.servos, 4, VOLTAGE_UNIT), _column(reply.servos, 5, 1.0))


def _column(answers: Sequence[Answer], index: int, unit: float) -> tuple[float, ...]:
    return tuple([NAN if answer is None or len(answer) == 1 else answer[index] * unit for answer in answers])


def fold(state: State, of: Sequence[int], count: int) -> State:
    """The state of joints from that of their servos. of: of each servo, its joint, in rising order; count: joints.

    Currents and goals are sums, angle, velocity and clock the first servo's, the voltage the lowest, the temperature
    the highest; an error or a loss of one servo is one of the joint.
    """
    servos = [[place for place, joint in enumerate(of) if joint == wanted] for wanted in range(count)]
    first = [places[0] for places in servos]
    slow, status = state.slow, state.status
    return state._replace(
        goal_current=tuple([sum(state.goal_current[place] for place in places) for places in servos]),
        current=tuple([sum(state.current[place] for place in places) for places in servos]),
        velocity=tuple([state.velocity[place] for place in first]),
        position=tuple([state.position[place] for place in first]),
        error=tuple([_joined(state.error[place] for place in places) for places in servos]),
        missing=tuple([any(state.missing[place] for place in places) for places in servos]),
        slow=slow
        and Slow(
            tuple([slow.tick[place] for place in first]),
            tuple([min(slow.voltage[place] for place in places) for places in servos]),
            tuple([max(slow.temperature[place] for place in places) for places in servos]),
        ),
        status=status
        and status._replace(
            joint=of[status.joint],
            goal=None if status.goal is None else status.goal * len(servos[of[status.joint]]),
        ),
    )


def _joined(errors: Iterable[int]) -> int:
    """The ERR bytes of one joint's servos as one: the first error number, and whether any has its Alert set."""
    number = alert = 0
    for error in errors:
        alert |= error & ALERT
        number = number or error & ~ALERT
    return number | alert
