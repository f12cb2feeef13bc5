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


def slipped(samples: np.ndarray, *by: float) -> np.ndarray:
    """The samples of an arm that came to rest elsewhere by these angles (joints,) [rad], from where it had rested."""
    changed = samples.copy()
    before = np.nanmedian(changed["position"][changed["phase"] == Phase.REST][-20:], axis=0)
    changed["position"][changed["phase"] == Phase.COMING_TO_REST] = before + by
    return changed


def test_a_joint_that_rests_elsewhere_is_named(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    config, samples, result = run
    assert rest_shift_warnings(config, samples, result) == []
    (said,) = rest_shift_warnings(config, slipped(samples, 0.0, 1.2), result)
    assert said.startswith(f"{config.joints[1].name} came to rest +1.") and "horn slipped" in said


def test_what_counts_is_the_change_of_gravity_on_each_joint(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    """A shoulder that friction holds away from rest turns the freely hanging elbow back by as much."""
    config, samples, result = run
    heavy = {**result.parameters, "gravity_1": Quantity(0.1, 0.01, "N m"), "gravity_2": Quantity(1.0, 0.01, "N m")}
    doubted = replace(result, parameters=heavy)
    assert rest_shift_warnings(config, slipped(samples, 0.5, -0.5), doubted) == []
    found = rest_shift_warnings(config, slipped(samples, 0.0, 0.3), doubted)
    assert [said.partition(" came to rest")[0] for said in found] == [config.joints[1].name]
    assert len(rest_shift_warnings(config, slipped(samples, 0.3, 0.11), doubted)) == 2, "both carry the second link"
    assert rest_shift_warnings(config, slipped(samples, 0.0, 0.12), doubted) == []


def test_an_arm_that_still_swings_has_not_come_to_rest(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    config, samples, result = run
    swings = slipped(samples, 0.0, 1.2)
    at = swings["phase"] == Phase.COMING_TO_REST
    swings["position"][at, 1] += 0.1 * np.sin(0.02 * np.arange(at.sum()))
    assert rest_shift_warnings(config, swings, result) == []


def test_nothing_is_said_where_it_means_nothing(run: tuple[Config, np.ndarray, SettledResult]) -> None:
    config, samples, result = run
    moved = slipped(samples, 0.0, 1.2)
    trusted = replace(result, verdict=replace(result.verdict, trust="yes"))
    light = {**result.parameters, "gravity_2": Quantity(0.01, 0.001, "N m")}
    flat = config.model_copy(update={"arm": config.arm.model_copy(update={"gravity": 0.0})})
    assert rest_shift_warnings(config, moved, trusted) == []
    assert rest_shift_warnings(config, moved, replace(result, parameters=light)) == []
    assert rest_shift_warnings(flat, moved, result) == []
    assert rest_shift_warnings(config, moved[moved["phase"] != Phase.REST], result) == []
