"""Settings that a killed program left on the servos.

If a register holds neither the value that the killed program set nor the earlier one, another program has changed it.
Such a register is reported but not restored, since the user may have wanted the change.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hil.drivers.errors import NoReply, TorqueHeld
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import LIMIT_OF_GOAL, attainable, cut_goals, put_back, read_settings
from hil.drivers.servo import Servo
from hil.setup.session import settings_file
from hil.setup.session.settings_file import Kept

__all__ = ["REBOOT_S", "HalfLetDown", "Left", "Restored", "left_behind", "recover", "recover_patiently", "what_is_left"]

REBOOT_S = 0.6
"""A servo that does not answer may be booting, so it is tried again after this time [s]."""

_LOWERED = ("Goal PWM", "Goal Current")
"""The registers that change while an arm is let down (`hil.drivers.torque.held`)."""

_MODE, _CURRENT_LIMIT = "Operating Mode", "Current Limit"


class HalfLetDown(TorqueHeld):
    """An earlier program ended while it was letting this servo's joint down (--take-over); its torque is on."""


def left_behind(port: str, joint: Joint) -> Kept | None:
    """Settings of this joint's servo that a terminated program did not restore; None if there are none."""
    kept = settings_file.load(port, joint.id, joint.servo.name)
    return kept if kept is not None and kept.may_restore else None


@dataclass(frozen=True)
class Left:
    """Settings that a killed program left on one servo.

    kept: the settings from before that program ran. changed: the registers that another program has changed since then,
    each with its present value. wanted: the settings to restore; the changed registers keep their present values.
    differing: the registers to restore, each with its present value and the value to restore.
    """

    kept: Kept
    wanted: dict[str, int]
    changed: dict[str, int]
    differing: dict[str, tuple[int | None, int]]

    @property
    def is_to_restore(self) -> bool:
        return bool(self.differing)

    def told(self, title: str) -> str:
        """Return a message that states what is restored and what is not; it begins with `title`, the name of the
        servo.
        """
        others = self.others if self.changed else ""
        if not self.is_to_restore:
            return f"{title}: {others}" if others else ""
        restored = (
            f"an earlier run ended before it could restore the servo's settings ({self.kept.since}); this one will "
            "restore them."
        )
        return f"{title}: {restored} {others[:1].upper()}{others[1:]}".rstrip()

    @property
    def others(self) -> str:
        """A sentence about the registers that another program changed."""
        named = " and ".join(
            f"its {name} is {value} and was {self.kept.settings[name]}" for name, value in self.changed.items()
        )
        cut = ", and its Goal Current is restored only up to this limit" if _CURRENT_LIMIT in self.changed else ""
        return (
            f"{named} before the run of {self.kept.since}. Another program changed this during that run or since, so "
            f"it is left as it is{cut}. To change it back, use DYNAMIXEL Wizard 2.0."
        )

    def is_refused(self, needed: Mapping[str, int]) -> bool:
        """Whether a run cannot start because another program has lowered the Current Limit too far.

        needed: the registers that the run sets, with their values.
        """
        return self.changed.get(_CURRENT_LIMIT, 0) < needed.get(_CURRENT_LIMIT, 0) and _CURRENT_LIMIT in self.changed


def what_is_left(kept: Kept, servo: Servo, present: Mapping[str, int]) -> Left:
    """Compare the settings saved before a program was killed with the present ones.

    Raises the same errors as `Servo.read`.

    If another program changed the Operating Mode, the present goals and gains belong to the new mode and are left as
    they are. A program that only began to let the arm down changed nothing but its goals; whatever else differs is due
    to a power cycle, or this is another arm's servo, on a port of the same name.
    """
    if kept.was_held and all(kept.settings.get(name) == value for name, value in kept.changed.items()):
        changed = {}
        wanted = {**present, **{name: kept.settings[name] for name in _LOWERED if name in kept.settings}}
    else:
        changed = {
            name: present[name]
            for name, value in kept.changed.items()
            if name in present and name in kept.settings and present[name] not in (value, kept.settings[name])
        }
        settings = {**present, **{name: kept.settings[name] for name in kept.changed if name in kept.settings}}
        wanted = {**(settings if _MODE in changed else kept.settings), **changed}
    possible = attainable(servo, wanted)
    differing = {name: (present.get(name), value) for name, value in possible.items() if present.get(name) != value}
    return Left(kept, wanted, changed, differing)


