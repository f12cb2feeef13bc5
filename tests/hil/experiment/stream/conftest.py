"""A stream on a scripted bus, with checks that only note what they are given."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.experiment import stream as module
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Progress, Stream
from hil.plan.plan import Plan, Segment
from hil.runs.recording import Recorder
from tests.support.paths import CONFIGS
from tests.support.stream.scripted_bus import JOINTS, TAKES_S, Bus, Checks

Make = Callable[..., tuple[Stream, Bus, Checks]]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Return a function that makes a stream, its bus, and its guard."""
    monkeypatch.setattr(module, "Guard", Checks)
    monkeypatch.setattr(module, "ModelWatch", Checks)
    config = load_config(CONFIGS / "fake_two_link_ideal.toml")
    opened: list[Recorder] = []

    def made(
        rate: float = 20.0,
        turns: int = 1,
        takes: list[float] | None = None,
        watch: Callable[[Progress], None] = lambda _: None,
        arms: Any = None,
        **changes: Any,
    ) -> tuple[Stream, Bus, Checks]:
        bus = Bus(config, turns, takes or [TAKES_S])
        segment = Segment("identify", None, np.full((8, JOINTS), 0.1), 4)  # type: ignore[arg-type]
        plan = {
            **{"rate": rate, "segments": (segment,), "rest_samples": 4, "end_samples": 8, "brake_samples": 9},
            **{"max_settling_periods": 4, "periods": 3, "settle_within": 0.01, "drift_within": 0.05},
            **changes,
        }
        recorder = Recorder(tmp_path / "samples.npy", JOINTS, 500)
        opened.append(recorder)
        stream = Stream(bus, Plan(**plan), config, recorder, StopRequest(), watch, lambda _: None, arms)  # type: ignore[arg-type]
        guard: Any = stream._guard
        return stream, bus, guard

    yield made
    for recorder in opened:
        recorder.close()
