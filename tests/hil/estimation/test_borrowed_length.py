"""The length of link 1 as prior knowledge: it helps if it is right, and does little harm if it is wrong."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimation.plausibility import borrowed_length
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from tests.support import recorded_arm

LENGTH, GRAVITY = 0.147, 9.81
COUPLING = 0.200 * 0.112 * LENGTH  # kg m^2, of `recorded_arm.LINKS`


@cache
def estimate(length: float | None, peak: tuple[float, float] = (0.2, 0.1)) -> Estimate:
    period = recorded_arm.record(recorded_arm.servo_arm({}), recorded_arm.wave(1, peak)).rounded()
    return identify(period, Model(joints=2, friction="coulomb", lever=None if length is None else length / GRAVITY))


def coupling(found: Estimate) -> tuple[float, float]:
    index = found.names.index("coupling")
    return float(found.value[index]), float(found.std[index])


def said(found: Estimate, length: float) -> str:
    config: Any = SimpleNamespace(arm=SimpleNamespace(gravity=GRAVITY, link_lengths=[length, 0.18]))
    return " ".join(borrowed_length(config, found))


def test_the_right_length_makes_the_coupling_of_a_small_motion_more_accurate() -> None:
    value, std = coupling(estimate(LENGTH))
    assert std < 0.6 * coupling(estimate(None))[1]
    assert abs(value - COUPLING) < 2.0 * std


SLOW = pytest.mark.slow  # each fit takes 20 s of processor time


@pytest.mark.parametrize("ratio", [0.6, pytest.param(0.75, marks=SLOW), pytest.param(1.3, marks=SLOW), 1.5])
def test_a_wrong_length_is_doubted_rather_than_believed(ratio: float) -> None:
    found = estimate(ratio * LENGTH)
    value, std = coupling(found)
    assert abs(value - COUPLING) < 2.0 * std
    assert std > 0.9 * coupling(estimate(None))[1]


def test_the_verdict_says_what_the_coupling_rests_on() -> None:
    assert said(estimate(LENGTH, (0.3, 0.16)), LENGTH) == ""
    faint = said(estimate(LENGTH, (0.16, 0.08)), LENGTH)
    assert "rests on arm.link_lengths[0] = 0.147 m, assumed to be right to within 5 %" in faint
    assert "may contradict arm.link_lengths[0] = 0.2205 m" in said(estimate(1.5 * LENGTH, (0.17, 0.085)), 1.5 * LENGTH)


def test_nothing_is_said_of_a_length_without_standard_error() -> None:
    found = estimate(LENGTH, (0.16, 0.08))
    assert said(replace(found, covariance=np.diag(np.full(len(found.names), np.inf))), LENGTH) == ""
