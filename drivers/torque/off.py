"""Cutting torque: torque off is sent to every servo and read back, regardless of failures and interrupts.

The order matters. Every packet feeds the Bus Watchdog of every servo that receives it, whatever ID it addresses. If a
servo receives packets but does not obey, because it refuses them or its ID has changed, only its watchdog can stop its
current. Torque off is therefore first sent to all servos at once, which takes 0.3 ms; then each servo is polled until
one does not reply. From then on, the bus stays silent until the Bus Watchdogs time out. If a servo is already silent
before torque is cut, torque off is sent three times, since a packet may be lost, and the silence begins at once. After
the silence, all servos not yet confirmed are polled again, several times.

Ctrl-C raises KeyboardInterrupt at any point of the program, even between two servos while torque is being cut. A
program that uses the driver as a library may not have signal handlers that merely set a flag, so the driver itself
holds signals back while torque is cut.
"""

import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from types import FrameType

from hil.drivers.errors import DriverError, InconsistentReplies, NoReply, PortLost
from hil.drivers.joint import Joint
from hil.drivers.packet import BROADCAST_ID, Instruction, encode
from hil.drivers.port import Port
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.servo import Servo
from hil.drivers.servo_model import WATCHDOG_UNIT, Mode

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_INTERRUPTS_BORNE = 5
"""Number of attempts interrupted by Ctrl-C after which cutting a servo's torque counts as failed."""

TRIP_S = WATCHDOG_UNIT + 5e-3
"""How long after its timeout a watchdog may trip [s], since it counts in steps of 20 ms."""

_REPEATS, _REPEAT_S = 2, 0.001
"""Number of further torque-off packets and the time between them [s]: a packet that collides with a reply is lost."""


