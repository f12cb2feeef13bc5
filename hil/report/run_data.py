"""Everything a report shows, read once from a run folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.arm_model import ArmModel
from hil.config.schema import Config
from hil.model_file import model_of, read_settled_result
from hil.plan.plan import HELD_OUT, IDENTIFY
from hil.results.result import SettledResult
from hil.runs.period_file import PlayedPeriod, load_periods
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder, RunRecord


@dataclass(frozen=True)
class RunData:
    """A finished run. events: (time on the port's clock [s], what happened)."""

    run: RunFolder
    config: Config
    record: RunRecord
    result: SettledResult
    model: ArmModel
    samples: NDArray[np.void]
    periods: dict[str, PlayedPeriod]
    events: tuple[tuple[float, str], ...]

    @classmethod
    def load(cls, path: Path) -> "RunData":
        """Read a run folder. Raises RunFolderError, ResultError and ConfigError, whose messages name the file."""
        result = read_settled_result(path)
        run = RunFolder.open(path)
        config = run.load_config()
        return cls(
            run,
            config,
            run.load_record(),
            result,
            model_of(result, path),
            load_samples(run.samples_path, len(config.joints)),
            load_periods(path),
            run.load_events(),
        )

    @property
    def names(self) -> list[str]:
        """The joints' names, from the base outwards."""
        return [joint.name for joint in self.config.joints]

    @property
    def fitted(self) -> PlayedPeriod | None:
        """The settled period to which the model was fitted."""
        return self.periods.get(IDENTIFY)

    @property
    def held_out(self) -> PlayedPeriod | None:
        """The settled period that was held out from the fit and only predicted."""
        return self.periods.get(HELD_OUT)
