"""Show a running experiment in the Rerun viewer: curves for every joint, and the motion of planar arms.

    hil identify arm.toml --live rerun              # starts the viewer
    hil identify arm.toml --live rerun:watch.rrd    # writes a file, to be opened with `rerun watch.rrd`
    hil identify arm.toml --live rerun:rerun+http://localhost:9876/proxy

The viewer receives the same reports as the terminal.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from types import ModuleType
from typing import Any

from hil.api.progress import OnProgress, Progress
from hil.config.schema import Config, load_config
from hil.errors import MissingExtra, RunFolderError

_TIMELINE = "arm time"
_NAME = "rerun"
_FLUSH_S = 2.0


def wants_rerun(live: str) -> bool:
    """Whether `--live` names the Rerun viewer, with or without a destination."""
    return live == _NAME or live.startswith(f"{_NAME}:")


@contextmanager
def rerun_view(live: str, config_path: Path) -> Iterator[OnProgress]:
    """Yield the function to call with progress reports. Raises MissingExtra, ConfigError, RunFolderError."""
    try:
        import rerun
    except ImportError as error:
        raise MissingExtra("--live rerun needs the Rerun SDK: pip install 'hil[rerun]'.") from error
    config = load_config(config_path)
    recording = rerun.RecordingStream(f"hil {config_path.stem}")
    _open(recording, live.removeprefix(_NAME).removeprefix(":"))
    view = _View(rerun, recording, config)
    try:
        yield view.show
    finally:
        recording.flush(timeout_sec=_FLUSH_S)
        recording.disconnect()


def _open(recording: Any, place: str) -> None:
    """Send the recording to the file or URL `place`; if `place` is empty, start a viewer."""
    if "://" in place:
        recording.connect_grpc(place)
    elif place:
        if not Path(place).absolute().parent.is_dir():
            raise RunFolderError(f"--live rerun:{place}: the folder {Path(place).parent} does not exist.")
        recording.save(place)
    else:
        recording.spawn()


class _View:
    """Logs progress reports to a recording. The time axis continues from one run of a pilot to the next."""

    def __init__(self, rerun: ModuleType, recording: Any, config: Config) -> None:
        self._rerun, self._recording = rerun, recording
        self._config = config
        self._lengths = None if config.is_chain else config.arm.link_lengths
        self._before = 0.0
        self._latest = 0.0
        for joint in config.joints:
            low, high = joint.position_limit
            for name, value in (("lowest", low), ("highest", high)):
                recording.log([joint.name, "position [rad]", name], rerun.Scalars([value]), static=True)

    def show(self, report: Progress) -> None:
        rerun, recording, stream = self._rerun, self._recording, report.stream
        if report.message:
            recording.log("messages", rerun.TextLog(report.message))
        if stream is None:
            return
        seconds = stream.taken / self._config.experiment.rate
        if self._before + seconds < self._latest:
            self._before = self._latest
        self._latest = self._before + seconds
        recording.set_time(_TIMELINE, duration=self._latest)
        state = stream.state
        for index, joint in enumerate(self._config.joints):
            unit = joint.drive_mode.goal_unit
            values = {
                ("position [rad]", "measured"): state.position[index],
                ("velocity [rad/s]",): state.velocity[index],
                (f"drive [{unit}]", "goal"): state.goal_current[index],
                (f"drive [{unit}]", "measured"): state.current[index],
            }
            if state.slow is not None:
                values[("temperature [C]",)] = state.slow.temperature[index]
                values[("supply [V]",)] = state.slow.voltage[index]
            for place, value in values.items():
                if math.isfinite(value):
                    recording.log([joint.name, *place], rerun.Scalars([value]))
        if self._lengths is not None and all(map(math.isfinite, state.position)):
            recording.log("arm", rerun.LineStrips2D([_corners(self._lengths, state.position)]))


def _corners(lengths: list[float], angles: tuple[float, ...]) -> list[tuple[float, float]]:
    """Corners of a planar arm, from the base to the tip [m]. y is negated, because it points down in a 2D view."""
    corners = [(0.0, 0.0)]
    for length, angle in zip(lengths, accumulate(angles), strict=False):
        x, y = corners[-1]
        corners.append((x + length * math.cos(angle), y - length * math.sin(angle)))
    return corners
