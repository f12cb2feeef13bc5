"""What the observer of a spatial arm learns, and must not learn, from a joint at standstill."""

import numpy as np

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
    for _ in range(400):
        assert looks.observe([angle], [0.0], [1.3 * DRY], INTERVAL, True) == -1


def test_a_blocked_joint_is_still_noticed() -> None:
    looks, _ = observer(0.1)
    alarms = [looks.observe([0.5], [0.0], [0.6], INTERVAL, True) for _ in range(400)]
    assert 0 in alarms
