"""period.npz: each multisine's settled period as measured and as predicted, for figures and other tools.

Arrays are named ROLE_torque, ROLE_position, ROLE_predicted, ROLE_rate. ROLE is "identify" for the fitted multisine, and
"held_out" for the one predicted from the state one period earlier, or from rest.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from hil.errors import RunFolderError, not_written
from hil.estimator.arrays import Array
from hil.estimator.data.relative_error import relative_error
from hil.runs.file_size import check_archive

FILE_NAME = "period.npz"
_ARRAYS = ("torque", "position", "predicted")


@dataclass(frozen=True)
class PlayedPeriod:
    """One settled period.

    rate: samples per second. torque: commanded motor torque (joints, samples) [N m]. position: measured joint angles
    (joints, samples) [rad], NaN where a reply is missing. predicted: joint angles of the model (joints, samples) [rad].
    """

    rate: float
    torque: Array
    position: Array
    predicted: Array

    @property
    def error(self) -> Array:
        """Measured minus predicted position (joints, samples) [rad]."""
        return np.asarray(self.position - self.predicted)

    @property
    def relative_error(self) -> Array:
        """RMS prediction error, encoder noise included, relative to the RMS of the motion about its mean (joints,)."""
        return relative_error(self.position, self.predicted)

    def error_beyond(self, noise: Array) -> Array:
        """Like `relative_error`, but excluding the encoders' `noise` (joints,) [rad], which no model can predict."""
        return relative_error(self.position, self.predicted, noise)


def save_periods(run: Path, periods: Mapping[str, PlayedPeriod]) -> None:
    """Write period.npz into a run folder. Raises RunFolderError."""
    arrays = {f"{role}_{name}": getattr(period, name) for role, period in periods.items() for name in _ARRAYS}
    rates = {f"{role}_rate": np.array(period.rate) for role, period in periods.items()}
    path = run / FILE_NAME
    temporary = run / "period.partial.npz"
    try:
        np.savez(temporary, allow_pickle=False, **arrays, **rates)
        temporary.replace(path)
    except OSError as error:
        raise not_written(path, error) from error


def load_periods(run: Path) -> dict[str, PlayedPeriod]:
    """The settled periods of a run by role; empty if there is no period.npz. Raises RunFolderError."""
    path = run / FILE_NAME
    if not path.is_file():
        return {}
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as file:
            roles = [name.removesuffix("_rate") for name in file.files if name.endswith("_rate")]
            return {
                role: PlayedPeriod(float(file[f"{role}_rate"]), *(file[f"{role}_{name}"] for name in _ARRAYS))
                for role in roles
            }
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise RunFolderError(f"{path} cannot be read: {error}. Recreate it with hil estimate {run}.") from error
