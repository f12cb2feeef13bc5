"""All exceptions of hil, as a tree, with their exit codes.

HilError                    exit code
├── ConfigError             2
├── CsvError                2
├── MissingExtra            2
├── RunFolderError          2   1 once samples exist
├── ResultError             2
├── ExportError             2
├── SchedulerLost           1
└── ExperimentError         1
    ├── SafetyStop          1
    ├── StopRequested     130   143: SIGTERM, 129: SIGHUP
    ├── NotSettled          1
    ├── DidNotMove          1
    ├── NoSafeTorque        1
    └── RecordingCutShort   1

hil.drivers.errors.DriverError  1   communication with the servos
                                NoControlTables, UnknownModel, PortNotOpened, WrongModel and WrongSetting
                                exit with 2, but with 1 once torque has been switched on
hil.estimator.errors.EstimationError  1   the recording does not determine the parameters
"""

import errno
import re
import signal
from enum import Enum
from pathlib import Path

__all__ = [
    "Cause",
    "ConfigError",
    "CsvError",
    "DidNotMove",
    "ExperimentError",
    "ExportError",
    "HilError",
    "MissingExtra",
    "NoSafeTorque",
    "NotSettled",
    "RecordingCutShort",
    "ResultError",
    "RunFolderError",
    "SafetyStop",
    "SchedulerLost",
    "StopRequested",
    "Unheard",
    "symptom_of",
]


class Cause(Enum):
    """What the guard detected. It determines whether the arm can be braked or lowered before its torque is cut."""

    POSITION = "position limit"
    VELOCITY = "velocity limit"
    NOT_A_NUMBER = "not a number"
    ALERT = "alert"
    MISSING = "missing replies"
    ERRORS = "errors in replies"
    LATE = "missed deadlines"
    JUMP = "encoder jump"
    NOT_FOLLOWING = "current does not follow"
    OUT_OF_VOLTAGE = "supply too low for this speed"
    GOALS_CHANGED = "goals altered in transit"
    TORQUE_OFF = "torque lost"
    WATCHDOG = "servo's watchdog"
    GOALS_LOST = "goals not accepted"
    STALE = "old replies"
    FROZEN = "position and velocity disagree"
    UNEXPECTED = "motion unlike the model"
    UNLIKE_BEFORE = "motion unlike the period before"
    APART = "servos of one joint disagree"
    WRONG_SIGN = "wrong sign of response"
    EARLY_MOTION = "motion before the start"
    TEMPERATURE = "temperature"
    VOLTAGE = "supply voltage"

    @property
    def allows_braking(self) -> bool:
        """Whether the measured velocity and the commanded current can still be trusted."""
        limits = {Cause.POSITION, Cause.VELOCITY, Cause.TEMPERATURE, Cause.VOLTAGE}
        # A joint with weakened goals carries less current than commanded, but in the commanded direction.
        return self in limits or self in {Cause.OUT_OF_VOLTAGE, Cause.GOALS_CHANGED}

    @property
    def allows_lowering(self) -> bool:
        """Whether the servos still accept commands, so that an arm can be lowered under supervision.

        A servo whose watchdog was disabled still obeys commands. If the watchdog has tripped instead, the loss of
        torque is detected during lowering. A servo that has set its alert bit may still have torque; its torque state
        is read first.
        """
        others = {Cause.UNEXPECTED, Cause.UNLIKE_BEFORE, Cause.LATE, Cause.NOT_A_NUMBER, Cause.WATCHDOG}
        others |= {Cause.MISSING, Cause.ALERT}
        return self.allows_braking or self in others


class Unheard(Enum):
    """Which servos' replies are missing."""

    ONE = "one servo of several"
    ALL = "every servo"


class HilError(Exception):
    """Base class of hil's own errors.

    last_samples: the last recorded rows (see hil.runs.recording) if an experiment was running.
    """

    exit_code = 1
    last_samples: object = None


class ConfigError(HilError):
    """The configuration is wrong. Example: `rate = "fast"`, or a peak torque above what the current limit allows."""

    exit_code = 2


class RunFolderError(HilError):
    """The run folder cannot be used. Example: `--out` names a folder that holds another run."""

    exit_code = 2


_NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})


def not_written(path: Path, error: OSError, what: str = "") -> RunFolderError:
    """Return the error to raise if a file or folder cannot be written, with advice if there is no space for it.

    what: what to call it at the beginning of the message, such as "Run folder".
    """
    advice = " Free some space (or raise the limit on file sizes), or choose another disk."
    said = f"{what} {path}".strip()
    return RunFolderError(
        f"{said} cannot be written: {error.strerror or error}.{advice if error.errno in _NO_SPACE else ''}"
    )


class SchedulerLost(HilError):
    """The scheduler of a study no longer responds, perhaps because its machine was switched off. Use --resume."""


class CsvError(HilError):
    """A CSV file cannot be read as a recording. Example: [columns] names a column "q1" that does not exist."""

    exit_code = 2


class MissingExtra(HilError):
    """An optional package is not installed. Example: `hil compare --mujoco` without the `peers` extra."""

    exit_code = 2


class ResultError(HilError):
    """There is no result to work with. Example: `hil report` for a run that was stopped before its estimate."""

    exit_code = 2


class ExportError(HilError):
    """The requested format cannot hold the model. Example: no link of positive mass could have these parameters."""

    exit_code = 2


class ExperimentError(HilError):
    """The experiment could not be finished. The recording so far is on disk."""


class SafetyStop(ExperimentError):
    """The guard stopped the arm, or a dry run found that it must not start. Example: joint 2 exceeded its position
    limit.

    overruled: a servo held goals or settings that this program had not written, so the motion was not caused by the
    commanded torque and reveals nothing about the arm. unheard: which servos' replies were missing; None if other
    packets arrived instead, or for any other cause. doubts_description: the motion contradicts the description of a
    spatial arm. remedy: the last sentences of the message; they may be replaced once more is known.
    """

    overruled = False
    doubts_description = False
    unheard: Unheard | None = None

    def __init__(self, message: str, cause: Cause, remedy: str = "") -> None:
        super().__init__(f"{message} {remedy}".rstrip())
        self.cause = cause
        self._remedy = remedy

    def replace_remedy(self, remedy: str) -> None:
        """Replace the remedy at the end of the message; if there is none, append this one."""
        self.args = (str(self).replace(self._remedy, remedy) if self._remedy else f"{self} {remedy}",)
        self._remedy = remedy


class StopRequested(ExperimentError):
    """A stop was requested by a signal. Example: Ctrl-C."""

    def __init__(self, *said: object, number: int = signal.SIGINT) -> None:
        super().__init__(*said)
        self.exit_code = 128 + number


class NoSafeTorque(ExperimentError):
    """A dry run found no torque that is safe for all plausible arms. Example: a prior with a spread of 100 %."""


class NotSettled(ExperimentError):
    """The motion never became periodic. Example: a slipping joint, or a dragging cable."""


class DidNotMove(ExperimentError):
    """A joint stood still for a whole period. Example: torque below static friction, or a jammed gear.

    joint: index of that joint, if known.
    """

    joint: int | None = None


class RecordingCutShort(ExperimentError):
    """The recording ends before a settled period. Example: the process was killed during settling."""


def symptom_of(error: Exception) -> str:
    """Return what happened, without the possible causes and the advice that follow it in the message."""
    return re.split(r"[.:] ", str(error), maxsplit=1)[0].rstrip(".")
