"""A horn that slipped smoothly shows in where the arm comes to rest, unless friction may hold it there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config
from hil.estimation.slips.rest_shift import rest_shift_warnings
from hil.model_file import read_settled_result
from hil.results.parts import Quantity
from hil.results.result import SettledResult
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder


@pytest.fixture
def run(identified: Path) -> tuple[Config, np.ndarray, SettledResult]:
    result = read_settled_result(identified)
    doubted = replace(result, verdict=replace(result.verdict, trust="no"))
    return RunFolder.open(identified).load_config(), load_samples(identified / "samples.npy", 2), doubted


def slipped(samples: np.ndarray, by: float) -> np.ndarray:
    changed = samples.copy()
    changed["position"][changed["phase"] == Phase.COMING_TO_REST, 1] += by
    return changed


def test_a_joint_that_rests_elsewhere_is_named(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    config, samples, result = run
    assert rest_shift_warnings(config, samples, result) == []
    (said,) = rest_shift_warnings(config, slipped(samples, 1.2), result)
    assert said.startswith(f"{config.joints[1].name}: it came to rest +1.") and "horn slipped" in said


def test_nothing_is_said_where_it_means_nothing(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    config, samples, result = run
    moved = slipped(samples, 1.2)
    trusted = replace(result, verdict=replace(result.verdict, trust="yes"))
    light = {**result.parameters, "gravity_2": Quantity(0.01, 0.001, "N m")}
    flat = config.model_copy(update={"arm": config.arm.model_copy(update={"gravity": 0.0})})
    assert rest_shift_warnings(config, moved, trusted) == []
    assert rest_shift_warnings(config, moved, replace(result, parameters=light)) == []
    assert rest_shift_warnings(flat, moved, result) == []
    assert rest_shift_warnings(config, moved[moved["phase"] != Phase.REST], result) == []