def is_left_on(servo: Servo, kept: Kept) -> bool:
    """Return whether the killed program left this servo's torque on. Raises the errors of `Servo.read`.

    If torque is on in a mode other than that program's, another program has switched it on since. Torque that was
    already on when the killed program took the arm over was not left on by that program.
    """
    if kept.was_held:
        return False
    return bool(servo.read("Torque Enable")) and kept.changed.get(_MODE) in (None, servo.read(_MODE))


def half_let_down(kept: Kept, servo: Servo) -> str:
    """Return a message if a program ended while it was letting this servo's joint down (--take-over). Returns "" if no
    program did, if torque is off by now, or if the settings are the original ones. Raises the errors of `Servo.read`.
    """
    if not (kept.was_held and servo.read("Torque Enable")):
        return ""
    differing = what_is_left(kept, servo, read_settings(servo)).differing
    if not differing:
        return ""
    lowered = ", ".join(f"{name} is {now} and was {before}" for name, (now, before) in differing.items())
    return (
        f"its torque is on, {lowered}: an earlier hil run ({kept.since}) ended while it was letting the arm down. Hold "
        "the arm by hand, then start again with --take-over, which lets it down completely and restores these values; "
        "or hold it and switch its supply off and on, after which `hil check` restores them."
    )


def switch_off_left(servo: Servo, kept: Kept) -> bool:
    """Switch off torque that the killed program left on; return whether it was on.

    Raises HalfLetDown, TorqueHeld if another program has switched it on since, and the errors of `Servo.write`.
    """
    if is_left_on(servo, kept):
        servo.write("Torque Enable", 0)
        return True
    if told := half_let_down(kept, servo):
        raise HalfLetDown(f"{servo.title}: {told}")
    if servo.read("Torque Enable"):
        raise TorqueHeld(
            f"{servo.title}: its torque is on in Operating Mode {servo.read(_MODE)}, but an earlier run "
            f"({kept.since}), which ended before it could restore this servo, had set mode {kept.changed.get(_MODE)}: "
            "another program has switched torque on since. Stop that program, then try again."
        )
    return False


@dataclass(frozen=True)
class Restored:
    """What `recover` did.

    written: the restored settings, as text. others: a sentence about changes by another program; "" if none. was_on:
    whether torque was on and has been switched off.
    """

    written: list[str] = field(default_factory=list)
    others: str = ""
    was_on: bool = False


def recover_patiently(servo: Servo, port: str) -> Restored:
    """Like `recover`, but if the servo stops answering, try once more after the time that it takes to boot."""
    try:
        return recover(servo, port)
    except NoReply:
        servo.port.clock.wait_until(servo.port.clock.now() + REBOOT_S)
        return recover(servo, port)


def recover(servo: Servo, port: str) -> Restored:
    """Restore settings left behind by a terminated program, and switch off torque that it left on.

    Raises the same errors as `Servo.write`, DamagedSettings, and TorqueHeld if another program has switched torque
    on since.

    The file with the earlier settings is kept as long as another program's value prevents a register from being
    restored.
    """
    kept = settings_file.load(port, servo.id, servo.table.model)
    if kept is None or not kept.may_restore:
        return Restored()
    if kept.was_held and servo.read("Torque Enable") and not half_let_down(kept, servo):
        settings_file.forget(kept)  # nothing of it is left, and the torque is another program's
        return Restored()
    was_on = switch_off_left(servo, kept)
    left = what_is_left(kept, servo, read_settings(servo))
    written = put_back(servo, left.wanted)
    others = [left.others] if left.changed else []
    others += [
        f"its {name} is {value} and was {left.wanted[name]} before the run of {kept.since}, because its "
        f"{LIMIT_OF_GOAL[name]} does not allow more. Another program changed this limit; once it has been set back "
        "with DYNAMIXEL Wizard 2.0, the next hil check restores the goal."
        for name, value in cut_goals(servo, left.wanted).items()
    ]
    if not others:
        settings_file.forget(kept)
    told = [f"{name} {before} -> {after}" for name, (before, after) in written.items()]
    return Restored(told, " ".join(others), was_on)
