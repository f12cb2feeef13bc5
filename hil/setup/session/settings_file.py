"""Files that store the servos' settings before a program changes them, and that outlive the program.

There is one file per servo in the user's state folder, named after port, ID and model. Even if a program is killed, the
next program on that port finds the file and restores the settings. If the adapter has a serial number, the file is
named after the adapter instead of the port, whose name may later belong to another arm. Otherwise, the file is also
found if the port goes by another name: that of a symbolic link or of the device itself.
"""

import json
import os
import re
import threading
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from hil.description.regular_file import not_a_file
from hil.drivers.adapter.device import adapter_name
from hil.drivers.errors import WrongSetting
from hil.errors import not_written

SCHEMA = 1
COPY_NAME = "servo_settings.json"
"""Name of the copy of the saved settings in the run folder."""

_LONGEST_NAME = 80
_FILE_NAME = re.compile(r".*_ID(\d+)_(.+)\.json", re.ASCII)


class DamagedSettings(WrongSetting):
    """The file with a servo's saved settings is damaged, for example because the disk failed after a run was killed."""


@dataclass(frozen=True)
class Kept:
    """Saved settings of one servo.

    changed: the EEPROM registers that the program sets, with their values. program: the program's process ID. adapter:
    persistent name of the USB adapter; "" if it has none. device: the device behind the port's name; "" if it has none.
    config: absolute path of the program's configuration; "" if unknown, as in files of earlier versions. was_held:
    whether another program's torque was on when the settings were saved, because the arm was being taken over.
    """

    port: str
    id: int
    model: str
    settings: dict[str, int]
    changed: dict[str, int]
    program: int
    since: str
    adapter: str = ""
    device: str = ""
    config: str = ""
    was_held: bool = False

    @property
    def path(self) -> Path:
        return _path(self.adapter or self.port, self.id, self.model)

    @property
    def may_restore(self) -> bool:
        """Whether this process may restore the settings: the program that saved them has ended, or is this process."""
        if self.program == os.getpid():
            return True
        try:
            os.kill(self.program, 0)
        except ProcessLookupError:
            return True
        except OSError:
            return False
        # A real port is opened exclusively, so that program no longer uses it although it is still running.
        return "://" not in self.port


def state_folder() -> Path:
    """Folder for persistent state of this user's programs (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    base = Path(given) if given and Path(given).is_absolute() else Path.home() / ".local" / "state"
    return base / "hil" / "servos"


def settings_path(port: str, servo_id: int, model: str) -> Path:
    """Path of the file of one servo."""
    return _path(adapter_name(port) or port, servo_id, model)


def _path(port: str, servo_id: int, model: str) -> Path:
    name = re.sub(r"[^A-Za-z0-9]+", "-", port).strip("-")[-_LONGEST_NAME:]
    return state_folder() / f"{name}_ID{servo_id}_{model}.json"


def _device(port: str) -> str:
    return "" if "://" in port else os.path.realpath(port)


def keep(
    port: str,
    servo_id: int,
    model: str,
    settings: dict[str, int],
    changed: dict[str, int],
    since: str = "",
    config: str = "",
    *,
    was_held: bool = False,
) -> Kept:
    """Write the file of a servo; it is on disk when this function returns. Raises RunFolderError.

    If a file of the same servo exists under another name of the port, it is removed afterwards.

    since: when these settings were first saved; by default, now. config: absolute path of the configuration. was_held:
    see `Kept`.
    """
    since = since or datetime.now().astimezone().isoformat(timespec="seconds")
    adapter, device = adapter_name(port), _device(port)
    kept = Kept(port, servo_id, model, settings, changed, os.getpid(), since, adapter, device, config, was_held)
    former = load(port, servo_id, model)
    write_durably(kept.path, {"schema": SCHEMA, **asdict(kept)})
    if former is not None and former.path != kept.path:
        forget(former)
    return kept


def load(port: str, servo_id: int, model: str) -> Kept | None:
    """The settings that an earlier program left for this servo; None if there are none.

    Raises DamagedSettings if this servo's file exists but holds no valid settings.
    """
    own = settings_path(port, servo_id, model)
    device = _device(port)
    contents = _contents(own)
    kept = None if contents is None else _parsed(contents)
    if contents is not None and kept is None:
        raise DamagedSettings(
            f"{own} is damaged or cannot be read. It held the settings of the {model} with ID {servo_id} from before a "
            "run that ended without restoring them, so its Operating Mode, limits and goals may still be that run's. "
            f"Restore them with DYNAMIXEL Wizard 2.0 ({COPY_NAME} in that run's folder is a copy), then remove this "
            "file."
        )
    if kept is not None or not device or adapter_name(port):
        return kept
    others = map(_contents, sorted(state_folder().glob(f"*_ID{servo_id}_{model}.json")))
    found = (_parsed(each) for each in others if each is not None)
    return next((each for each in found if each is not None and each.device == device and not each.adapter), None)


def servos_on_file(port: str) -> list[tuple[int, str]]:
    """ID and model of each servo for which there is a file for this port, even a damaged one, ordered by ID."""
    named = (_FILE_NAME.fullmatch(each.name) for each in state_folder().glob("*.json"))
    return sorted(each for each in {(int(name[1]), name[2]) for name in named if name} if _has_file(port, *each))


def _has_file(port: str, servo_id: int, model: str) -> bool:
    try:
        return load(port, servo_id, model) is not None
    except DamagedSettings:
        return True


def _contents(path: Path) -> bytes | None:
    """Return the contents of a file: empty if it cannot be read, None if there is no such file."""
    if not_a_file(path):
        return b""
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError:
        return b""


def _parsed(contents: bytes) -> Kept | None:
    try:
        values = json.loads(contents)
        if values.pop("schema") != SCHEMA:
            return None
        kept = Kept(**values)
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    numbers = all(
        isinstance(table, dict) and all(type(value) is int for value in table.values())
        for table in (kept.settings, kept.changed)
    )
    others = type(kept.program) is int and type(kept.config) is str and type(kept.was_held) is bool
    return kept if numbers and others else None


def forget(kept: Kept) -> str:
    """Remove the file, because the servo's settings have been restored. Return why it could not be removed, or ""."""
    try:
        kept.path.unlink(missing_ok=True)
    except NotADirectoryError:
        pass
    except OSError as error:
        if not os.path.lexists(kept.path):  # on a read-only disk, even a missing file cannot be removed
            return ""
        return (
            f"{kept.path} cannot be removed: {error.strerror}. Its settings have been restored. Remove it, or the next "
            "run will restore them again."
        )
    return ""


def write_durably(path: Path, value: object) -> None:
    """Write a JSON file completely and flush it to disk. Raises RunFolderError.

    Another thread may be writing the same file, and another program may remove its folder.
    """
    try:
        try:
            _write(path, value)
        except FileNotFoundError:
            _write(path, value)
    except OSError as error:
        raise not_written(path, error) from error


def _write(path: Path, value: object) -> None:
    temporary = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}.partial")
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(value, file, indent=2)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