@dataclass(frozen=True)
class TorqueOff:
    """Result of an attempt to cut torque.

    confirmed: joints whose servos' torque was read back as off.
    unconfirmed: joints whose torque could not be confirmed as off, each with the reason.
    unwatched: confirmed or unconfirmed joints whose servos have no Bus Watchdog.
    later: confirmed joints whose servos did not answer at first.
    rebooted: confirmed joints whose servos were reset, which disarmed the watchdog armed before torque was switched on.
    disarmed: confirmed joints whose watchdog is off although they hold a goal: another program switched it off, or they
        were reset and have received goals since.
    tripped: joints whose Bus Watchdog may have tripped, which zeroes their goals; it has been cleared since.
    driven: the remaining joints, whose torque another program switches on again whenever it is cut.
    """

    confirmed: tuple[Joint, ...]
    unconfirmed: tuple[tuple[Joint, str], ...]
    unwatched: frozenset[Joint] = frozenset()
    rebooted: frozenset[Joint] = frozenset()
    disarmed: frozenset[Joint] = frozenset()
    later: frozenset[Joint] = frozenset()
    tripped: frozenset[Joint] = frozenset()
    driven: tuple[Joint, ...] = ()

    @property
    def is_off(self) -> bool:
        """Whether torque off was read back from every servo."""
        return not self.unconfirmed and not self.driven

    def with_driven(self, on: Collection[Joint], silent: Collection[Joint]) -> "TorqueOff":
        """Return the report, updated because another program has switched torque on again.

        on: joints whose servos' torque is on again each time it is cut. silent: joints whose servos have not
        answered since.
        """
        why = "Another program had switched torque on again; the servo's later answers are missing or contradictory."
        return replace(
            self,
            confirmed=tuple(joint for joint in self.confirmed if joint not in {*on, *silent}),
            unconfirmed=(*self.unconfirmed, *((joint, why) for joint in silent)),
            driven=tuple(on),
        )

    def with_doubted(self, joint: Joint, why: str) -> "TorqueOff":
        """Return the report with this joint moved to the unconfirmed ones, although its torque reads back as off."""
        confirmed = tuple(each for each in self.confirmed if each != joint)
        return replace(self, confirmed=confirmed, unconfirmed=(*self.unconfirmed, (joint, why)))

    def with_later(self, joint: Joint, *, rebooted: bool | None) -> "TorqueOff":
        """Return the report with this joint moved to the confirmed ones, since its servo has answered again and its
        torque reads back as off.

        rebooted: result of `was_rebooted`.
        """
        return replace(
            self,
            confirmed=(*self.confirmed, joint),
            unconfirmed=tuple(each for each in self.unconfirmed if each[0] != joint),
            later=self.later | {joint},
            tripped=self.tripped | {joint},
            rebooted=self.rebooted | ({joint} if rebooted else set()),
            disarmed=self.disarmed | ({joint} if rebooted is False else set()),
        )

    def __str__(self) -> str:
        return " ".join((self._outcome(), *self._answers()))

    def _answers(self) -> Iterator[str]:
        """Yield sentences about servos that were silent or rebooted and have answered since."""
        for joint in self.confirmed:
            if joint in self.later:
                yield f"{joint.title} did not answer at first, but answers again."
            if joint in self.rebooted:
                yield (
                    f"{joint.title} was rebooted: its Bus Watchdog is no longer armed. Check its supply and its "
                    "connector; a brief voltage dip is enough to reboot it."
                )
            if joint in self.disarmed:
                yield (
                    f"{joint.title} holds a goal, but another program has switched off its Bus Watchdog (stop that "
                    "program), or a brief dip of its supply rebooted it and it has received goals since (check its "
                    "supply and its connector)."
                )

    def _reasons(self) -> Iterator[tuple[str, list[Joint]]]:
        """Yield the reasons why servos are unconfirmed, each with its joints; see `by_reason`."""
        yield from by_reason(self.unconfirmed).items()

    def _outcome(self) -> str:
        if not self.driven:
            return self._outcome_alone()
        told = [
            f"TORQUE IS ON AT {and_list(str(joint).upper() for joint in self.driven)}: ANOTHER PROGRAM TURNS IT BACK "
            "ON EVERY TIME IT IS CUT. CUT THE POWER NOW, then end that program."
        ]
        if self.unconfirmed:
            told.append(self._outcome_alone())
        elif self.confirmed:
            told.append(f"Torque is off on {and_list(map(str, self.confirmed))}, confirmed by reading it back.")
        return " ".join(told)

    def _outcome_alone(self) -> str:
        """Return the outcome for the servos that no other program drives."""
        if not self.unconfirmed:
            count = len(self.confirmed)
            servos = {1: "the servo", 2: "both servos"}.get(count, f"all {count} servos")
            return f"Torque is off on {servos}, confirmed by reading it back."
        names = " Nor for ".join(
            f"{and_list(str(joint).upper() for joint in joints)}. {why}" for why, joints in self._reasons()
        )
        if self.confirmed:
            names = f"{names} Torque is off on {and_list(map(str, self.confirmed))}, confirmed by reading it back."
        alone = [str(joint).upper() for joint, _ in self.unconfirmed if joint in self.unwatched]
        if alone:
            return (
                f"TORQUE OFF IS NOT CONFIRMED for {names} NOTHING STOPS {' AND '.join(alone)}: without a Bus "
                "Watchdog, the last current may remain, so cut the power now."
            )
        return (
            f"TORQUE OFF IS NOT CONFIRMED for {names} The Bus Watchdog stops a servo that receives nothing, "
            "but still cut the power before you touch the arm."
        )


