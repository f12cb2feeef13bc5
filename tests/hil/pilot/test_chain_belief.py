"""The ensemble of a spatial arm's pilot remains an ensemble of arms when it learns from a recording."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.dry_run.chain_prediction import loop_of
from hil.estimator.chain.excitation import path_design
from hil.estimator.chain.simulation.rollout import inertias, roll_out, weights
from hil.pilot.chain_belief import SIMULATED, ChainBelief, _poses
from hil.pilot.chain_paths import Paths, chain_config
from hil.pilot.chain_shares import step_config
from hil.runs.recording import Phase
from tests.support.edits import replaced
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """A leg whose second axis is nearly parallel to its first, so that the weights of some links nearly cancel."""
    folder: Path = tmp_path_factory.mktemp("leg")
    urdf = (CONFIGS / "leg.urdf").read_text(encoding="utf-8")
    first, _, rest = urdf.partition('<axis xyz="0 1 0"/>')
    (folder / "leg.urdf").write_text(first + '<axis xyz="0.99875 0.05 0"/>' + rest, encoding="utf-8")
    text = (CONFIGS / "leg.toml").read_text(encoding="utf-8")
    text = replaced(text, ("period = 10.0", "period = 5.0"), ("rate = 400.0", "rate = 100.0"))
    (folder / "leg.toml").write_text(text, encoding="utf-8")
    return chain_config(load_config(folder / "leg.toml"))


@pytest.fixture(scope="module", autouse=True)
def _designed_quickly() -> Iterator[None]:
    """A third of the design's generations is enough to find a usable path."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(path_design, "GENERATIONS", 20)
        yield


@pytest.fixture(scope="module")
def prior(config: Config) -> ChainBelief:
    return ChainBelief.prior(config)


def recorded(config: Config, belief: ChainBelief, arm: int, share: float) -> np.ndarray:
    """What would be recorded if this arm of the ensemble followed a share of a path for a pilot."""
    held = step_config(belief.with_stabiliser(config))
    segment = Paths.of(config, belief.torque).plan(held, belief.torque, share).segments[0]
    loop = loop_of(held, segment, config.experiment.rate)  # type: ignore[arg-type]
    motion = roll_out(belief.arms.chosen([arm]), loop, np.array(config.arm.rest_pose))
    n = len(config.joints)
    of = [("phase", int), ("segment", int), ("period", int), ("position", float, (n,)), ("goal_current", float, (n,))]
    samples = np.zeros(len(loop.goal), dtype=of)
    samples["phase"] = Phase.PERIODIC
    samples["position"] = np.round(motion.position[0] * 4096 / (2 * np.pi)) * 2 * np.pi / 4096
    samples["goal_current"] = motion.torque[0] / [joint.torque_per_goal for joint in config.joints]
    return samples


def test_the_weight_in_any_pose_becomes_better_known(config: Config, prior: ChainBelief) -> None:
    learned = prior.learn(config, recorded(config, prior, 3, 0.3))
    for pose in _poses(config):
        before, after = (weights(belief.arms.first(SIMULATED), pose) for belief in (prior, learned))
        true = weights(prior.arms.chosen([3]), pose)[0] / prior.arms.drive[3, 4]
        assert np.all(after.std(axis=0) < before.std(axis=0))
        assert np.all(np.abs(after.mean(axis=0) - true) < before.std(axis=0) + 0.02)


@pytest.mark.parametrize("stuck", [True, False])
def test_the_friction_of_a_joint_that_a_torque_did_not_move_is_larger_than_that_torque(
    config: Config, prior: ChainBelief, stuck: bool
) -> None:
    """The regression learns no friction from a joint at standstill, so it would be given the same torque again."""
    samples = recorded(config, prior, 3, 0.3)
    torque = 0.3 * np.sin(np.arange(len(samples)) / 7.0)
    samples["goal_current"][:, 2] += torque / config.joints[2].torque_per_goal
    if stuck:
        samples["position"][:, 2] = config.arm.rest_pose[2]
    samples["period"][len(samples) // 2 :] = 1
    learned = prior.learn(config, samples)
    before, after = (belief.torque.coulomb for belief in (prior, learned))
    assert before[2] < 0.3
    assert (after[2] > 0.3) == stuck
    assert after[0] < 2.0 * before[0]


def test_no_joint_becomes_lighter_than_an_arm_can_be(config: Config, prior: ChainBelief) -> None:
    """A linear update of positive inertias with large errors makes some of them tiny or negative."""
    belief = replace(prior, arms=prior.arms.first(200))
    base = prior.arms.base
    linear = np.concatenate((belief.arms.rigid, belief.arms.drive[:, :3].reshape(200, -1)), axis=1)
    knee = base.names.index("armature_3")
    spread = np.random.default_rng(1).standard_normal(200)
    linear[:, knee] = belief.arms.rigid[:, knee].mean() * (1.0 + 0.6 * spread)
    arms = belief._arms(linear)
    free = inertias(arms, _poses(config))[1]
    assert np.all(free > 0.2 * prior.lightest)
    assert arms.size > 150
    unchanged = spread > -0.5  # so that arms within reason stay as they are
    assert np.isin(np.round(linear[unchanged, knee], 9), np.round(arms.rigid[:, knee], 9)).mean() > 0.95


def test_an_arm_much_lighter_than_described_is_believed(config: Config, prior: ChainBelief) -> None:
    belief = replace(prior, arms=prior.arms.first(200))
    linear = np.concatenate((0.1 * belief.arms.rigid, belief.arms.drive[:, :3].reshape(200, -1)), axis=1)
    count = prior.arms.base.count
    scale = np.abs(linear[:, :count]).mean(axis=0)
    np.testing.assert_allclose((belief._arms(linear).rigid - linear[:, :count]).mean(axis=0) / scale, 0.0, atol=0.1)
