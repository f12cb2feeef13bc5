"""Changes between two runs: real ones are found, and there are no false alarms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hil.arm_model import ArmModel, JointFacts
from hil.errors import ResultError
from hil.estimation.diff import diff_models, diff_runs

FACTS = JointFacts("shoulder", "XM430-W350", "current", 1.8, 0.1, 1.2, (-3.0, 0.5), 10.0)
VALUES = {
    **{"inertia_1": 0.018, "coupling": 0.0033, "inertia_2": 0.0028, "armature_2": 0.01},
    **{"gravity_1": 0.55, "gravity_2": 0.22, "viscous_1": 0.045, "viscous_2": 0.04},
    **{"coulomb_1": 0.055, "coulomb_2": 0.05, "offset_1": 0.004, "offset_2": -0.003},
}
MODEL = ArmModel(VALUES, {name: abs(value) * 0.01 for name, value in VALUES.items()}, 9.81, (-1.57, 0.0), (FACTS,) * 2)


def drawn(rng: np.random.Generator, changed: str | None = None) -> ArmModel:
    """One identification of the arm, with noise according to its standard errors."""
    truth = {name: value * (1.1 if name == changed else 1.0) for name, value in MODEL.values.items()}
    values = {name: value + MODEL.stds[name] * rng.standard_normal() for name, value in truth.items()}
    return replace(MODEL, values=values)


def test_false_alarms_are_as_rare_as_promised() -> None:
    rng = np.random.default_rng(1)
    alarms = sum(bool(diff_models(drawn(rng), drawn(rng)).changed) for _ in range(2000))
    assert alarms <= 0.05 * 2000 + 3 * math.sqrt(0.05 * 0.95 * 2000)


def test_a_change_of_ten_percent_is_found() -> None:
    rng = np.random.default_rng(2)
    found = [diff_models(drawn(rng), drawn(rng, "coulomb_1")).changed for _ in range(500)]
    assert sum("coulomb_1" in {change.name for change in changed} for changed in found) >= 0.95 * 500


def test_a_change_too_small_to_matter_is_not_called_one() -> None:
    exact = replace(MODEL, stds=dict.fromkeys(VALUES, 1e-12))
    almost = replace(exact, values={name: value * 1.005 for name, value in VALUES.items()})
    assert not diff_models(exact, almost).changed
    assert {change.name for change in diff_models(exact, almost, least_share=0.004).changed} == {
        name for name in VALUES if not name.startswith("offset")
    }


def test_what_nothing_is_known_of_has_not_changed() -> None:
    unknown = replace(MODEL, stds={**MODEL.stds, "viscous_1": math.inf})
    other = replace(unknown, values={**VALUES, "viscous_1": 1.0})
    assert not diff_models(unknown, other).changed


def test_terms_of_one_model_alone_are_named() -> None:
    richer = replace(MODEL, values={**VALUES, "load_1": 0.05}, stds={**MODEL.stds, "load_1": 0.001})
    assert diff_models(MODEL, richer).only_after == ("load_1",)
    assert diff_models(richer, MODEL).only_before == ("load_1",)


def test_arms_of_other_joint_count_are_refused(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    one = replace(MODEL, joints=(FACTS,))
    monkeypatch.setattr("hil.estimation.diff.read_model", lambda path: one if "one" in str(path) else MODEL)
    with pytest.raises(ResultError, match="one has 1 joints and two 2"):
        diff_runs("one", "two")  # type: ignore[arg-type]
