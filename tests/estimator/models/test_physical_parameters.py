"""Physical quantities from base parameters and other knowledge; torque constants from a known mass."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimator.calibration import CalibrationOptions, KnownMass, _TwoRuns, calibrate
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.models.physical_parameters import Known, Quantities, base_of, physical_quantities
from hil.estimator.simulation.arm import steps_per_sample
from hil.fakes.plants.arm import Arm, base_parameters

TRUE = {
    "length_1": 0.147,
    "mass_1": 0.18,
    "centre_1": 0.081,
    "link_inertia_1": 7.0e-4,
    "armature_1": 8.0e-8 * 353.5**2,
    "mass_elbow": 0.082,
    "mass_2": 0.2,
    "centre_2": 0.112,
    "link_inertia_2": 2.9e-4,
    "armature_2": 8.0e-8 * 353.5**2,
}


def quantities(arm: Arm, known: dict[str, Known], gravity: float = 9.81) -> Quantities:
    base = base_parameters(arm)
    size = np.array(list(base.values())[:6])
    return physical_quantities(base, np.diag((1e-4 * size) ** 2 + 1e-16), known, gravity, 2)


def test_two_derivations_of_one_arm_agree(ideal_arm: Arm) -> None:
    assert base_of(TRUE, 9.81, 2) == pytest.approx(list(base_parameters(ideal_arm).values())[:6])


def test_with_enough_known_everything_comes_out_with_errors(ideal_arm: Arm) -> None:
    exact = {name: Known(TRUE[name]) for name in ("mass_1", "mass_2", "mass_elbow", "armature_1")}
    found = quantities(ideal_arm, exact)
    assert found.groups == () and found.doubts == ()
    for name, true in TRUE.items():
        assert found.value[name] == pytest.approx(true, rel=1e-5)
    assert 0.0 < found.std["link_inertia_2"] < 1e-5
    rough = quantities(ideal_arm, exact | {"mass_2": Known(0.2, 0.01)})
    # centre_2 = moment / mass: a mass known to 5 % leaves it known to 5 %.
    assert rough.std["centre_2"] / rough.value["centre_2"] == pytest.approx(0.05, rel=0.05)


def test_what_cannot_be_told_apart_is_said(ideal_arm: Arm) -> None:
    found = quantities(ideal_arm, {"mass_2": Known(0.2), "mass_elbow": Known(0.082)})
    assert found.groups == (("mass_1", "centre_1", "link_inertia_1", "armature_1"),)
    assert found.value["length_1"] == pytest.approx(0.147, rel=1e-6)  # coupling over gravity_2
    assert found.value["centre_2"] == pytest.approx(0.112, rel=1e-6)
    nothing = quantities(ideal_arm, {})
    assert set(nothing.value) == {"length_1", "armature_2"}


def test_without_gravity_the_moments_are_lost(ideal_arm: Arm) -> None:
    flat = quantities(ideal_arm, {"length_1": Known(0.147), "mass_2": Known(0.2)}, gravity=0.0)
    assert flat.value["centre_2"] == pytest.approx(0.112, rel=1e-6)  # from coupling alone
    assert "mass_1" in flat.groups[0]


def test_contradictions_and_nonsense_are_named(ideal_arm: Arm) -> None:
    wrong = quantities(ideal_arm, {"length_1": Known(0.2)})
    assert any("contradict" in doubt for doubt in wrong.doubts)
    light = quantities(ideal_arm, {"mass_2": Known(0.1)})
    assert any("link_inertia_2" in doubt and "below zero" in doubt for doubt in light.doubts)
    with pytest.raises(ModelError, match="mass_3"):
        quantities(ideal_arm, {"mass_3": Known(1.0)})
    with pytest.raises(ModelError, match=r"known\.mass_1"):
        quantities(ideal_arm, {"mass_1": Known(-1.0)})


def heavier(arm: Arm, mass: float, distance: float) -> Arm:
    """Return the same arm with a point mass on its last link."""
    described: dict[str, Any] = arm.model_dump()
    link = dict(described["links"][-1])
    total = link["mass"] + mass
    centre = (link["mass"] * link["centre"] + mass * distance) / total
    link["inertia"] += link["mass"] * (link["centre"] - centre) ** 2 + mass * (distance - centre) ** 2
    link |= {"mass": total, "centre": centre}
    return Arm.model_validate(described | {"links": (*described["links"][:-1], link)})


def test_a_known_mass_gives_wrong_torque_constants_away(
    ideal_arm: Arm, ideal_period: SettledPeriod, recorded: Any, wave: Any
) -> None:
    supposed = np.array([[1.2], [0.85]])
    loaded = recorded(heavier(ideal_arm, 0.1, 0.16), wave(1, (0.8, 0.42)))
    runs = [replace(period, torque=period.torque * supposed) for period in (ideal_period, loaded)]
    first = identify(runs[0], Model(2))
    found = calibrate(runs[0], runs[1], first, KnownMass(0.1, 0.16, 0.0, 0.147), 9.81)
    assert found.factor * supposed[:, 0] == pytest.approx([1.0, 1.0], abs=0.001)
    assert np.all(found.factor_std < 0.001)
    truth = base_parameters(ideal_arm)
    for name, value in zip(found.names[:10], found.value, strict=False):
        assert value == pytest.approx(truth[name], rel=0.002)
    assert found.residual_steps.max() < 0.3


def test_a_pendulum_is_calibrated_too(pendulum: Arm, recorded: Any, wave: Any) -> None:
    runs = [recorded(arm, wave(4, (0.5,), 5.0)) for arm in (pendulum, heavier(pendulum, 0.05, 0.14))]
    runs = [replace(period, torque=1.2 * period.torque) for period in runs]
    found = calibrate(runs[0], runs[1], identify(runs[0], Model(1)), KnownMass(0.05, 0.14), 9.81)
    assert 1.2 * found.factor[0] == pytest.approx(1.0, abs=0.003)


def test_a_calibration_resolves_friction_in_the_run_with_the_longer_steps() -> None:
    rates = {rate: 1.0 / (rate * steps_per_sample(rate)) for rate in (200.0, 333.0, 500.0)}
    assert len(set(rates.values())) > 1  # or the order would not matter
    angle = 2.0 * np.pi * np.arange(1000) / 1000.0
    first: Any = SimpleNamespace(
        names=("inertia_1", "coulomb_1", "coulomb_width_1"),
        value=np.array([1e-4, 0.1, 0.01]),
        parameters={"inertia_1": 1e-4, "coulomb_1": 0.1, "coulomb_width_1": 0.01},
        position=np.sin(angle)[None],
    )
    runs = [SettledPeriod(rate, np.cos(angle)[None], np.sin(angle)[None], 0.0, np.array([1e-3])) for rate in rates]
    floors = [
        _TwoRuns((one, other), first, {}, CalibrationOptions()).coordinates.resolved[-1]
        for one, other in itertools.permutations(runs, 2)
    ]
    longest = max(rates.values())
    for floor, pair in zip(floors, itertools.permutations(rates.values(), 2), strict=True):
        assert floor == pytest.approx(max(floors) * max(pair) / longest)


def test_a_mass_that_is_none_is_refused() -> None:
    with pytest.raises(ModelError, match="must be positive"):
        KnownMass(0.0, 0.1).change(9.81, 1)
    with pytest.raises(ModelError, match="--length"):
        KnownMass(0.1, 0.1).change(9.81, 2)
    assert math.isclose(KnownMass(0.1, 0.2).change(10.0, 1)["gravity_1"], 0.2)
