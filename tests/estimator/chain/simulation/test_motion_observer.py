"""What a spatial arm's observer learns, and must not learn, from a joint at standstill or just after a reversal."""

import numpy as np
import pytest

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.simulation.motion_observer import ChainObserver

INTERVAL = 2.5e-3
DRY = 0.2


def observer(believed: float) -> tuple[ChainObserver, int]:
    """One vertical joint, believed to have this dry friction; and the index of that parameter."""
    chain = Chain(np.eye(3)[None], np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.array([0.0, 0.0, -9.81]))
    base = BaseParameters.of(chain)
    mean = np.array([*(0.01,) * base.count, 0.03, believed, 0.0])
    covariance = np.diag([*(1e-5,) * base.count, 0.02**2, 0.05**2, 0.04**2])
    return ChainObserver(base, mean, covariance, np.array([0.6]), INTERVAL), base.count + 1


def test_a_torque_that_static_friction_takes_up_teaches_nothing() -> None:
    looks, dry = observer(0.15)
    before = looks.parameters
    for k in range(8000):
        torque = 0.15 * (1.0 + 0.3 * np.sin(0.02 * k))
        assert looks.observe([0.5], [0.0], [torque], INTERVAL, True) == -1
    np.testing.assert_array_equal(looks.parameters, before)
    # A torque to the other side, which friction can hold as well, is therefore no alarm.
    for _ in range(400):
        assert looks.observe([0.5], [0.0], [-0.2], INTERVAL, True) == -1
    assert looks.parameters[dry] == before[dry]


def test_friction_is_learned_while_the_joint_slides() -> None:
    looks, dry = observer(0.1)
    angle = 0.0
    for k in range(8000):
        velocity = np.sin(4.0 * k * INTERVAL)
        angle += velocity * INTERVAL
        acceleration = 4.0 * np.cos(4.0 * k * INTERVAL)
        torque = 0.01 * acceleration + 0.03 * velocity + DRY * np.tanh(velocity / 0.05)
        assert looks.observe([angle], [velocity], [torque], INTERVAL, True) == -1
    assert abs(looks.parameters[dry] - DRY) < 0.02


def test_a_joint_that_has_moved_one_way_only_is_not_believed_to_be_without_friction() -> None:
    """It cannot tell friction from an offset: torque that friction takes up afterwards is no alarm."""
    looks, dry = observer(DRY)
    angle = 0.0
    for k in range(2000):
        velocity = 0.6 + 0.2 * np.sin(4.0 * k * INTERVAL)
        angle += velocity * INTERVAL
        torque = 0.008 * np.cos(4.0 * k * INTERVAL) + 0.03 * velocity
        assert looks.observe([angle], [velocity], [torque], INTERVAL, True) == -1
    assert looks.parameters[dry] < 0.5 * DRY
    for _ in range(60):  # it comes to rest no faster than its inertia and friction allow
        velocity *= 0.9
        angle += velocity * INTERVAL
        assert looks.observe([angle], [velocity], [0.0], INTERVAL, True) == -1
    for _ in range(400):
        assert looks.observe([angle], [0.0], [1.3 * DRY], INTERVAL, True) == -1


def test_a_blocked_joint_is_still_noticed() -> None:
    looks, _ = observer(0.1)
    alarms = [looks.observe([0.5], [0.0], [0.6], INTERVAL, True) for _ in range(400)]
    assert 0 in alarms


def swings(looks: ChainObserver, seconds: float, angle: float = 0.0) -> float:
    """Move the joint of `observer(DRY)` as its parameters say; return its angle [rad]."""
    for k in range(round(seconds / INTERVAL)):
        velocity, acceleration = np.sin(4.0 * k * INTERVAL), 4.0 * np.cos(4.0 * k * INTERVAL)
        angle += velocity * INTERVAL
        torque = 0.01 * acceleration + 0.03 * velocity + DRY * np.tanh(velocity / 0.05)
        assert looks.observe([angle], [velocity], [torque], INTERVAL, True) == -1
    return angle


def alarm_after(looks: ChainObserver, angle: float, slope: float, seconds: float) -> float:
    """Time until the alarm while a joint stands still and its torque increases from 0 by `slope` [N m/s]; or inf."""
    for k in range(round(seconds / INTERVAL)):
        if looks.observe([angle], [0.0], [slope * k * INTERVAL], INTERVAL, True) == 0:
            return k * INTERVAL
    return np.inf


@pytest.mark.parametrize("slope", [0.05, 0.1, 0.3, 1.0])
def test_a_joint_that_jams_is_noticed_as_soon_as_friction_cannot_hold_it_however_slowly_the_torque_grows(
    slope: float,
) -> None:
    """A residual that grows slowly must not pass for noise."""
    looks, _ = observer(DRY)
    angle = swings(looks, 6.4)
    assert slope * alarm_after(looks, angle, slope, 1.0 / slope) < 2.4 * DRY


def test_friction_that_a_joint_has_overcome_before_is_no_alarm_the_next_time() -> None:
    """The joint breaks away at 1.9 times its Coulomb friction, and then stands under nearly as much."""
    looks, _ = observer(DRY)
    angle = swings(looks, 6.4)
    for _ in range(3):
        assert alarm_after(looks, angle, 2.0, 0.19) == np.inf
        angle = swings(looks, 1.6, angle)
    for slope in (0.5, 0.1):
        assert alarm_after(looks, angle, slope, 0.36 / slope) == np.inf


def slow_swings(looks: ChainObserver, samples: int, lacking: float = 0.0, since: int = 0) -> int:
    """Swing the joint of `observer(DRY)`, whose friction reverses gradually; return the sample of an alarm, or -1.

    lacking: torque [N m] that the motion does not reflect, in the direction of motion, from the sample `since` on.
    """
    angle, bristle = 0.0, 0.0
    for k in range(samples):
        velocity, acceleration = 0.4 * np.sin(4.0 * k * INTERVAL), 1.6 * np.cos(4.0 * k * INTERVAL)
        angle += velocity * INTERVAL
        bristle += (1.0 - np.exp(-abs(velocity) * INTERVAL / 0.008)) * (np.sign(velocity) - bristle)
        torque = 0.01 * acceleration + 0.03 * velocity + DRY * bristle
        torque += lacking * np.sign(velocity) * (k >= since)
        if looks.observe([angle], [velocity], [torque], INTERVAL, True) == 0:
            return k
    return -1


def test_friction_that_reverses_gradually_is_no_alarm() -> None:
    assert slow_swings(observer(DRY)[0], 4000) == -1


@pytest.mark.parametrize("lacking", [0.5, -0.5])
def test_but_a_torque_that_is_lacking_after_a_reversal_is(lacking: float) -> None:
    reversal = round(np.pi / 4.0 / INTERVAL) * 4
    found = slow_swings(observer(DRY)[0], reversal + 400, lacking, reversal)
    assert 0 <= found - reversal <= 0.1 / INTERVAL
