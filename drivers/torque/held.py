"""Handling of torque that is already on at the start: either refuse to start, or let the arm sink slowly.

To let it sink, Goal PWM is reduced to zero, which limits the motor's output in every operating mode (ROBOTIS e-Manual,
Goal PWM). With zero PWM and torque on, the motor's terminals are shorted, so it brakes. In current mode, Goal Current
is then reduced to zero too, in case a servo's firmware ignores Goal PWM in that mode.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import NamedTuple

from hil.drivers.clock import Clock
from hil.drivers.errors import BusShared, DriverError, ServoRefused, TorqueHeld
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import Servo
from hil.drivers.servo_model import Mode
from hil.drivers.torque.off import has_torque, signals_held_back

FADE_S = 1.0
"""Time over which a held servo's output limit is reduced to zero [s]."""

SINKING_S = 60.0
"""Longest time for which joints may sink, braked by their motors, before torque is cut [s]."""

HALF_DOWN = "The arm was being let down; its torque was left on"
"""Beginning of the note on an exception that ends the sinking early."""

_STEPS = 20
_LOOK_S = 0.05
"""Interval at which positions and goals are read while the arm sinks [s]."""

_STILL_S, _STILL_TICKS = 1.0, 3
"""A joint whose Present Position changes by at most `_STILL_TICKS` within `_STILL_S` [s] counts as still."""


Originals = Mapping[Joint, Mapping[str, int]]
"""Each servo's settings, by name [ticks], before any program began to let the arm down."""


class LetDown(NamedTuple):
    """The joints that were let down because their torque was on at the start. `moving`: those of them that were still
    moving when their torque was cut.
    """

    joints: tuple[Joint, ...] = ()
    moving: tuple[Joint, ...] = ()


def is_held(servo: Servo) -> bool:
    """Return whether the servo's torque is on and holds or drives its joint. Raises the errors of `Servo.read`.

    A tripped Bus Watchdog has zeroed the goal, so that in current and PWM mode the joint moves freely. Torque Enable is
    read twice, because a reply does not identify its register.
    """
    if not (servo.read("Torque Enable") and servo.read("Torque Enable")):
        return False
    tripped = servo.read("Bus Watchdog") == WATCHDOG_TRIPPED
    return not (tripped and servo.read("Operating Mode") in (Mode.CURRENT, Mode.PWM))


def held_servos(servos: Mapping[Joint, Servo]) -> dict[Joint, Servo]:
    """The servos whose joints are held. Raises the errors of `Servo.read`."""
    return {joint: servo for joint, servo in servos.items() if is_held(servo)}


def in_current_mode(servos: Mapping[Joint, Servo]) -> list[Joint]:
    """The joints whose servos are in current mode. Raises the errors of `Servo.read`."""
    return [joint for joint, servo in servos.items() if servo.read("Operating Mode") == Mode.CURRENT]


def refuse_held(servos: Mapping[Joint, Servo]) -> None:
    """Raise TorqueHeld if any joint is held. Also raises the errors of `Servo.read`."""
    if held := held_servos(servos):
        raise TorqueHeld(
            f"{' and '.join(joint.title for joint in held)}: torque is on, so another program is driving or holding "
            "the arm, or has left torque on. Switching it off would let the arm fall, so nothing was written. Stop "
            "that program, or hold the arm by hand and take it over with --take-over (BusConfig.take_over), which lets "
            "it sink slowly."
        )


def switched_on(servos: Mapping[Joint, Servo]) -> str:
    """Describe the servos whose torque is on, with their currents; "" if there are none. Raises the errors of
    `Servo.read`.
    """
    on = [servo for servo in servos.values() if servo.read("Torque Enable") and has_torque(servo)]
    return " and ".join(f"{servo.title}{_current(joint, servo)}" for joint, servo in servos.items() if servo in on)


def _current(joint: Joint, servo: Servo) -> str:
    if joint.servo.current_unit is None:
        return ""
    return f" (Present Current {servo.read('Present Current') * joint.servo.current_unit:.3f} A)"


def let_sink(held: Mapping[Joint, Servo], clock: Clock, originals: Originals | None = None) -> LetDown:
    """Ramp the output of held servos down to zero, wait until the joints no longer sink, cut torque, and then reset the
    lowered goals to the values that they had before.

    originals: settings to name in messages, since an earlier program may already have lowered the present goals.

    Raises the errors of `Servo.write`. If an exception ends the sinking early, the goals stay lowered, since restoring
    them with torque on would jerk the arm back up; the exception gets a note that lists them. If another program
    raises the lowered goals again, it would drive the arm, so torque is cut at once and BusShared is raised.
    """
    lowering = _Lowering(held, clock, originals or {})
    try:
        moving = lowering.run()
    except BusShared:
        lowering.cut_despite_others()
        raise
    except BaseException as ended:
        if lowered := lowering.lowered:
            ended.add_note(
                f"{HALF_DOWN}, with goals that this program lowered: {lowered}. Hold the arm by hand and start again "
                "with --take-over, which lets it down completely."
            )
        raise
    lowering.cut()
    return LetDown(tuple(held), moving)


