"""Which joints of a spatial arm lie on their own stop in the rest pose."""

import numpy as np

from hil.config.schema import Config, load_config
from hil.dry_run.chain_prior import prior_arms
from hil.dry_run.resting_stops import passed_rest, resting_stops, said_of_stops
from hil.estimator.chain.simulation.rollout import OFFSET
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


def stops_of(config: Config, offset: float = 0.0) -> list[float]:
    arms = prior_arms(config, known_chain(config), 6)
    arms.drive[:, OFFSET, 2] += offset
    return list(resting_stops(config, arms))


def test_a_joint_near_the_end_of_its_range_that_nothing_touches_lies_on_its_stop() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    assert stops_of(config) == [0, 0, 1, 0, 0, 0]  # base and gripper touch the parts that the others move
    assert stops_of(config, offset=5.0) == [0] * 6  # pulled off the stop


def test_a_joint_far_from_the_end_of_its_range_does_not() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    joint = config.joints[2].model_copy(update={"position_limit": [-3.0, 3.0]})
    wide = config.model_copy(update={"joints": [*config.joints[:2], joint, *config.joints[3:]]})
    rest = list(config.arm.rest_pose)
    rest[2] -= 0.3
    away = wide.model_copy(update={"arm": wide.arm.model_copy(update={"rest_pose": rest})})
    assert stops_of(away)[2] == 0


def test_an_arm_folded_onto_itself_may_be_carried_by_itself() -> None:
    config = load_config(CONFIGS / "koch.toml")
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    rest = np.array(config.arm.rest_pose)
    assert (np.minimum(rest - low, high - rest) < 0.1).sum() >= 3
    assert stops_of(config) == [0] * 5


def test_a_joint_that_was_beyond_its_rest_pose_was_carried_by_something_else() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    arms, rest = prior_arms(config, known_chain(config), 6), np.array(config.arm.rest_pose)
    for sagged, side in ((0.1, 0.0), (0.02, 1.0), (-0.1, 1.0)):  # the last one moves away from the stop
        motion = np.tile(rest, (3, 1))
        motion[1, 2] += sagged
        motion[2] = np.nan
        assert resting_stops(config, arms, passed=passed_rest(config, motion))[2] == side


def test_a_joint_that_the_plan_takes_beyond_its_rest_pose_has_no_stop_there() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    arms, rest = prior_arms(config, known_chain(config), 6), np.array(config.arm.rest_pose)
    for planned, side in ((0.1, 0.0), (0.02, 1.0), (-0.5, 1.0)):
        path = np.tile(rest[:, None], 3)
        path[2, 1] += planned
        assert resting_stops(config, arms, [path])[2] == side


def test_what_is_assumed_is_said_with_how_far_a_joint_may_sag_if_it_is_wrong() -> None:
    config = load_config(CONFIGS / "wx250s.toml")
    room = config.joints[2].position_limit[1] - config.arm.rest_pose[2]
    assert f"{config.joints[2].name!r} ({room:.2f} rad)" in said_of_stops(config, np.array([0, 0, 1, 0, 0, 0]))
    assert said_of_stops(config, np.zeros(6)) == ""
