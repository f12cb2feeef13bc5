"""What killed runs left on the servos of a port, whether or not the current configuration describes these servos."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from hil.config.schema import Config, load_config
from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import DriverError, NoReply, PortLost, WrongModel
from hil.drivers.packet import MAX_ID
from hil.drivers.port import Port
from hil.drivers.preparation.settings import read_settings
from hil.drivers.servo import Servo
from hil.errors import HilError
from hil.next_step import command
from hil.setup.scan import Found, Heard, Watch, scan
from hil.setup.session import settings_file
from hil.setup.session.killed_run import (
    Restored,
    half_let_down,
    is_left_on,
    recover_patiently,
    switch_off_left,
    what_is_left,
)
from hil.setup.session.settings_file import DamagedSettings, Kept

_USUAL_BAUD = 1_000_000
"""Baud rate of `hil setup` without --baud."""


@dataclass(frozen=True)
class Leftovers:
    """What a killed run left on one servo.

    told: sentences that name the run, the settings that differ, and the file with the former settings. restore: the
    command that restores the servo; "" if none can. trouble: a short description of the problem.
    """

    told: str
    restore: str = ""
    trouble: str = "settings not restored after an earlier run"

    def __str__(self) -> str:
        fix = f" To switch its torque off and restore its settings, type: {self.restore}"
        return f"{self.told}{fix if self.restore else ''}"


def about_leftovers(servo: Servo) -> Leftovers | None:
    """Describe what a killed run left on this servo; None if there is nothing. Nothing is written. Raises PortLost.

    If the servo or the file cannot be read, the description says so.
    """
    port = servo.port
    try:
        kept = settings_file.load(port.url, servo.id, servo.table.model)
    except DamagedSettings as error:
        return Leftovers(str(error), trouble="the file with its settings from before a killed run is damaged")
    if kept is None or not kept.may_restore:
        return None
    restore = _restoring(kept, port)
    when = ", ".join(filter(None, [kept.since, kept.config]))
    run = f"An earlier hil run ({when}) ended before it could restore this servo"
    where = f"Its settings from before that run are in {kept.path}."
    try:
        if told := half_let_down(kept, servo):
            again = _taking_over(kept, port)
            return Leftovers(f"{told[:1].upper()}{told[1:]} {where}", again, "half let down by an earlier run")
        differing = what_is_left(kept, servo, read_settings(servo)).differing
        was_left_on, is_on = is_left_on(servo, kept), bool(servo.read("Torque Enable"))
    except PortLost:
        raise
    except DriverError as error:
        return Leftovers(f"{run}; what it left behind could not be read: {error} {where}", restore)
    if not (differing or was_left_on):
        return None
    found = ["its torque is still on"] if was_left_on else []
    found += [f"{name} is {now} and was {before}" for name, (now, before) in differing.items()]
    told = f"{run}: {', '.join(found)}. {where}"
    if is_on and not was_left_on:
        told += " Its torque is on in a mode other than that run's: first stop the program that is driving it."
    return Leftovers(told, restore)


def _restoring(kept: Kept, port: Port) -> str:
    """The command that restores a servo: `hil check` if the run's configuration still describes it on this port,
    otherwise `hil setup`.
    """
    if _described(kept, port) is not None:
        return command("check", kept.config)
    baud = ["--baud", port.baud] if port.has_baud and port.baud != _USUAL_BAUD else []
    return command("setup", port.url, *baud, "--id", kept.id)


def _taking_over(kept: Kept, port: Port) -> str:
    """The command that lets the arm down and restores a servo; "" if the run's configuration no longer describes it."""
    config = _described(kept, port)
    return "" if config is None else taking_over(config)


def taking_over(config: Config) -> str:
    """The command that lets an arm down whose torque is on, then runs its experiment."""
    return command("identify" if config.experiment.pilot else "record", config.path, "--take-over")


def _described(kept: Kept, port: Port) -> Config | None:
    """The run's configuration if it still describes this servo on this port, otherwise None."""
    if not kept.config:
        return None
    try:
        config = load_config(Path(kept.config))
        found = settings_file.load(config.bus.url, kept.id, kept.model)
    except (HilError, DriverError):
        return None
    described = {(drive.id, drive.servo.name) for joint in config.bus.joints for drive in joint.drives}
    is_same_baud = not port.has_baud or config.bus.baud == port.baud
    return config if found == kept and (kept.id, kept.model) in described and is_same_baud else None


