"""A length of link 1 that no arm has reveals a wrong unit of time."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimation.plausibility import wrong_length
from hil.estimation.unsettled.plausibility import implausible


@pytest.mark.parametrize(("time", "named"), [(1.0, False), (10.0, True), (0.1, True)])
def test_a_length_that_no_arm_has_is_named(time: float, named: bool) -> None:
    value = {"inertia_1": 0.02, "gravity_1": 1.5, "coupling": 0.008 * time**2, "gravity_2": 0.4}
    values = np.array(list(value.values()))
    estimate: Any = SimpleNamespace(parameters=value, names=tuple(value), value=values, std=0.01 * values)
    found = implausible([SimpleNamespace(joints=0)], estimate, 9.81)  # type: ignore[list-item]
    assert any("link 1 would be" in said for said in found) is named


@pytest.mark.parametrize(
    ("length", "gravity", "named"), [(0.2, 9.81, False), (0.3, 9.81, True), (0.12, 9.81, True), (0.3, 0.0, False)]
)
def test_a_wrong_length_of_link_1_is_named(length: float, gravity: float, named: bool) -> None:
    value = {"coupling": 0.2 * 0.4 / 9.81, "gravity_2": 0.4}
    covariance = np.diag([8e-6**2, 4e-4**2])
    model = SimpleNamespace(joints=2)
    estimate: Any = SimpleNamespace(parameters=value, names=tuple(value), covariance=covariance, model=model)
    assert bool(wrong_length(length, gravity, estimate)) is named
    assert not wrong_length(None, gravity, estimate)


@pytest.mark.parametrize(("inertia", "named"), [(0.0142, False), (1.42e-4, True)])
def test_a_pendulum_of_a_few_millimetres_is_named(inertia: float, named: bool) -> None:
    """Times of 0.1 times the true ones make inertia a hundred times smaller."""
    value = {"inertia_1": inertia, "gravity_1": 0.46}
    values = np.array(list(value.values()))
    estimate: Any = SimpleNamespace(parameters=value, names=tuple(value), value=values, std=0.01 * values)
    found = implausible([SimpleNamespace(joints=0)], estimate, 9.81)  # type: ignore[list-item]
    assert any("pendulum 0.003 m long" in said for said in found) is named


@pytest.mark.parametrize(("gravity_2", "named"), [((0.001, 0.002), True), ((0.05, 0.02), False), ((0.4, 0.004), False)])
def test_a_torque_without_gravity_is_named(gravity_2: tuple[float, float], named: bool) -> None:
    """As of a drive that compensates for gravity; a weight that is merely uncertain casts no doubt."""
    value = {"inertia_1": 0.02, "gravity_1": 1.5, "coupling": 0.008, "gravity_2": gravity_2[0]}
    values = np.array(list(value.values()))
    std = np.array([2e-4, 0.015, 8e-5, gravity_2[1]])
    estimate: Any = SimpleNamespace(parameters=value, names=tuple(value), value=values, std=std)
    found = implausible([SimpleNamespace(joints=0)], estimate, 9.81)  # type: ignore[list-item]
    assert any("torque column does not include gravity" in said for said in found) is named


@pytest.mark.parametrize(
    ("weights", "zero"), [((-0.4, 0.1), "[-1.6708, 3.0916]"), ((0.4, -0.1), "[1.4708, 3.0916]"), ((0.4, 0.1), "")]
)
def test_the_zeros_that_make_the_weights_positive_are_named(weights: tuple[float, float], zero: str) -> None:
    """The verdict called every wrong zero "half a turn off", even one that was off by a quarter."""
    value = {"gravity_1": weights[0], "gravity_2": weights[1], "inertia_1": 0.02}
    values = np.array(list(value.values()))
    zeros = np.array([[-0.1, -0.25]])
    estimate: Any = SimpleNamespace(
        parameters=value, names=tuple(value), value=values, std=np.full(3, 1e-3), zeros=zeros
    )
    found = implausible([SimpleNamespace(joints=0)], estimate, 9.81, (np.pi / 2, 0.2))  # type: ignore[list-item]
    said = " ".join(found)
    assert ("the zero of an angle is wrong" in said) is bool(zero)
    assert f"set zero = {zero} in [columns]" in said or not zero
