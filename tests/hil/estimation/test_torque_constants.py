"""Torques that contradict each other: named, and never trusted without reservation, whatever states them."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.experiment import ModelConfig
from hil.config.schema import load_config
from hil.estimation.chain_estimate import contradicting_torques
from hil.estimation.plausibility import doubts
from hil.estimation.torque_constants import contradictions, ratios_said, torque_constants_said
from hil.estimation.unsettled.estimate import estimate_any
from hil.estimation.unsettled.warnings import _turns
from hil.estimator.data.recording import Recording
from hil.results.parts import Quantity
from tests.support.paths import CONFIGS
from tests.support.recorded_motion import two_joints

JOINTS = ("joint 1", "joint 2", "joint 3")


@pytest.mark.parametrize(
    ("ratio", "std", "spread", "contradictory"),
    [
        (0.7, 2e-4, {}, True),
        (1.43, 2e-4, {}, True),
        (1.25, 2e-4, {}, True),
        (1.12, 2e-4, {}, False),
        (1.25, 2e-4, {"torque_scale_2": 0.05}, True),
        (1.43, 2e-4, {"torque_scale_2": 0.3}, False),
        (1.43, 0.5, {}, False),
        (1.43, np.inf, {}, False),
    ],
)
def test_a_ratio_beyond_the_uncertainty_of_torque_constants_is_a_contradiction(
    ratio: float, std: float, spread: dict[str, float], contradictory: bool
) -> None:
    extra = {"delay": Quantity(1e-3, 1e-5, "s"), "torque_scale_2": Quantity(ratio, std, "1")}
    found = contradictions(JOINTS, extra, spread, "column")
    assert bool(found) is contradictory
    assert all("of joint 1 and joint 2 disagree by a factor of" in each for each in found)
    said = ratios_said(JOINTS, extra, "column", found)
    assert bool(said) is not contradictory
    assert all("elative to joint 1, joint 2 gives" in each for each in (*found, *said))
    assert all("The values of all joints are relative to the torque of joint 1" in each for each in (*found, *said))


def test_turns_and_torque_constants_are_said_plainly() -> None:
    angle = np.linspace(0.0, 25.0, 100)
    recording = Recording(0.01 * np.arange(100), np.ones((1, 100)), angle[None], np.array([1e-3]))
    (turns,) = _turns([recording], 0, "Joint 1")
    assert turns == "Joint 1 seems to have moved 4 turns. If it did not, the unit of its positions is wrong."
    config = load_config(CONFIGS / "fake_two_link.toml")
    known = torque_constants_said(config.joints, {})
    assert known.startswith(
        "Every value is also proportional to its joint's torque constant, which is known to within 8.3 % (shoulder), "
    )


def test_a_recording_whose_first_torque_is_too_small_is_used_with_care_at_most() -> None:
    """The torque of joint 1 as logged is 0.7 times the true one, so that all values are 30 % too small."""
    motion = two_joints(5.0)
    torque = motion.torque * np.array([[0.7], [1.0]])
    recording = Recording(motion.time, torque, motion.position, np.full(2, 2 * np.pi / 4096), "held")
    wanted = ModelConfig(friction="stribeck", drive="delay", torque_scale=True)
    verdict = estimate_any([recording], wanted, 1.0, False, "arm.csv", 9.81, (True, True)).result.verdict
    assert verdict is not None and verdict.trust == "with care"
    said = " ".join(verdict.sentences)
    assert "torque columns of joint 1 and joint 2 disagree by a factor of 1.4" in said


def estimated(ratio: float) -> Any:
    names = ("inertia_1", "torque_scale_2")
    return SimpleNamespace(
        names=names,
        value=np.array([0.02, ratio]),
        std=np.array([1e-4, 1e-4]),
        parameters={"inertia_1": 0.02, "gravity_1": 1.0, "gravity_2": 0.3, "torque_scale_2": ratio},
        model=SimpleNamespace(joints=0),
        conflicts=(),
    )


@pytest.mark.parametrize(("ratio", "contradictory"), [(1.1, False), (1.5, True), (0.6, True)])
def test_runs_of_planar_and_spatial_arms_follow_the_same_rule(ratio: float, contradictory: bool) -> None:
    planar, spatial = (load_config(CONFIGS / name) for name in ("fake_two_link.toml", "fake_viperx_300.toml"))
    found = [doubts(planar, estimated(ratio), 1.0), contradicting_torques(spatial, estimated(ratio))]
    for config, said in zip((planar, spatial), found, strict=True):
        assert bool(said) is contradictory
        first, second = (joint.name for joint in config.joints[:2])
        assert all(f"torque constants of {first} and {second} disagree" in each for each in said)