def scan_with_leftovers(port: Port, bauds: Sequence[int], watch: Watch) -> Iterator[Heard]:
    """Scan like `hil.setup.scan.scan`, and add what killed runs left on the servos. Nothing is written to a servo.

    Raises PortLost.
    """
    for heard in scan(port, bauds, watch):
        # The port is still at this baud rate.
        yield heard._replace(servos=tuple(_with_leftovers(port, found) for found in heard.servos))


def _with_leftovers(port: Port, found: Found) -> Found:
    if found.model is None:
        return found
    left = about_leftovers(Servo(port, found.id, load_control_table(found.model)))
    return found if left is None else found.with_trouble(left.trouble)._replace(left=left.told, restore=left.restore)


def recover_all(port: Port, needed: int, say: Callable[[str], None]) -> bool:
    """Restore every servo on this port that a killed run left unrestored and that answers at the port's baud rate.

    Torque that killed runs left on is first switched off on all servos. A servo on which another program has switched
    torque on since is left as it is. Returns whether every servo that answered is restored.

    needed: ID of the servo that the caller needs. say: receives a message for each servo that was restored or could
    not be. Raises PortLost and, once all other servos have been restored, the error of `recover` for the needed servo
    if it answers.
    """
    try:
        return _recover_all(port, needed, say)
    except (PortLost, KeyboardInterrupt) as ended:
        ended.add_note(not_restored(port))
        raise


def _recover_all(port: Port, needed: int, say: Callable[[str], None]) -> bool:
    failed: dict[Servo, DriverError] = {}
    was_on: dict[Servo, bool] = {}
    for servo in _on_file(port):
        try:
            was_on[servo] = _switched_off(servo)
        except PortLost:
            raise
        except DriverError as error:
            failed[servo] = error
    for servo, is_cut in was_on.items():
        try:
            if said := _restored(recover_patiently(servo, port.url), is_cut):
                say(f"{servo.title}: {said}")
        except PortLost:
            raise
        except DriverError as error:
            failed[servo] = error
    unreached = {
        servo: why for servo, why in failed.items() if servo.id != needed or isinstance(why, WrongModel | NoReply)
    }
    for servo, why in unreached.items():
        say(f"{servo.title}: not yet restored after an earlier run{_file_of(servo)}. {why}")
    for servo, why in failed.items():
        if servo not in unreached:
            raise why
    return not failed.keys() & was_on.keys()


def not_restored(port: Port) -> str:
    """State which servos on this port have not been restored; the message of a command that ended while restoring."""
    left = "".join(f" {servo.title}{_file_of(servo)}." for servo in _on_file(port))
    return (
        f"Not restored after an earlier run, and perhaps with TORQUE ON:{left} Hold the arm or cut its power. The next "
        "hil check, record, identify or setup on this port restores them."
    )


def _on_file(port: Port) -> list[Servo]:
    """The servos for which there is a file for this port."""
    known = model_names().values()
    return [
        Servo(port, servo_id, load_control_table(model))
        for servo_id, model in settings_file.servos_on_file(port.url)
        if model in known and servo_id <= MAX_ID
    ]


def _file_of(servo: Servo) -> str:
    """The file with this servo's settings, in parentheses; "" if it is damaged, since the error then names it."""
    with suppress(DamagedSettings):
        if kept := settings_file.load(servo.port.url, servo.id, servo.table.model):
            return f" ({kept.path})"
    return ""


def _switched_off(servo: Servo) -> bool:
    """Switch off torque that a killed run left on; return whether it was on.

    Raises the errors of `recover`, NoReply, and WrongModel if the servo's model differs from the one on file.
    """
    if servo.ping() != servo.table.number:
        raise WrongModel(f"Another model answers at ID {servo.id}.")
    kept = settings_file.load(servo.port.url, servo.id, servo.table.model)
    return kept is not None and kept.may_restore and switch_off_left(servo, kept)


def _restored(done: Restored, is_cut: bool) -> str:
    """A message about what was restored; "" if there was nothing to restore."""
    found = ["its torque was still on and has been switched off"] if is_cut else []
    found += [f"restored: {', '.join(done.written)}"] if done.written else []
    told = f"an earlier run ended before it could restore this servo; {'; '.join(found)}." if found else ""
    return f"{told} {done.others[:1].upper()}{done.others[1:]}".strip()
