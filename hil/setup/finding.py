"""The result of one of the checks of `hil check`."""

from dataclasses import dataclass
from enum import StrEnum


class Level(StrEnum):
    """Severity: OK, WARNING (the experiment can still start) or STOP (it cannot)."""

    OK = "ok"
    WARNING = "warning"
    STOP = "stop"


@dataclass(frozen=True)
class Finding:
    """Result of a check: where it was made, what was checked, what was found, and how to fix it if necessary.

    step: the command that fixes it, if it is not the same check again after the fix.
    """

    level: Level
    where: str
    what: str
    found: str
    fix: str = ""
    step: str = ""
