"""Report settings that could not be restored to their values before the session."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from hil.drivers.errors import DriverError
from hil.drivers.joint import Joint
from hil.drivers.preparation.settings import LIMIT_OF_GOAL
from hil.drivers.servo import Servo
from hil.drivers.torque.off import and_list, by_reason
from hil.setup.changed_settings import Settings
from hil.setup.session.killed_run import half_let_down, recover
from hil.setup.session.saved_settings import SavedSettings

_DELAY = "Return Delay Time"
_OFFSET, _DRIVE_MODE = "Homing Offset", "Drive Mode"
_PWM_LIMIT, _GOAL_PWM = "PWM Limit", "Goal PWM"
_NEXT = "The next hil identify, record, check or setup on this port restores them from"


def unrestored(
    saved: SavedSettings,
    failed: Mapping[Joint, DriverError],
    before: Settings,
    delays: Mapping[Joint, int],
    *,
    is_ours: bool,
) -> list[str]:
    """Return a message for each reason why a setting differs.

    failed: the errors of the servos whose settings could not be restored. before, delays: all settings, and the Return
    Delay Times [2 us], at the beginning of the session. is_ours: whether the servos may be written to.
    """
    return [
        *_not_reached(saved, is_ours=is_ours),
        *_changed_delays(saved, delays, failed),
        *_lowered_limits(saved, before, failed),
        *_changed_meaning(saved, before, failed),
        *(
            f"{_outcome(joints, failed)} {why} {_NEXT} {_where([saved.kept[joint].path for joint in joints])}."
            for why, joints in by_reason((joint, str(error)) for joint, error in failed.items()).items()
        ),
    ]


def _outcome(joints: Sequence[Joint], failed: Mapping[Joint, DriverError]) -> str:
    servos = and_list(map(str, joints))
    if all(failed[joint].in_doubt for joint in joints):
        return f"Some settings of {servos} may not have been restored."
    return f"The settings of {servos} could not be restored."


def _not_reached(saved: SavedSettings, *, is_ours: bool) -> Iterator[str]:
    """Restore settings that an earlier run left on servos that this run did not reach; report those that cannot be
    restored.
    """
    waiting: list[tuple[Joint, str]] = []
    half_down: list[Joint] = []
    for joint, kept in saved.left.items():
        if joint in saved.kept:
            continue
        if kept.was_held and not is_ours:
            half_down += [joint] if _is_half_down(saved, joint) else []
            continue
        why = "This run ended before it could restore them."
        if is_ours:
            try:
                saved.bus.confirm_later(joint)
                if (others := recover(saved.bus.drives[joint], saved.bus.port.url).others) != "":
                    yield f"{joint.title}: {others}"
                continue
            except DriverError as error:
                why = str(error)
        waiting.append((joint, why))
    if half_down:
        yield (
            f"The settings of {and_list(map(str, half_down))} from before the arm was taken over are in "
            f"{_where([saved.left[joint].path for joint in half_down])}. The next start with --take-over restores "
            "them; if the servos are switched off and on, `hil check` restores them as well."
        )
    for why, joints in by_reason(waiting).items():
        paths = [saved.left[joint].path for joint in joints]
        yield (
            f"The settings that an earlier run left on {and_list(map(str, joints))} are not restored yet. {why} "
            f"{_NEXT} {_where(paths)}."
        )


def _is_half_down(saved: SavedSettings, joint: Joint) -> bool:
    """Whether a servo that was being let down still has its lowered goals, with torque on, or could not be fully
    restored.
    """
    kept = saved.left[joint]
    try:
        if half_let_down(kept, saved.bus.drives[joint]):
            return True
        return bool(recover(saved.bus.drives[joint], saved.bus.port.url).others)
    except DriverError:
        return True


def _changed_delays(saved: SavedSettings, delays: Mapping[Joint, int], silent: Collection[Joint]) -> Iterator[str]:
    """Report which Return Delay Times were changed during the session, by another program or a factory reset."""
    for joint, before in delays.items():
        now = before
        if joint not in silent:
            with suppress(DriverError):
                now = saved.bus.drives[joint].read_surely(_DELAY)
        if now != before:
            yield (
                f"{joint.title}: {_DELAY} was changed during this command from {2 * before} to {2 * now} us, by "
                "another program or a factory reset, which changes other settings too. To restore it: "
                f"hil setup {saved.bus.port.url} --id {joint.id} --return-delay-us {2 * before}"
            )


def _lowered_limits(saved: SavedSettings, settings: Settings, silent: Collection[Joint]) -> Iterator[str]:
    """Report which PWM Limits were lowered during the session, and which goals cannot be restored as a result."""
    for joint, servo in saved.bus.drives.items():
        before = settings.get((joint, _PWM_LIMIT))
        if joint in silent or joint not in saved.wanted:
            continue
        with suppress(DriverError):
            now, wanted = servo.read_surely(_PWM_LIMIT), saved.wanted[joint]
            if before is None or now == before:
                yield from _goals_beyond_limits(saved, joint, servo)
                continue
            reduced = [
                f"{name} is {value}, not {wanted[name]}"
                for name, value in saved.reduced[joint].items()
                if name == _GOAL_PWM
            ]
            is_later = reduced and joint not in saved.left
            later = "; the next start on this port then restores the goal" if is_later else ""
            yield (
                f"{joint.title}: {_PWM_LIMIT} was changed during this command from {before} to {now}, by another "
                f"program or a factory reset, and is left as it is{': ' if reduced else ''}{', '.join(reduced)}. "
                f"To change it back, use DYNAMIXEL Wizard 2.0{later}."
            )


def _goals_beyond_limits(saved: SavedSettings, joint: Joint, servo: Servo) -> Iterator[str]:
    """Report goals that cannot be restored because another program lowered their limits before these were read."""
    for name, value in saved.reduced.get(joint, {}).items():
        if name in LIMIT_OF_GOAL and joint not in saved.left:
            yield (
                f"{joint.title}: {name} is {value}, not {saved.wanted[joint][name]} as at the start, because its "
                f"{LIMIT_OF_GOAL[name]} is {servo.read_surely(LIMIT_OF_GOAL[name])}. Another program may have lowered "
                "this limit while the servos were being set up. To raise it, use DYNAMIXEL Wizard 2.0; the next start "
                "on this port then restores the goal."
            )


def _changed_meaning(saved: SavedSettings, settings: Settings, silent: Collection[Joint]) -> Iterator[str]:
    """Report changes to settings that determine what angles or goals mean, since the next start accepts these settings
    as they are.
    """
    for joint, servo in saved.bus.drives.items():
        for name in (_OFFSET, _DRIVE_MODE):
            before = settings.get((joint, name))
            if before is None or joint in silent:
                continue
            with suppress(DriverError):
                if (now := servo.read_surely(name)) != before:
                    yield (
                        f"{joint.title}: {name} was changed during this command from {before} to {now}, by another "
                        f"program or a factory reset, and is left as it is. Set it back to {before} with DYNAMIXEL "
                        "Wizard 2.0 before the next start."
                    )


def _where(paths: Sequence[Path]) -> str:
    """The file that holds the settings of a servo; for several servos, their folder."""
    return str(paths[0]) if len(paths) == 1 else f"{len(paths)} files in {paths[0].parent}"
