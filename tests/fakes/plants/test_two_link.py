"""The plant compared with energy conservation, stiction, finer steps and the estimator's independent equations."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names
from hil.fakes.plants import two_link
from hil.fakes.plants.arm import Arm, armature, base_parameters
from hil.fakes.plants.pendulum import Pendulum
from hil.fakes.plants.plant import make_plant
from hil.fakes.plants.two_link import TwoLink

LINKS = (
    {"length": 0.147, "mass": 0.180, "centre": 0.081, "inertia": 7.0e-4},
    {"length": 0.180, "mass": 0.200, "centre": 0.112, "inertia": 2.9e-4},
)
DRIVE = {"mass": 0.082, "rotor_inertia": 8.0e-8, "gear_ratio": 353.5, "torque_constant": 1.8}
FRICTION = {"viscous": 0.04, "coulomb": 0.05, "stribeck_rise": 0.4, "stribeck_velocity": 0.15}


def arm(joints: int = 2, start: tuple[float, ...] = (-math.pi / 2, 0.0), **drive: Any) -> Arm:
    return Arm.model_validate(
        {"start": start[:joints], "links": LINKS[:joints], "drives": ({**DRIVE, **drive},) * joints}
    )


def energy(arm: Arm, position: tuple[float, ...], velocity: tuple[float, ...]) -> float:
    """Return the sum over bodies of kinetic and potential energy, with positions and velocities by plane geometry."""
    total = 0.0
    angle = rate = 0.0
    x = y = vx = vy = 0.0
    for link, drive, q, v in zip(arm.links, arm.drives, position, velocity, strict=True):
        total += 0.5 * drive.mass * (vx**2 + vy**2) + drive.mass * arm.gravity * y
        total += 0.5 * armature(drive) * v**2
        angle, rate = angle + q, rate + v
        c, s = math.cos(angle), math.sin(angle)
        wx, wy = vx - link.centre * s * rate, vy + link.centre * c * rate
        total += 0.5 * link.mass * (wx**2 + wy**2) + 0.5 * link.inertia * rate**2
        total += link.mass * arm.gravity * (y + link.centre * s)
        x, y = x + link.length * c, y + link.length * s
        vx, vy = vx - link.length * s * rate, vy + link.length * c * rate
    return total


angles = st.floats(-3.0, 3.0)
speeds = st.floats(-6.0, 6.0)
currents = st.floats(-0.5, 0.5)


@settings(max_examples=20, deadline=None)
@given(angles, angles, speeds, speeds)
def test_energy_is_kept_without_friction(q1: float, q2: float, v1: float, v2: float) -> None:
    free = arm(start=(q1, q2))
    plant = TwoLink(free, (v1, v2))
    before = energy(free, plant.position, plant.velocity)
    scale = abs(before) + 0.5
    for k in range(1, 401):
        plant.advance(k / 400, (0.0, 0.0))
    assert plant.position != (q1, q2)
    assert abs(energy(free, plant.position, plant.velocity) - before) < 2e-4 * scale


@settings(max_examples=20, deadline=None)
@given(angles, speeds)
def test_a_pendulum_keeps_its_energy(q: float, v: float) -> None:
    free = arm(1, start=(q,))
    plant = Pendulum(free, (v,))
    before = energy(free, plant.position, plant.velocity)
    plant.advance(1.0, (0.0,))
    assert abs(energy(free, plant.position, plant.velocity) - before) < 2e-4 * (abs(before) + 0.5)


@settings(max_examples=40, deadline=None)
@given(st.tuples(angles, angles), st.tuples(speeds, speeds), st.tuples(currents, currents))
def test_plant_and_regressor_are_the_same_arm(
    position: tuple[float, float], velocity: tuple[float, float], current: tuple[float, float]
) -> None:
    """Two derivations, from bodies and from base parameters, agree on the torque of an accelerating arm."""
    smooth = arm(start=position, viscous=0.04, coulomb=0.05, coulomb_width=0.3, offset=0.01)
    step = 1e-8  # s: short compared with all time scales, long enough to avoid rounding errors
    plant = TwoLink(smooth, velocity)
    plant.advance(step, current)
    acceleration = [(after - before) / step for before, after in zip(velocity, plant.velocity, strict=True)]
    theta = np.array(list(base_parameters(smooth).values()))
    column = [np.array(x)[:, None] for x in (position, velocity, acceleration)]
    torque = (regressor(*column, coulomb_width=0.3) @ theta)[:, 0]
    assert np.allclose(torque, 1.8 * np.array(current), rtol=0.0, atol=1e-6)


def test_truth_has_the_estimators_names() -> None:
    assert tuple(base_parameters(arm())) == base_names(2)
    assert tuple(base_parameters(arm(1))) == base_names(1)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.99, 0.99), st.floats(-0.99, 0.99))
def test_a_torque_below_static_friction_moves_nothing(share_1: float, share_2: float) -> None:
    """When hanging straight down no other torque acts; each joint is held by 1.4 times Coulomb friction."""
    sticking = arm(**FRICTION)
    plant = make_plant(sticking)
    static = 0.05 * 1.4 / 1.8
    # Straight down means cos(q1) is 6e-17: a negligible torque compared with friction.
    for k in range(1, 200):
        plant.advance(k / 400, (share_1 * static, share_2 * static))
    assert plant.position == sticking.start
    assert tuple(plant.velocity) == (0.0, 0.0)


def test_a_torque_above_static_friction_breaks_loose() -> None:
    plant = make_plant(arm(**FRICTION))
    plant.advance(0.1, (0.0, 1.02 * 0.05 * 1.4 / 1.8))
    assert plant.position[1] > 1e-4


def test_friction_brings_a_swinging_arm_to_an_exact_rest() -> None:
    plant = TwoLink(arm(start=(-1.0, 0.5), **FRICTION), (2.0, -3.0))
    plant.advance(10.0, (0.0, 0.0))
    rest = plant.position
    plant.advance(11.0, (0.0, 0.0))
    assert plant.position == rest
    assert plant.velocity == (0.0, 0.0)


def test_friction_yields_before_it_slides_and_lets_go_again() -> None:
    """Pushed slowly with less than its level, it deflects by -level / stiffness log(1 - torque / level)."""
    soft = arm(1, coulomb=0.05, presliding_stiffness=10.0, presliding_damping=0.3, viscous=0.02)
    plant = make_plant(soft)
    gravity = base_parameters(soft)["gravity_1"]
    for k in range(4400):
        plant.advance((k + 1) / 400, (min(k / 4000, 1.0) * 0.03 / 1.8,))
    moved = plant.position[0] - soft.start[0]
    held = 0.03 - gravity * math.sin(moved)
    assert moved == pytest.approx(-0.05 / 10.0 * math.log(1.0 - held / 0.05), rel=0.01)
    assert abs(plant.velocity[0]) < 1e-5
    plant.advance(15.0, (0.0,))
    # The deflection recovers by log(1 + torque / level); the rest is friction's hysteresis.
    left = moved - 0.05 / 10.0 * math.log(1.0 + held / 0.05)
    assert plant.position[0] - soft.start[0] == pytest.approx(left, rel=0.1)


@pytest.mark.parametrize("joints", [1, 2])
def test_friction_that_has_yielded_is_dry_friction(joints: int) -> None:
    """Far from standstill, both kinds of dry friction have the same effect."""
    start, speed = (0.3, 0.4)[:joints], (3.0, -4.0)[:joints]
    ends = []
    for near in ({}, {"presliding_stiffness": 100.0, "presliding_damping": 0.1}):
        sliding = arm(joints, start, coulomb=0.05, viscous=0.02, **near)
        plant = Pendulum(sliding, speed) if joints == 1 else TwoLink(sliding, speed)
        plant.advance(0.05, (0.0,) * joints)
        ends.append(tuple(plant.velocity))
    assert ends[1] == pytest.approx(ends[0], rel=0.02)


@pytest.mark.parametrize("joints", [1, 2])
@pytest.mark.parametrize(
    "near", [{}, {"coulomb_width": 0.05}, {"presliding_stiffness": 15.0, "presliding_damping": 0.3}]
)
def test_motion_does_not_depend_on_how_advance_is_cut(joints: int, near: dict[str, float]) -> None:
    drives = arm(joints, **FRICTION, **near, current_lag=1e-3, load=0.05, ripple=0.02)
    cuts = ((2.5e-3,), (0.18e-3, 0.34e-3, 2.5e-3), (0.01e-3, 1.1e-3, 1.3e-3, 2.5e-3))
    tracks = []
    for cut in cuts:
        plant = make_plant(drives)
        track = []
        for k in range(1600):
            t = k / 400
            current = (0.35 * math.sin(4.0 * t), 0.2 * math.sin(7.0 * t) + 0.05 * math.sin(29.0 * t))[:joints]
            for until in cut:
                plant.advance(t + until, current)
            track.append(plant.position)
        tracks.append(np.array(track))
    assert np.ptp(tracks[0], axis=0).min() > 0.3
    encoder_step = 2.0 * math.pi / 4096
    for track in tracks[1:]:
        assert np.sqrt(np.mean((track - tracks[0]) ** 2)) < 0.05 * encoder_step


def test_the_past_is_left_alone() -> None:
    plant = make_plant(arm(start=(0.3, 0.4)))
    plant.advance(0.5, (0.1, 0.0))
    there = plant.position
    plant.advance(0.5, (0.4, 0.4))
    plant.advance(0.2, (0.4, 0.4))
    assert plant.position == there


def test_current_follows_a_first_order_lag() -> None:
    plant = make_plant(arm(current_lag=2e-3))
    plant.advance(2e-3, (1.0, -0.5))
    assert plant.current == pytest.approx((1.0 - math.exp(-1.0), -0.5 * (1.0 - math.exp(-1.0))), rel=1e-12)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"links": LINKS[:1]}, "1 links, 2 drives"),
        ({"start": (0.0,)}, "1 angles in start"),
        ({"gravity": -9.81}, "gravity"),
        ({"weight": 3.0}, "weight"),
        ({"drives": ({**DRIVE, "viscous": -0.1}, DRIVE)}, "viscous"),
        ({"drives": ({**DRIVE, "coulomb_width": 1e-5}, DRIVE)}, "coulomb_width"),
        ({"drives": ({**DRIVE, "presliding_stiffness": 9.0}, DRIVE)}, "needs a coulomb"),
        ({"drives": ({**DRIVE, "presliding_damping": 0.1}, DRIVE)}, "needs a presliding_stiffness"),
        (
            {"drives": ({**DRIVE, "presliding_stiffness": 9.0, "coulomb": 0.1, "coulomb_width": 0.1}, DRIVE)},
            "give only one",
        ),
    ],
)
def test_a_wrong_arm_is_refused_by_name(change: dict[str, Any], named: str) -> None:
    right = {"start": (0.0, 0.0), "links": LINKS, "drives": (DRIVE, DRIVE)}
    Arm.model_validate(right)
    with pytest.raises(ValidationError, match=named):
        Arm.model_validate({**right, **change})


@settings(max_examples=30, deadline=None)
@given(
    start=st.tuples(angles, angles),
    speed=st.tuples(speeds, speeds),
    lag=st.sampled_from((0.0, 2e-3)),
    friction=st.sampled_from((FRICTION, {}, {"coulomb": 0.3, "offset": 0.02}, {**FRICTION, "coulomb_width": 0.05})),
    commands=st.lists(st.tuples(currents, currents, st.floats(1e-10, 4e-3)), min_size=1, max_size=60),
)
def test_the_compiled_loop_gives_the_same_to_the_last_bit(
    start: tuple[float, float],
    speed: tuple[float, float],
    lag: float,
    friction: dict[str, float],
    commands: list[tuple[float, float, float]],
) -> None:
    described = arm(start=start, current_lag=lag, **friction)
    compiled, interpreted, driven = (TwoLink(described, speed) for _ in range(3))
    interpreted._run = two_link._run
    driven._are_plain = False  # so that its motors compute their friction themselves
    assert compiled._run is not interpreted._run, "numba is loaded here"
    now = 0.0
    for *current, seconds in commands:
        now += seconds
        compiled.advance(now, current)
        interpreted.advance(now, current)
        driven.advance(now, current)
        assert compiled._state == interpreted._state == driven._state