def cut_torque(
    port: Port,
    servos: Mapping[Joint, Servo],
    silent: Collection[Joint],
    watchdog: float,
    interrupts: list[BaseException],
) -> tuple[tuple[Joint, ...], tuple[tuple[Joint, str], ...]]:
    """Cut torque on all servos and read it back. Return the confirmed joints, and each unconfirmed joint with the
    reason.

    silent: servos that did not answer the last exchange.
    watchdog: timeout of the servos' Bus Watchdogs [s].
    interrupts: receives every interrupt that arrives in the meantime.
    """
    left = dict(servos)
    why: dict[Joint, Exception] = {}

    def wait(seconds: float) -> None:
        _uninterrupted(lambda: port.clock.wait_until(port.clock.now() + seconds), interrupts)

    def tell() -> Exception | None:
        return _uninterrupted(lambda: tell_torque_off(port, servos), interrupts)

    def confirm(joint: Joint, *, at_once: bool) -> Exception | None:
        failed = _confirm(servos[joint], interrupts, at_once=at_once)
        if failed is None:
            del left[joint]
        else:
            why[joint] = failed
        return failed

    lost = isinstance(tell(), PortLost)
    for _ in range(_REPEATS if silent and not lost else 0):
        wait(_REPEAT_S)
        tell()
    for joint in () if silent and not lost else servos:
        failed = confirm(joint, at_once=True)
        lost = lost or isinstance(failed, PortLost)
        if failed is not None and not lost:
            if isinstance(failed, NoReply):
                break
            tell()  # a damaged reply shows that the servo still receives packets, so its watchdog will not stop it
    if left and not lost:
        wait(watchdog + TRIP_S)
        tell()
        for joint in tuple(left):
            failed = confirm(joint, at_once=False)
            if isinstance(failed, NoReply) and _uninterrupted(servos[joint].let_answer, interrupts) is None:
                failed = confirm(joint, at_once=False)
            if failed is not None:
                tell()
    return tuple(joint for joint in servos if joint not in left), tuple((joint, _text(why[joint])) for joint in left)


def tell_torque_off(port: Port, servos: Mapping[Joint, Servo]) -> None:
    """Send torque off to all servos in one packet. Raises PortLost.

    The packet is a Sync Write to these servos only, since other servos on the bus may be in use. It is sent twice in
    case one copy is lost.
    """
    _tell(port, servos, "Torque Enable", 0, times=2)


def tell_watchdogs(port: Port, servos: Mapping[Joint, Servo], seconds: float) -> None:
    """Set the Bus Watchdogs of all servos to `seconds` [s] in one packet; a failure leaves them as they are."""
    with suppress(DriverError):
        _tell(port, servos, "Bus Watchdog", max(1, round(seconds / WATCHDOG_UNIT)))


def _tell(port: Port, servos: Mapping[Joint, Servo], register: str, value: int, times: int = 1) -> None:
    """Write to a one-byte register of all servos, without waiting for an answer. Raises PortLost."""
    every = list(servos.values())
    if not every:
        return
    entry = every[0].table[register]
    body = entry.address.to_bytes(2, "little") + entry.size.to_bytes(2, "little")
    body += b"".join(bytes((servo.id, value)) for servo in every)
    port.write(times * encode(BROADCAST_ID, Instruction.SYNC_WRITE, body))


def disarm_watchdogs(servos: Mapping[Joint, Servo], interrupts: list[BaseException]) -> frozenset[Joint]:
    """Switch the Bus Watchdogs off once torque is off, since nothing feeds them any more.

    Return the joints whose watchdog has tripped or may have tripped, since a servo does not report this once its
    watchdog is off.
    """
    tripped = set(servos)

    def disarm(joint: Joint, servo: Servo) -> None:
        with suppress(Exception):
            if servo.read_despite_error("Bus Watchdog") != WATCHDOG_TRIPPED:
                tripped.discard(joint)
        servo.write_despite_error("Bus Watchdog", 0)

    for each in servos.items():
        _uninterrupted(partial(disarm, *each), interrupts)
    return frozenset(tripped)


def cut_again(servo: Servo, *, armed: bool) -> bool | None:
    """Cut the torque of a servo that did not answer before; return the result of `was_rebooted`, None if not `armed`.

    armed: whether its Bus Watchdog was armed before torque was switched on; if so, the watchdog is switched off. Raises
    the errors of `Servo.write`.
    """
    if servo.read_despite_error("Torque Enable"):
        servo.write_despite_error("Torque Enable", 0)
    rebooted = was_rebooted(servo) if armed else None
    if armed:
        servo.write_despite_error("Bus Watchdog", 0)
    return rebooted


