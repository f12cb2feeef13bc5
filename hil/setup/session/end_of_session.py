"""End of a session: which exception is finally raised, and what it states about torque."""

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError, TorqueNotOff
from hil.drivers.torque.off import TorqueOff, and_list, signals_held_back
from hil.errors import ExperimentError, HilError

_LATE_CONFIRMED = "Replies were missing when torque was cut at the end of the run: check the cables and the supply."
"""Message if every servo has eventually answered and nothing else is wrong."""

_TELLS_OF_TORQUE = re.compile("torque (off )?is", re.IGNORECASE)
"""Matches every sentence that states whether torque is off (see `TorqueOff`)."""

_NEVER_ON = "Torque is off on all servos, confirmed by reading it back; this command has not switched it on."


def end_with(bus: ServoBus, stopped: BaseException | None, left: Sequence[str], before: TorqueOff | None) -> None:
    """Add the remaining messages to the exception that ended the block; if it no longer applies, raise another instead.

    before: the report on torque before the settings were restored; None if this command had not switched torque on.
    """
    report = bus.torque_off_report
    instead: BaseException | None = None
    if isinstance(stopped, TorqueNotOff):
        instead = confirmed_later(bus, stopped)
    elif report is not None and not report.is_off:
        instead = TorqueNotOff(str(report))
        if stopped is not None:
            _retract(stopped, _NEVER_ON if before is None else str(before))
            instead.last_samples = getattr(stopped, "last_samples", None)
    if ended := instead or stopped:
        for line in left:  # last, because what stopped the arm and whether its torque is off matter more
            ended.add_note(line)
    elif left:
        raise ExperimentError(" ".join(left))
    if isinstance(instead, TorqueNotOff):
        raise instead
    if instead is not None:
        raise instead from None


def _retract(stopped: BaseException, told: str) -> None:
    """Remove an outdated sentence about torque from an exception's notes."""
    if notes := getattr(stopped, "__notes__", None):
        notes[:] = [rest for note in notes if (rest := note.replace(told, "").strip())]


def confirmed_later(bus: ServoBus, error: TorqueNotOff) -> BaseException | None:
    """Return the exception to raise in place of `error` if torque is now off on all servos, otherwise None.

    This is the exception that led to torque being cut or, if replies were missing only when torque was cut at the end,
    an ExperimentError. A note about the torque state is attached to it.
    """
    report = bus.torque_off_report
    error.args = (str(report),)
    if report is None or not report.is_off:
        return None
    cause = error.__context__ or ExperimentError(_LATE_CONFIRMED)
    cause.add_note(str(report))
    return cause


@contextmanager
def telling_of_torque(bus: ServoBus) -> Iterator[None]:
    """Add a note about torque to any exception that ends the block, unless it already has one. An exception has none if
    the session is stopped between two runs. A DriverError is also marked if this program had switched torque on.
    """
    try:
        yield
    except TorqueNotOff:
        raise
    except BaseException as ended:
        if isinstance(ended, DriverError):
            ended.after_torque = bus.has_switched_on
        is_stop = isinstance(ended, KeyboardInterrupt | HilError | DriverError)
        told = any(_TELLS_OF_TORQUE.search(note) for note in getattr(ended, "__notes__", []))
        if not told and (is_stop or bus.torque_off_report is not None):
            with signals_held_back():
                ended.add_note(about_torque(bus))
        raise


def about_torque(bus: ServoBus) -> str:
    """Return a sentence about the servos' torque while no run is in progress."""
    if bus.torque_off_report is not None:
        return str(bus.torque_off_report)
    on: list[str] = []
    unread: list[tuple[str, DriverError]] = []
    for joint, servo in bus.drives.items():
        try:
            if servo.read("Torque Enable"):
                on.append(joint.title)
        except DriverError as error:
            unread.append((joint.title, error))
    told = [f"TORQUE IS ON at {' and '.join(on)}: it was on before this command."] if on else []
    if unread:
        told.append(
            "This command has not switched torque on, but could not read whether it is off at "
            f"{and_list(title for title, _ in unread)}: {unread[0][1]}"
        )
    return " ".join(told) or _NEVER_ON
