"""How long a joint that stands still under changing torques takes to be called blocked, and when it must not be."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from hil.estimator.models import standstill
from hil.estimator.models.standstill import HOLD_S, WITHIN_RAD

INTERVAL = 1e-3
FILTER_S = 0.02
FRICTION, TOLERANCE, MOMENTUM = 0.1, 0.02, 3e-4
NOBODY_KNOWS = np.array([5.0, -3.0])
"""Estimates of gravity and offset, which are far from the truth."""


@dataclass
class Joint:
    """One joint at rest; its equation has a gravity term and an offset."""

    momentum: float = MOMENTUM
    held: float = 0.0
    rest: Any = field(default_factory=lambda: standstill.memory(1, 2)[0])

    def alarm(self, torques: Iterable[float], angle: float = 0.3, stands: float = 1.0) -> float:
        """Time from the first of these torques [N m] until the joint is called blocked [s]; or inf."""
        for k, torque in enumerate(torques):
            row = np.array([np.cos(angle), 1.0])
            distance = standstill.look(self.rest, angle, stands, torque, row, NOBODY_KNOWS)
            if standstill.blocked(
                self.rest, distance, self.held, FRICTION, TOLERANCE, self.momentum, FILTER_S, INTERVAL
            ):
                return k * INTERVAL
        return np.inf


def for_s(torque: float, seconds: float) -> np.ndarray:
    return np.full(round(seconds / INTERVAL), torque)


@pytest.mark.parametrize("mean", [-2.0, 0.0, 0.7])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_torques_that_friction_cannot_hold_to_both_sides_are_an_alarm_whatever_gravity_is(
    mean: float, sign: float
) -> None:
    joint = Joint()
    assert joint.alarm(mean + sign * for_s(0.2, 0.5)) == np.inf
    assert joint.alarm(mean - sign * for_s(0.2, 0.5)) == pytest.approx(HOLD_S, abs=1.1 * INTERVAL)


@pytest.mark.parametrize("mean", [-2.0, 0.0, 0.7])
def test_torques_that_friction_can_hold_are_none(mean: float) -> None:
    joint = Joint()
    for _ in range(10):
        assert joint.alarm(mean + for_s(0.5 * TOLERANCE + 0.99 * FRICTION, 0.3)) == np.inf
        assert joint.alarm(mean - for_s(0.5 * TOLERANCE + 0.99 * FRICTION, 0.3)) == np.inf


def test_a_heavy_joint_takes_longer_to_show_that_it_is_not_blocked() -> None:
    beyond = 0.4 - 2 * FRICTION - TOLERANCE
    joint = Joint(momentum=0.1 * beyond)
    assert joint.alarm(for_s(0.2, 0.5)) == np.inf
    assert joint.alarm(for_s(-0.2, 0.5)) == pytest.approx(0.2, abs=1.1 * INTERVAL)


def test_short_peaks_that_give_no_visible_velocity_are_none() -> None:
    joint = Joint(momentum=0.01)
    assert joint.alarm(for_s(0.0, 0.1)) == np.inf
    for _ in range(20):
        assert joint.alarm(for_s(0.4, 0.04)) == np.inf
        assert joint.alarm(for_s(0.0, 0.04)) == np.inf
    assert joint.alarm(for_s(0.4, 0.2)) < 0.2


@pytest.mark.parametrize(
    ("angle", "stands", "new"),
    [(0.3, 1.0, False), (0.3 + 0.9 * WITHIN_RAD, 1.0, False), (0.3045, 1.0, True), (0.3, 0.9, True)],
)
def test_a_joint_that_moves_starts_a_new_band(angle: float, stands: float, new: bool) -> None:
    joint = Joint()
    joint.alarm(for_s(0.2, 0.2))
    joint.alarm(for_s(0.0, 0.01), angle, stands)
    assert (joint.alarm(for_s(-0.2, 0.01 + HOLD_S), angle) == np.inf) is new


def test_a_gap_starts_a_new_band() -> None:
    joint = Joint()
    joint.alarm(for_s(0.2, 0.2))
    standstill.forget(joint.rest)
    assert joint.alarm(for_s(-0.2, 0.2)) == np.inf
    assert joint.alarm(for_s(0.2, 0.2)) < 0.05


def test_what_friction_held_is_known_once_the_joint_moves() -> None:
    joint = Joint()
    joint.alarm(for_s(0.1, 0.1))
    joint.alarm(for_s(-0.05, 0.1))
    assert standstill.withstood(joint.rest) == 0.0
    joint.alarm([0.0], stands=0.5)
    assert standstill.withstood(joint.rest) == pytest.approx(0.5 * (0.15 - MOMENTUM / FILTER_S))
    joint.held = 0.3
    joint.alarm([0.0, 0.0])
    joint.alarm([0.0], angle=1.0)
    assert standstill.withstood(joint.rest) == pytest.approx(0.3 - 0.5 * MOMENTUM / FILTER_S)
    joint.held = 0.0
    joint.alarm([0.0, 0.1])
    joint.alarm([0.0], stands=0.5)
    assert standstill.withstood(joint.rest) == pytest.approx(0.3 - 0.5 * MOMENTUM / FILTER_S), "the most so far"


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_small_excess_is_suspect_too(sign: float) -> None:
    joint = Joint()
    joint.alarm(sign * for_s(0.2, 0.2))
    joint.alarm(-sign * for_s(0.2 - 0.5 * (0.4 - 2 * FRICTION - TOLERANCE), INTERVAL))
    assert standstill.is_suspect(joint.rest)


def test_it_is_suspect_while_the_torque_is_outside_the_band() -> None:
    joint = Joint()
    joint.alarm(for_s(0.2, 0.2))
    assert not standstill.is_suspect(joint.rest)
    joint.alarm(for_s(-0.2, 0.01))
    assert standstill.is_suspect(joint.rest)
    joint.alarm(for_s(0.0, 0.1))
    assert not standstill.is_suspect(joint.rest)


@pytest.mark.parametrize(("torque", "distance"), [(0.0, -1.5), (1.0, 1.5)])
def test_earlier_torques_are_judged_by_the_present_estimates(torque: float, distance: float) -> None:
    """The residuals were -0.1 and -2.1 N m; now they are -1.6 or -0.6 N m."""
    rest = standstill.memory(1, 2)[0]
    standstill.look(rest, 0.3, 1.0, 1.0, np.array([0.5, 1.0]), np.zeros(2))
    standstill.look(rest, 0.3, 1.0, -1.0, np.array([0.4, 3.0]), np.zeros(2))
    theta = np.array([2.0, 0.1])
    assert standstill.look(rest, 0.3, 1.0, torque, np.array([0.7, 2.0]), theta) == pytest.approx(distance)


@pytest.mark.parametrize("sign", [-1.0, -0.2, 0.2, 1.0])
def test_only_terms_that_changed_since_the_farthest_torque_are_uncertain(sign: float) -> None:
    """The second joint's motion changes the first term by 0.2; the second one is the same throughout."""
    rest = standstill.memory(1, 2)[0]
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    nothing = np.zeros(2)
    standstill.look(rest, 0.3, 1.0, -sign, np.array([0.5, 1.0]), nothing)
    standstill.look(rest, 0.3, 1.0, 0.0, np.array([0.4, 1.0]), nothing)
    row = np.array([0.7, 1.0])
    distance = standstill.look(rest, 0.3, 1.0, sign, row, nothing)
    assert distance == pytest.approx(2.0 * sign)
    assert standstill.variance(rest, distance, row, covariance) == pytest.approx(0.2**2 * 4.0)