def is_torque_on(servo: Servo) -> bool | None:
    """Whether a servo's torque is on; None if this is unknown (`has_torque`) or the servo does not answer."""
    with suppress(DriverError):
        return has_torque(servo)
    return None


def has_torque(servo: Servo) -> bool | None:
    """Read whether a servo's torque is on; None if its answers disagree and may thus belong to other requests.

    Raises the errors of `Servo.read`.
    """
    try:
        return bool(servo.read_surely("Torque Enable"))
    except InconsistentReplies:
        return None


def was_rebooted(servo: Servo) -> bool | None:
    """Whether a servo whose watchdog is no longer armed was rebooted; None if the watchdog is still armed or the servo
    does not answer.

    A reboot also resets the goal to its limit; a program that only writes to the watchdog leaves the goal as it is. A
    late reply to an earlier request could be mistaken for the answer, so another register is read before and after.
    """
    with suppress(DriverError):
        if servo.read("ID") == servo.id and servo.read("Bus Watchdog") == 0 and servo.read("ID") == servo.id:
            what = "Current" if servo.read("Operating Mode") == Mode.CURRENT else "PWM"
            return servo.read(f"Goal {what}") == servo.read(f"{what} Limit")
    return None


def _confirm(servo: Servo, interrupts: list[BaseException], *, at_once: bool) -> Exception | None:
    """Switch torque off and read it back; return None if this succeeded, otherwise the exception.

    at_once: try only once, and send nothing after a missing reply.
    """
    write = servo.write_once if at_once else servo.write_despite_error
    return _uninterrupted(lambda: write("Torque Enable", 0), interrupts)


def _uninterrupted(action: Callable[[], None], interrupts: list[BaseException]) -> Exception | None:
    """Run `action`; return None if it succeeded, otherwise the exception.

    If an interrupt arrives, it is appended to `interrupts`, and the action is run again.
    """
    for _ in range(_INTERRUPTS_BORNE):
        try:
            action()
        except Exception as error:  # whatever fails on one servo, the next must still be tried
            return error
        except BaseException as interrupt:
            interrupts.append(interrupt)
        else:
            return None
    return DriverError("The write was interrupted repeatedly.")


def by_reason(failures: Iterable[tuple[Joint, str]]) -> dict[str, list[Joint]]:
    """Return the joints to which each reason applies; reasons that differ only in the joint's name are merged."""
    joints: dict[str, list[Joint]] = {}
    own = {joint: _of_it(why.replace(joint.title, "It").replace(str(joint), "it")) for joint, why in failures}
    for joint, why in own.items():
        joints.setdefault(why, []).append(joint)
    return {
        why.replace("It ", "Each ", 1) if len(each) > 1 and why.startswith("It ") else why: each
        for why, each in joints.items()
    }


def _of_it(why: str) -> str:
    """Return the reason without the name before a colon: "It: reading failed" becomes "Reading failed"."""
    rest = why.removeprefix("It: ")
    return rest[:1].upper() + rest[1:]


def and_list(names: Iterable[str]) -> str:
    """Join names with commas and "and"."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


def _text(error: Exception) -> str:
    return str(error) or type(error).__name__


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Hold back SIGINT, SIGTERM and SIGHUP in the `with` block; each kind that arrived is raised once afterwards.

    Only the main thread receives signals; in any other thread this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if number not in came:
            came.append(number)

    # The handler is None if it was not installed from Python. It could not be restored, so it is not replaced.
    former = {number: handler for number in _SIGNALS if (handler := signal.getsignal(number)) is not None}
    try:
        for number in former:
            signal.signal(number, note)
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
        for late in came:
            signal.raise_signal(late)
