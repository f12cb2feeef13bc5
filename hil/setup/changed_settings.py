"""Detect settings that another program changed during a run: the change may explain what looks like a servo fault."""

from collections.abc import Mapping
from contextlib import suppress
from itertools import permutations

from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import PROTECTIVE, SECONDARY_ID, STATUS_LEVEL
from hil.drivers.servo_model import RETURN_DELAY_UNIT, Mode
from hil.errors import Cause

__all__ = ["EXPLAINED", "WRITTEN", "Settings", "changed_settings", "may_be_later", "settings_now"]

_MODE, _DELAY = "Operating Mode", "Return Delay Time"
_GOAL_PWM = "Goal PWM"
"""Register that limits the voltage in current mode. A value of 0 proves nothing if the watchdog has tripped."""

_BESIDE = frozenset({*PROTECTIVE, STATUS_LEVEL}) - {SECONDARY_ID}
"""Settings that are named only along with others, since changes to them cannot explain why a run was stopped. The
exception is a Status Return Level of 0.
"""

_REGISTERS = (
    _MODE,
    "Drive Mode",
    "Homing Offset",
    "PWM Limit",
    "Current Limit",
    _GOAL_PWM,
    _DELAY,
    STATUS_LEVEL,
    *PROTECTIVE,
)

_LIMITS = frozenset({"PWM Limit", "Current Limit", _GOAL_PWM})

WRITTEN = frozenset({"Operating Mode", "Current Limit", _GOAL_PWM})
"""Settings that this program writes itself."""

_LATE = frozenset({Cause.LATE, Cause.MISSING})
"""A stop for one of these reasons may be due to a longer Return Delay Time."""

_MOVED = frozenset(
    {
        Cause.POSITION,
        Cause.VELOCITY,
        Cause.JUMP,
        Cause.NOT_FOLLOWING,
        Cause.OUT_OF_VOLTAGE,
        Cause.GOALS_CHANGED,
        Cause.GOALS_LOST,
        Cause.FROZEN,
        Cause.UNEXPECTED,
        Cause.UNLIKE_BEFORE,
        Cause.WRONG_SIGN,
        Cause.EARLY_MOTION,
    }
)
"""A stop for one of these reasons may be due to changes of settings other than Return Delay Time."""

EXPLAINED = _MOVED | _LATE

_AT_A_LIMIT = frozenset({Cause.POSITION, Cause.VELOCITY})
"""A stop for one of these reasons may be due to excessive torque alone."""

_MODES_SEEN_S = 0.06
"""If the operating modes were last read back within this time [s] before the run was stopped, a mode that now differs
may have been changed after the stop.
"""

Settings = Mapping[tuple[Joint, str], int]


def settings_now(bus: ServoBus, before: Settings | None = None) -> Settings:
    """Read the settings that determine how servos move, what they report and when they shut down.

    Servos that do not answer are omitted. Each register is read twice, in opposite orders, because a reply may belong
    to an earlier request. If the two readings differ, the value is unknown and omitted. If a servo's ID register does
    not read as its ID, all its values are omitted: its replies are late, so even equal values may be those of other
    registers. Values that differ from `before` are confirmed once more, since another program would be blamed for the
    change.
    """
    found: dict[tuple[Joint, str], int] = {}
    report = bus.torque_off_report
    tripped = report.tripped if report else ()
    for joint, servo in bus.drives.items():
        has_pwm = joint.mode is Mode.CURRENT and joint not in tripped
        registers = _REGISTERS if has_pwm else [each for each in _REGISTERS if each != _GOAL_PWM]
        known = [register for register in registers if register in servo.table]
        with suppress(DriverError):
            first = {register: servo.read(register, attempts=1) for register in known}
            again = {register: servo.read(register, attempts=1) for register in reversed(known)}
            if servo.read("ID", attempts=1) == servo.id:
                found |= {(joint, each): first[each] for each in known if first[each] == again[each]}
                if servo.answered_pings_only:
                    found[joint, STATUS_LEVEL] = 0  # until torque was cut
    return found if before is None else _confirmed(bus, before, found)


