"""Changes between two runs: real ones are found, and there are no false alarms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hil.arm_model import ArmModel, JointFacts
from hil.errors import ResultError
from hil.estimation.changes.diff import diff_models, diff_runs
from hil.estimation.changes.friction_change import REPEATABILITY, friction_changes
from hil.results.parts import Covariance

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


def test_joints_with_other_servos_may_be_another_arm() -> None:
    other = replace(MODEL, joints=(FACTS, replace(FACTS, servo="XM540-W270")))
    (said,) = diff_models(MODEL, other).doubts
    assert said.startswith("Joint 2 was 'shoulder' with an XM430-W350 and is 'shoulder' with an XM540-W270")
    assert not diff_models(MODEL, MODEL).doubts


def test_arms_of_other_joint_count_are_refused(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    one = replace(MODEL, joints=(FACTS,))
    monkeypatch.setattr("hil.estimation.changes.diff.read_model", lambda path: one if "one" in str(path) else MODEL)
    with pytest.raises(ResultError, match="one has 1 joints and two has 2"):
        diff_runs("one", "two")  # type: ignore[arg-type]


def friction_of(level: float, rise: float, velocity: float, speed: np.ndarray) -> np.ndarray:
    return np.asarray(level * (1.0 + rise * np.exp(-((speed / velocity) ** 2))))


def confounded() -> np.ndarray:
    """Covariance of Coulomb level, rise and its velocity, all observed at speeds within the rise."""
    at = np.array([0.055, 0.4, 0.3])
    speed = np.linspace(0.02, 0.25, 40)
    steps = 1e-6 * at
    slopes = [
        (friction_of(*(at + step * one), speed) - friction_of(*at, speed)) / step
        for step, one in zip(steps, np.eye(3), strict=True)
    ]
    return np.asarray(np.linalg.inv(np.array(slopes) @ np.array(slopes).T) * 2.5e-4**2)


def curves(rng: np.random.Generator, factor: float, kept: Covariance, spread: float = 0.0) -> tuple[ArmModel, ArmModel]:
    """Two identifications of one joint's friction, whose rise is `factor` times as large in the second.

    spread: how much friction differs from run to run, relative to its value.
    """
    root = np.linalg.cholesky(kept.array())
    stds = {
        **dict.fromkeys(VALUES, 1e-6),
        **dict(zip(kept.names, np.sqrt(np.diag(kept.array())).tolist(), strict=True)),
    }
    found = []
    for rise in (0.4, 0.4 * factor):
        values = np.array([0.055, rise, 0.3]) * (1.0 + spread * rng.standard_normal(3)) + root @ rng.standard_normal(3)
        own = dict(zip(kept.names, values.tolist(), strict=True))
        found.append(replace(MODEL, values={**VALUES, **own}, stds=stds))
    return found[0], found[1]


def test_a_rise_that_no_parameter_shows_alone_is_found_with_the_others() -> None:
    names = ("coulomb_1", "stribeck_rise_1", "stribeck_velocity_1")
    covariance = confounded()
    assert math.sqrt(covariance[1, 1]) > 0.03, "a rise of 10 % is barely one standard error"
    kept = Covariance(names, tuple(map(tuple, covariance.tolist())))
    rng = np.random.default_rng(3)

    def changed(factor: float, spread: float = 0.0) -> set[str]:
        pair = curves(rng, factor, kept, spread)
        return {change.name for change in diff_models(*pair, friction=friction_changes(pair, (kept, kept))).changed}

    rises = [changed(1.1) for _ in range(200)]
    assert sum(any(name.startswith("friction_1") for name in found) for found in rises) >= 190
    assert sum("friction_1: stribeck_rise_1" in found for found in rises) >= 180, "and the right term is named"
    assert sum(bool(found & set(names)) for found in rises) <= 40
    assert sum(bool(changed(1.0, REPEATABILITY)) for _ in range(200)) <= 10 + 9, "5 % and three standard deviations"


def test_what_two_runs_would_show_is_said() -> None:
    names = ("coulomb_1", "stribeck_rise_1", "stribeck_velocity_1")
    kept = Covariance(names, tuple(map(tuple, confounded().tolist())))
    rng = np.random.default_rng(4)
    pair = curves(rng, 1.0, kept)
    least = diff_models(*pair, friction=friction_changes(pair, (kept, kept))).detectable
    assert set(least) == set(names)
    factor = 1 + least["stribeck_rise_1"] / 100
    found = 0
    for _ in range(400):
        pair = curves(rng, factor, kept)
        found += any(row.p < 0.05 / 13 for row in friction_changes(pair, (kept, kept)))
    assert 0.91 * 400 <= found <= 400


def test_a_term_that_one_model_lacks_is_a_zero() -> None:
    kept = Covariance(("viscous_1", "load_1"), ((1e-8, 0.0), (0.0, 1e-6)))
    without = Covariance(("viscous_1",), ((1e-8,),))
    richer = replace(MODEL, values={**VALUES, "load_1": 0.05}, stds={**MODEL.stds, "load_1": 0.001})
    (found,) = friction_changes((MODEL, richer), (without, kept))[:1]
    assert found.term == "load_1" and found.before == 0.0
    assert found.after == pytest.approx(0.05) and found.p < 1e-6


def test_without_covariances_nothing_is_said_of_friction() -> None:
    assert friction_changes((MODEL, MODEL), (None, None)) == []