class _Lowering:
    """The output of held servos, reduced step by step."""

    def __init__(self, held: Mapping[Joint, Servo], clock: Clock, originals: Originals) -> None:
        self._held = held
        self._clock = clock
        self._originals = originals
        self._former: dict[tuple[Joint, str], int] = {}
        self._written: dict[tuple[Joint, str], int] = {}

    def run(self) -> tuple[Joint, ...]:
        """Reduce the output to zero, wait until the joints are at rest, and return those in motion after SINKING_S."""
        for servo in self._held.values():
            if servo.read("Bus Watchdog") == WATCHDOG_TRIPPED:
                servo.write("Bus Watchdog", 0)  # tripped, it locks the goals
        self._fade("Goal PWM", self._held)
        self._fade("Goal Current", in_current_mode(self._held))
        return self._wait_until_still()

    def _fade(self, name: str, joints: Collection[Joint]) -> None:
        if not joints:
            return
        begun = {joint: self._held[joint].read(name) for joint in joints}
        self._former |= {(joint, name): goal for joint, goal in begun.items()}
        self._written |= {(joint, name): goal for joint, goal in begun.items()}
        for step in range(1, _STEPS + 1):
            self._clock.wait_until(self._clock.now() + FADE_S / _STEPS)
            self._refuse_rewritten()
            for joint, goal in begun.items():
                self._write(joint, name, round(goal * (1 - step / _STEPS)))

    def _wait_until_still(self) -> tuple[Joint, ...]:
        until = self._clock.now() + SINKING_S
        since = dict.fromkeys(self._held, self._clock.now())
        before = self._positions()
        while (now := self._clock.now()) < until:
            self._clock.wait_until(now + _LOOK_S)
            self._refuse_rewritten()
            for joint, position in self._positions().items():
                if abs(position - before[joint]) > _STILL_TICKS:
                    before[joint], since[joint] = position, self._clock.now()
            if self._clock.now() - max(since.values()) >= _STILL_S:
                return ()
        return tuple(joint for joint, last in since.items() if self._clock.now() - last < _STILL_S)

    def _positions(self) -> dict[Joint, int]:
        return {joint: servo.read("Present Position") for joint, servo in self._held.items()}

    def _write(self, joint: Joint, name: str, value: int) -> None:
        former = self._written[joint, name]
        self._written[joint, name] = value
        try:
            self._held[joint].write(name, value)
        except ServoRefused:
            self._refuse_rewritten(either=former)
            raise

    def _refuse_rewritten(self, either: int | None = None) -> None:
        """Raise BusShared if a servo with torque on holds a goal that this program did not write.

        Servos with torque off are ignored, since they have been rebooted or released by another program; so are servos
        whose Bus Watchdog has tripped, which zeroes the goal. either: another permitted value, since the latest write
        may have been lost.
        """
        for (joint, name), written in self._written.items():
            servo = self._held[joint]
            if servo.read(name) == written or (found := servo.read_surely(name)) in (written, either):
                continue
            if servo.read("Torque Enable") and servo.read("Bus Watchdog") != WATCHDOG_TRIPPED:
                raise BusShared(
                    f"{joint.title}: while the arm was being let down, {name} was lowered to {written}, but reads "
                    f"{found}: another program is driving the arm. Torque was cut before the arm had come to rest, so "
                    "that it was not driven on. Stop that program, or unplug its controller, then start again."
                )

    @property
    def lowered(self) -> str:
        """The goals that have been lowered, each with its original value; "" if none has."""
        originals = {
            (joint, name): self._originals.get(joint, {}).get(name, former)
            for (joint, name), former in self._former.items()
        }
        return ", ".join(
            f"{name} of ID {joint.id}, originally {original}"
            for (joint, name), original in originals.items()
            if self._written[joint, name] != original
        )

    def cut(self) -> None:
        """Cut torque, then restore the goals. Raises the errors of `Servo.write`."""
        with signals_held_back():
            for servo in self._held.values():
                servo.write("Torque Enable", 0)
            for (joint, name), former in self._former.items():
                self._held[joint].write(name, former)

    def cut_despite_others(self) -> None:
        """Cut torque and restore the goals as far as another program permits."""
        with signals_held_back():
            for servo in self._held.values():
                with suppress(DriverError):
                    servo.write_despite_error("Torque Enable", 0)
            for (joint, name), former in self._former.items():
                with suppress(DriverError):
                    self._held[joint].write_despite_error(name, former)
