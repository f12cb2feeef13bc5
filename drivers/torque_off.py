"""Cutting torque: every servo is told and asked, whatever fails and whoever interrupts.

The order matters. All are told at once, which takes 0.3 ms. Then each is asked once whether its torque is off; a
silent one costs some 40 ms, so all are told again behind it: it may hear though it cannot answer, and a packet may have
been lost. With a servo that still cannot be confirmed the bus is left in silence for as long as its Bus Watchdog waits:
questions are packets too, and they feed the watchdog of a servo that hears everything and does not obey, because it
refuses, or has another ID since. So who did not answer the last exchange is not even asked before. Then each is asked
again, with patience.

A Ctrl-C raises KeyboardInterrupt wherever the program happens to be, also between the two servos whose torque is being
cut. A program that uses the driver as a library has no handlers that would only take note of it, so the driver itself
holds signals back for the few milliseconds in which torque is cut.
"""

import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from types import FrameType

from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.drivers.packet import BROADCAST_ID, Instruction, encode
from hil.drivers.port import Port
from hil.drivers.servo import Servo
from hil.drivers.servo_model import WATCHDOG_UNIT

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

_INTERRUPTS_BORNE = 5
"""How often confirming that a servo is off is begun again after an interrupt."""

_TRIP_S = WATCHDOG_UNIT + 5e-3
"""How much later than its time a watchdog may act: it counts in steps."""


@dataclass(frozen=True)
class TorqueOff:
    """Result of the attempt to cut torque: joints read back as off, why the others could not be confirmed, and which of
    all have no Bus Watchdog.
    """

    confirmed: tuple[Joint, ...]
    unconfirmed: tuple[tuple[Joint, str], ...]
    unwatched: frozenset[Joint] = frozenset()

    def __str__(self) -> str:
        if not self.unconfirmed:
            servos = "the servo" if len(self.confirmed) == 1 else f"all {len(self.confirmed)} servos"
            return f"Torque is off on {servos}, read back."
        names = "; ".join(f"{str(joint).upper()}: {why}" for joint, why in self.unconfirmed)
        alone = [str(joint).upper() for joint, _ in self.unconfirmed if joint in self.unwatched]
        if alone:
            return (
                f"TORQUE OFF IS NOT CONFIRMED for {names} NOTHING STOPS {' AND '.join(alone)}, which has no Bus "
                "Watchdog and may keep its last current: cut the supply now."
            )
        return (
            f"TORQUE OFF IS NOT CONFIRMED for {names} The Bus Watchdog stops a servo that receives nothing, but cut "
            "the "
            "supply before you reach into the arm."
        )


def cut_torque(
    port: Port,
    servos: Mapping[Joint, Servo],
    silent: Collection[Joint],
    watchdog: float,
    interrupts: list[BaseException],
) -> tuple[tuple[Joint, ...], tuple[tuple[Joint, str], ...]]:
    """Cut torque on all servos and read it back. Returns the confirmed ones, and the others with the reason.

    silent: those that did not answer last time. watchdog: seconds without a packet after which the servos stop by
    themselves. interrupts: receives every interrupt that arrives meanwhile; none ends it.
    """
    left = dict(servos)
    why: dict[Joint, str] = {}

    def confirm(asked: Mapping[Joint, Servo], attempts: int | None) -> None:
        _uninterrupted(lambda: tell_torque_off(port, servos), interrupts)
        for joint, servo in asked.items():
            failed = _confirm(servo, attempts, interrupts)
            if failed is None:
                del left[joint]
            else:
                why[joint] = failed
                _uninterrupted(lambda: tell_torque_off(port, servos), interrupts)

    confirm({joint: servo for joint, servo in servos.items() if joint not in silent}, attempts=1)
    if left:
        _uninterrupted(lambda: port.clock.wait_until(port.clock.now() + watchdog + _TRIP_S), interrupts)
        confirm(dict(left), attempts=None)
    return tuple(joint for joint in servos if joint not in left), tuple((joint, why[joint]) for joint in left)


def tell_torque_off(port: Port, servos: Mapping[Joint, Servo]) -> None:
    """Torque off to all servos at once. A Sync Write, since other servos on the bus may be in use; twice, since a
    packet may be lost. Where it fails, reading back will say so.
    """
    every = list(servos.values())
    entry = every[0].table["Torque Enable"]
    body = entry.address.to_bytes(2, "little") + entry.size.to_bytes(2, "little")
    body += b"".join(bytes((servo.id, 0)) for servo in every)
    with suppress(DriverError):
        port.write(2 * encode(BROADCAST_ID, Instruction.SYNC_WRITE, body))


def disarm_watchdogs(servos: Mapping[Joint, Servo], interrupts: list[BaseException]) -> None:
    """Bus Watchdogs off, where torque is off: nobody feeds them any more."""
    for servo in servos.values():
        _uninterrupted(lambda servo=servo: servo.write("Bus Watchdog", 0), interrupts)  # type: ignore[misc]


def _confirm(servo: Servo, attempts: int | None, interrupts: list[BaseException]) -> str | None:
    """Write torque off and read it back; why that failed, or None. attempts: of each packet, by default as usual."""
    return _uninterrupted(lambda: servo.write("Torque Enable", 0, attempts), interrupts)


def _uninterrupted(action: Callable[[], None], interrupts: list[BaseException]) -> str | None:
    """Run it, again after an interrupt, which is kept; why it failed, or None."""
    for _ in range(_INTERRUPTS_BORNE):
        try:
            action()
        except Exception as error:  # whatever one servo does, the next must be tried
            return str(error) or type(error).__name__
        except BaseException as interrupt:
            interrupts.append(interrupt)
        else:
            return None
    return "It was interrupted repeatedly."


@contextmanager
def signals_held_back() -> Iterator[None]:
    """Inside the block SIGINT, SIGTERM and SIGHUP are noted; each kind that came is raised again after it, once.

    Only the main thread gets signals; in another one this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        if number not in came:
            came.append(number)

    # None is a handler that was not installed from Python: it could not be put back, so it stays.
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
