"""What servos were set to before a program touched them, in files that outlive the program.

One file a servo, named after port, ID and model, in the user's state folder: whatever ends the program, the next one on
that port finds it there and puts the settings back.
"""

import json
import os
import re
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

from hil.errors import RunFolderError

SCHEMA = 1
_LONGEST_NAME = 80


@dataclass(frozen=True)
class Kept:
    """One servo's settings. changed: the EEPROM registers that the program sets, to what; program: its process ID."""

    port: str
    id: int
    model: str
    settings: dict[str, int]
    changed: dict[str, int]
    program: int
    since: str

    @property
    def path(self) -> Path:
        return settings_path(self.port, self.id, self.model)

    @property
    def is_ours_to_mend(self) -> bool:
        """Whether the program that wrote it is gone; or is this one."""
        if self.program == os.getpid():
            return True
        try:
            os.kill(self.program, 0)
        except ProcessLookupError:
            return True
        except OSError:
            return False
        # Whoever has a real port has it for himself, so a program that lives has given this one up.
        return "://" not in self.port


def state_folder() -> Path:
    """Where this user's programs keep what must outlive them (XDG base directories)."""
    given = os.environ.get("XDG_STATE_HOME", "")
    base = Path(given) if given and Path(given).is_absolute() else Path.home() / ".local" / "state"
    return base / "hil" / "servos"


def settings_path(port: str, servo_id: int, model: str) -> Path:
    """The file of one servo."""
    name = re.sub(r"[^A-Za-z0-9]+", "-", port).strip("-")[-_LONGEST_NAME:]
    return state_folder() / f"{name}_ID{servo_id}_{model}.json"


def keep(port: str, servo_id: int, model: str, settings: dict[str, int], changed: dict[str, int]) -> Kept:
    """Write the file of a servo, on the disk when this returns. Raises RunFolderError."""
    since = datetime.now().astimezone().isoformat(timespec="seconds")
    kept = Kept(port, servo_id, model, settings, changed, os.getpid(), since)
    write_durably(kept.path, {"schema": SCHEMA, **asdict(kept)})
    return kept


def load(port: str, servo_id: int, model: str) -> Kept | None:
    """What an earlier program left behind for this servo; None when there is nothing that can be read."""
    path = settings_path(port, servo_id, model)
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values.pop("schema") != SCHEMA:
            return None
        kept = Kept(**values)
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
    numbers = all(
        isinstance(table, dict) and all(type(value) is int for value in table.values())
        for table in (kept.settings, kept.changed)
    )
    return kept if numbers and type(kept.program) is int else None


def forget(kept: Kept) -> None:
    """Remove the file: the servo is as it was."""
    with suppress(OSError):
        kept.path.unlink(missing_ok=True)


def write_durably(path: Path, value: object) -> None:
    """Write a JSON file whole, and have it on the disk. Raises RunFolderError."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(value, file, indent=2)
            file.write("\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise RunFolderError(f"{path} cannot be written: {error.strerror}.") from error