def _confirmed(bus: ServoBus, before: Settings, found: Settings) -> Settings:
    """Return `found` without the values that differ from `before` unless `Servo.read_surely` confirms them."""
    kept = dict(found)
    for (joint, register), value in found.items():
        if before.get((joint, register), value) == value or bus.drives[joint].answered_pings_only:
            continue
        try:
            is_sure = bus.drives[joint].read_surely(register) == value
        except DriverError:
            is_sure = False
        if not is_sure:
            del kept[joint, register]
    return kept


def changed_settings(before: Settings, after: Settings, cause: Cause | None = None) -> str:
    """Return a message that names the settings that differ; "" if there are none, or if none can explain the stop.

    cause: why the run was stopped. Settings that cannot explain this are omitted, except for those in `_BESIDE`.
    """
    differing = {each: value for each, value in before.items() if after.get(each, value) != value}
    if not any(_may_explain(each[1], cause, value, after[each]) for each, value in differing.items()):
        return ""
    changed = [
        f"{joint}: {register} from {_told(register, value)} to {_told(register, after[joint, register])}"
        for (joint, register), value in differing.items()
        if register in _BESIDE or _may_explain(register, cause, value, after[joint, register])
    ]
    said = f"Another program changed the settings of a servo during the run ({'; '.join(changed)})."
    if (swapped := _swapped(before, after)) is not None:
        first, second = swapped
        if first.servo is not second.servo:  # almost all settings of different models differ
            said = "Another program changed the settings of a servo during the run."
        said += f" {first.title} now has the settings that {second} had: their IDs may have been swapped."
    return said


def _swapped(before: Settings, after: Settings) -> tuple[Joint, Joint] | None:
    """Return two servos, the first of which now has all the settings that the second had; None if there is no such
    pair. If they are of different models, only registers that both have can be compared.
    """
    old, new = _by_joint(before), _by_joint(after)
    for first, second in permutations(old, 2):
        now, then, its_own = new.get(first, {}), old[second], old[first]
        if first.servo is not second.servo:
            then = {name: value for name, value in then.items() if name in now}
            its_own = {name: value for name, value in its_own.items() if name in now}
        if now and its_own != then == now:
            return first, second
    return None


def _by_joint(settings: Settings) -> dict[Joint, dict[str, int]]:
    found: dict[Joint, dict[str, int]] = {}
    for (joint, register), value in settings.items():
        found.setdefault(joint, {})[register] = value
    return found


def may_be_later(before: Settings, after: Settings, cause: Cause, modes_seen_ago: float) -> str:
    """Return a note for a run that was stopped at a limit: the operating mode may have been changed after it was
    stopped.

    Returns "" if other settings changed too, or if the change may have caused the stop.

    modes_seen_ago: time from the latest correct read-back of the operating modes to the stop [s].
    """
    changed = {each[1] for each, value in before.items() if after.get(each, value) != value}
    if changed != {_MODE} or cause not in _AT_A_LIMIT or modes_seen_ago > _MODES_SEEN_S:
        return ""
    last = f"{1e3 * modes_seen_ago:.0f} ms before the stop, all operating modes were still as this program had set them"
    return f"{changed_settings(before, after)} This may have happened after the stop: {last}."


def _may_explain(register: str, cause: Cause | None, before: int, now: int) -> bool:
    """Whether a change of a register from `before` to `now` may explain why the run was stopped."""
    if register == STATUS_LEVEL and now == 0:
        return cause in (None, Cause.MISSING)
    if cause is None or register in _BESIDE:
        return cause is None
    if register in _LIMITS and now > before:
        return False  # this program's goals are below the former limit
    return cause in (_LATE if register == _DELAY else _MOVED)


def _told(register: str, value: int) -> str:
    return f"{1e6 * RETURN_DELAY_UNIT * value:.0f} us" if register == _DELAY else str(value)
