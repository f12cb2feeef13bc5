"""A wrong direction, zero, axis or base is told from the motion; a fault that begins is not taken for one."""

from dataclasses import replace

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.dry_run.chain_prior import prior_arms
from hil.estimator.arrays import Array
from hil.estimator.chain.description_faults import Change, Known, Motion, better_descriptions
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.simulation.motion_observer import STANDING
from hil.experiment.chain_watch import LYING_RAD, observed_parameters
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS

RATE, SECONDS = 200.0, 12.0
CONFIG = load_config(CONFIGS / "fake_open_manipulator_x.toml")
CHAIN = known_chain(CONFIG).base.chain
REST = np.array(CONFIG.arm.rest_pose)
JOINTS = len(REST)


def known(chain: Chain) -> tuple[BaseParameters, Array, Array]:
    described = replace(known_chain(CONFIG), base=BaseParameters.of(chain))
    return described.base, *observed_parameters(prior_arms(CONFIG, described, 96))


def moved(chain: Chain, seed: int) -> tuple[Array, Array]:
    """Angles and torques (joints, samples) of an arm near the description as it leaves its rest pose and moves."""
    random = np.random.default_rng(seed)
    time = np.arange(round(SECONDS * RATE)) / RATE
    # It rises by 0.6 rad within 2 s, then swings.
    s = np.clip(time / 2.0, 0.0, 1.0)
    hz = random.uniform(0.15, 0.4, (JOINTS, 1))
    swing = 0.4 * np.sin(2.0 * np.pi * hz * np.clip(time - 2.0, 0.0, None)) * np.clip((time - 2.0) / 2.0, 0.0, 1.0)
    position = REST[:, None] + 0.6 * s**3 * (10.0 - 15.0 * s + 6.0 * s**2) + swing
    velocity = np.gradient(position, 1.0 / RATE, axis=1)
    base = BaseParameters.of(chain)
    arms = prior_arms(CONFIG, replace(known_chain(CONFIG), base=base), 8, seed)
    rigid = base.regressor(position, velocity, np.gradient(velocity, 1.0 / RATE, axis=1)) @ arms.rigid[3]
    viscous, coulomb = arms.drive[3, :2, :, None]
    torque = rigid + viscous * velocity + coulomb * np.tanh(velocity / STANDING)
    return position, np.concatenate((torque[:, :1], torque[:, :-1]), axis=1) / arms.drive[3, 4, :, None]


def found(position: Array, torque: Array, by: Known = known) -> tuple[Change, ...]:
    rest = position[:, 0]
    return better_descriptions(CHAIN, by, Motion.of(position, torque, 1.0 / RATE, rest, LYING_RAD), rest)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("joint", "kind"), [(1, "direction"), (2, "direction"), (1, "zero"), (2, "zero")])
def test_a_wrong_direction_or_zero_is_found(joint: int, kind: str, seed: int) -> None:
    position, torque = moved(CHAIN, seed)
    if kind == "zero":
        position[joint] -= np.pi / 2.0
    else:
        position[joint], torque[joint] = 2.0 * REST[joint] - position[joint], -torque[joint]
    best, *others = found(position, torque)
    assert (best.joint, best.kind) == (joint, kind) and len(others) < 3
    assert best.turned == pytest.approx(np.pi / 2.0 if kind == "zero" else 2.0 * REST[joint])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_wrong_axis_or_base_is_found(seed: int) -> None:
    turned = CHAIN.axis.copy()
    turned[2] = (0.0, 0.0, 1.0)
    assert Change(2, "axis", axis=(0.0, 0.0, 1.0)) in found(*moved(replace(CHAIN, axis=turned), seed))
    assert Change(-1, "base", axis=(0.0, 0.0, -1.0)) in found(*moved(replace(CHAIN, gravity=-CHAIN.gravity), seed))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("joint", [0, 1, 2])
@pytest.mark.parametrize("since", [0.3, 0.8, 2.0])
def test_a_fault_that_begins_is_not_taken_for_a_wrong_description(joint: int, since: float, seed: int) -> None:
    position, torque = moved(CHAIN, seed)
    assert found(position, torque) == ()
    last = round(since * RATE)
    for sign in (1.0, -1.0, 0.0):  # blocked, the wires exchanged, no motor
        wrong, held = torque.copy(), position.copy()
        wrong[joint, -last:] = sign * wrong[joint, -last:] + 0.3 * np.abs(torque[joint]).max()
        if sign == 1.0:
            held[joint, -last:] = held[joint, -last - 1]
        assert found(held, wrong) == ()


def test_too_short_a_motion_is_not_judged() -> None:
    position, torque = moved(CHAIN, 1)
    position[1] -= np.pi / 2.0
    assert found(position, torque) and found(position[:, : round(2.5 * RATE)], torque[:, : round(2.5 * RATE)]) == ()
