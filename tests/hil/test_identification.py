"""Complete identifications on the fake bus: both fake arms are recovered from their recordings.

The tolerances are what hil promises, not what it typically reaches; benchmarks/identify.py prints the latter.
"""

from typing import Any, NamedTuple

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.results.result import SettledResult
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from tests.support.paths import CONFIGS

INERTIAS = ("inertia_1", "coupling", "inertia_2", "armature_2")
GRAVITY = ("gravity_1", "gravity_2")
FRICTION = ("viscous_1", "viscous_2", "coulomb_1", "coulomb_2")


class Identified(NamedTuple):
    """A result, and the range of motion of each joint [degrees]."""

    result: SettledResult
    swing: list[float]


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Any:
    results: dict[str, Identified] = {}

    def identify(name: str) -> Identified:
        if name not in results:
            config = load_config(CONFIGS / f"{name}.toml")
            if name == "fake_two_link_ideal":  # no test looks at its prediction, which takes half of the run
                experiment = config.experiment.model_copy(update={"held_out": False})
                config = config.model_copy(update={"experiment": experiment})
            run = RunFolder.create(tmp_path_factory.mktemp("runs") / name, config)
            run_experiment(config, run, config.path, lambda _: None)
            positions = load_samples(run.samples_path, 2)["position"]
            results[name] = Identified(estimate_run(run), np.degrees(np.ptp(positions, axis=0)).tolist())
        return results[name]

    return identify


def worst(result: SettledResult, names: tuple[str, ...]) -> float:
    return max(abs(result.parameters[name].value / result.truth[name] - 1) for name in names)


def test_ideal_arm(identified: Any) -> None:
    result = identified("fake_two_link_ideal").result
    assert worst(result, INERTIAS + GRAVITY + FRICTION) <= 0.002
    for name in ("offset_1", "offset_2"):
        entry = result.parameters[name]
        assert abs(entry.value - result.truth[name]) <= 3 * entry.std
    assert max(result.fit.residual_rms_ticks) <= 0.295
    assert result.fit.periods == 1 and result.fit.samples_per_period == 4000


def test_realistic_arm(identified: Any) -> None:
    result, swing = identified("fake_two_link")
    assert min(swing) >= 100.0, "degrees"
    assert worst(result, GRAVITY) <= 0.01
    assert worst(result, INERTIAS) <= 0.05
    assert max(result.validation.held_out_rms) <= 0.01


def test_standard_errors_are_neither_boast_nor_excuse(identified: Any) -> None:
    result = identified("fake_two_link_ideal").result
    in_std = [abs(entry.value - result.truth[name]) / entry.std for name, entry in result.parameters.items()]
    assert 0.2 < float(np.sqrt(np.mean(np.square(in_std)))) < 3.0


def test_every_tick_was_kept(identified: Any) -> None:
    timing = identified("fake_two_link").result.timing
    assert timing.missed_ticks == 0 and timing.lost_replies == 0
    assert timing.rate_held == pytest.approx(400.0, rel=1e-6)
