"""The momentum observer on one joint that turns in a horizontal plane."""

import math

import numpy as np
import pytest

from hil.estimator.models.momentum_observer import NAMES, MomentumObserver

INTERVAL, SUBSTEPS = 0.005, 10
PEAK, INERTIA, VISCOUS = 0.22, 0.004, 0.02


def alarm_after(
    push: float, friction: float, frictions: float, begins: float = 6.0, rises: float = 0.0, irregular: float = 0.0
) -> float:
    """Time [s] from the beginning of a push [N m] to the alarm; infinite if there is none in 2 s."""
    mean = {"inertia_1": INERTIA, "viscous_1": VISCOUS, "coulomb_1": 0.08}
    std = {"inertia_1": 0.3 * INERTIA, "viscous_1": 0.5 * VISCOUS, "coulomb_1": 0.06, "offset_1": 0.04}
    covariance = np.diag([std.get(name, 0.0) ** 2 for name in NAMES])
    observer = MomentumObserver(mean, covariance, np.array([PEAK]), INTERVAL, frictions)
    return watched_by(observer, push, friction, begins, rises, irregular)


def alarm_of_hardly_known(push: float, friction: float, begins: float) -> float:
    """The same if only the torque is known beforehand."""
    std = {"inertia_1": 0.3, "viscous_1": 1.0, "offset_1": 0.3, "gravity_1": 0.3, "tilt_1": 0.3, "coulomb_1": 0.3}
    covariance = np.diag([(PEAK * std.get(name, 0.0)) ** 2 for name in NAMES])
    observer = MomentumObserver({"coulomb_1": 0.04}, covariance, np.array([PEAK]), INTERVAL, 3.0)
    return watched_by(observer, push, friction, begins)


def watched_by(
    observer: MomentumObserver, push: float, friction: float, begins: float, rises: float = 0.0, irregular: float = 0.0
) -> float:
    """Like `alarm_after`. rises: rise time of the push [s]. irregular: torque that varies with the angle [N m]."""
    q = v = 0.0
    torque = 0.0
    tick = 2 * math.pi / 4096
    for index in range(round((begins + 2.0) / INTERVAL)):
        time = index * INTERVAL
        found = observer.observe((tick * round(q / tick),), (0.024 * round(v / 0.024),), (torque,), INTERVAL)
        if found >= 0:
            assert time >= begins, "nothing was wrong yet"
            return time - begins
        torque = PEAK * (0.6 * math.sin(5.0 * time) + 0.4 * math.sin(13.0 * time))
        for _ in range(SUBSTEPS):
            step = INTERVAL / SUBSTEPS
            grown = min(1.0, (time - begins) / rises) if rises else 1.0
            pushed = (push * grown if time >= begins else 0.0) - irregular * math.sin(9.0 * q)
            free = v + step / INERTIA * (torque + pushed - VISCOUS * v)
            v = math.copysign(max(abs(free) - step / INERTIA * friction, 0.0), free)
            q += step * v
    return math.inf


def test_a_push_is_found_where_friction_turned_out_smaller_than_expected() -> None:
    assert alarm_after(0.12, friction=0.02, frictions=8.0) < 0.15


def test_what_friction_may_explain_is_no_push() -> None:
    """The same push, with friction as large as expected: near standstill the model knows too little."""
    assert alarm_after(0.12, friction=0.08, frictions=8.0) > alarm_after(0.12, friction=0.02, frictions=8.0)


@pytest.mark.parametrize("friction", [0.0, 0.02, 0.08, 0.15])
def test_a_healthy_joint_is_never_stopped(friction: float) -> None:
    assert alarm_after(0.0, friction, frictions=8.0) == math.inf


@pytest.mark.parametrize("irregular", [0.04, 0.06])
def test_a_push_that_grows_slowly_does_not_count_as_noise(irregular: float) -> None:
    """Friction that varies with the angle makes the noise grow, and the growing push would follow."""
    assert alarm_after(4.0 * PEAK, 0.02, 8.0, rises=2.0, irregular=irregular) < 1.0
    assert alarm_after(0.0, 0.02, 8.0, irregular=irregular) == math.inf


def test_friction_that_would_drive_the_joint_is_not_learnt() -> None:
    covariance = np.diag(
        [{"inertia_1": 2e-3, "viscous_1": 0.02, "coulomb_1": 0.05}.get(name, 0.0) ** 2 for name in NAMES]
    )
    observer = MomentumObserver({"inertia_1": INERTIA, "coulomb_1": 0.02}, covariance, np.array([1.0]), INTERVAL)
    for index in range(600):
        angle, speed = 5.0 * index * INTERVAL, math.cos(5.0 * index * INTERVAL)
        drives = -0.05 * math.copysign(1.0, speed) - 5.0 * INERTIA * math.sin(angle)
        assert observer.observe((0.2 * math.sin(angle),), (speed,), (drives,), INTERVAL) < 0
    assert all(observer.parameters[name] > -2e-3 for name in ("viscous_1", "coulomb_1"))


@pytest.mark.parametrize("friction", [0.02, 0.05])
@pytest.mark.parametrize("push", [0.4 * PEAK, -0.4 * PEAK])
def test_a_push_on_a_hardly_known_joint_is_found_by_the_model_from_before(push: float, friction: float) -> None:
    """Learning alone follows it."""
    assert alarm_of_hardly_known(push, friction, begins=1.0) < 0.5


@pytest.mark.parametrize("friction", [0.0, 0.02, 0.05, 0.1])
def test_a_healthy_hardly_known_joint_is_never_stopped(friction: float) -> None:
    assert alarm_of_hardly_known(0.0, friction, begins=6.0) == math.inf


def slow_heavy_joint_is_stopped(seed: int) -> bool:
    """Whether a healthy hanging link is stopped, whose accelerations are below the rounding of velocities."""
    rng = np.random.default_rng(seed)
    peak, interval, substeps = 9.0, 0.01, 4
    inertia, gravity, viscous = peak * rng.uniform([0.3, 2.0, 0.5], [2.0, 7.0, 1.5])
    omega, phase = math.tau * np.geomspace(0.03, 0.4, 8), rng.uniform(0.0, math.tau, 8)
    times = np.arange(0.0, 40.0, interval / substeps)
    wave = np.sin(np.multiply.outer(times, omega) + phase).sum(axis=1)
    torques = peak / abs(wave).max() * wave
    std = {"inertia_1": 1.8, "viscous_1": 6.0, "offset_1": 0.3, "gravity_1": 10.0, "tilt_1": 1.0, "coulomb_1": 0.01}
    covariance = np.diag([(peak * std.get(name, 0.0)) ** 2 for name in NAMES])
    observer = MomentumObserver({}, covariance, np.array([peak]), interval, 3.0)
    angle, speed, tick = -math.pi / 2, 0.0, math.tau / 4096
    held = 0.0
    for index, torque in enumerate(torques.tolist()):
        if index % substeps == 0:
            seen = 0.024 * round(speed / 0.024)
            if observer.observe((tick * round(angle / tick),), (seen,), (held,), interval) >= 0:
                return True
            held = torque
        speed += interval / substeps / inertia * (held - viscous * speed - gravity * math.cos(angle))
        angle += interval / substeps * speed
    return False


def test_a_healthy_joint_that_moves_slowly_and_weighs_much_is_never_stopped() -> None:
    assert not any(slow_heavy_joint_is_stopped(seed) for seed in range(12))


@pytest.mark.parametrize(("friction", "is_blocked"), [(0.1, False), (0.02, True)])
def test_a_link_that_floats_in_the_play_of_its_gear_does_not_show_in_which_direction_friction_acts(
    friction: float, is_blocked: bool
) -> None:
    """The motor sticks under a rising torque while the link drifts against it by less than the play, at 0.07 rad/s."""
    mean = {"inertia_1": INERTIA, "viscous_1": VISCOUS, "coulomb_1": friction}
    covariance = np.diag([(0.1 * mean.get(name, 0.0)) ** 2 for name in NAMES])
    observer = MomentumObserver(mean, covariance, np.array([PEAK]), INTERVAL)
    for index in range(round(1.0 / INTERVAL)):  # it slides at a constant velocity
        assert observer.observe((0.5 * index * INTERVAL,), (0.5,), (VISCOUS * 0.5 + friction,), INTERVAL) < 0
    found = -1
    for index in range(round(0.3 / INTERVAL)):  # it comes to rest, stays, and drifts back and forth within 4 mrad
        stays, drifts = index * INTERVAL < 0.1, index * INTERVAL - 0.1
        velocity = 0.0 if stays else 0.072 * (-1.0 if drifts % 0.1 < 0.05 else 1.0)
        angle = 0.5 if stays else 0.5 - 0.072 * (0.05 - abs(drifts % 0.1 - 0.05))
        torque = 0.0 if stays else min(0.13, 0.13 * drifts / 0.05)
        found = max(found, observer.observe((angle,), (velocity,), (torque,), INTERVAL))
    assert (found == 0) == is_blocked
