"""Belief updates from runs with and without motion, stabiliser gains, and when the search gives up."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config, parse_config
from hil.errors import ConfigError, ExperimentError
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import respond, resting
from hil.pilot import identify_in_steps
from hil.pilot.belief import Belief, prior_belief
from hil.pilot.gains import gravity_stiffness, wandering, with_stabiliser
from hil.pilot.search import pilot_config, with_torque
from hil.pilot.seen import Seen
from hil.plan.plan import make_plan
from hil.plan.stabiliser import feedback_of, too_slow
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def config() -> Config:
    """With half the period, so that simulations and designs take half the time."""
    path = CONFIGS / "first_time.toml"
    shorter = ("period = 10.0 ", "period = 5.0 "), ("band = [0.1,", "band = [0.2,")
    return parse_config(replaced(path.read_text(encoding="utf-8"), *shorter), path)


def commands(config: Config, peak: tuple[float, float]) -> np.ndarray:
    """Torque of the ramp and one period of a pilot (joints, samples) [N m]."""
    pilot = with_torque(pilot_config(config), np.array(peak))
    segment = make_plan(pilot).segments[0]
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    return np.ascontiguousarray((np.concatenate((segment.ramp_in, segment.period_current)) * constants).T)


def median(belief: Belief, name: str) -> float:
    return float(np.median([each[name] for each in belief.parameters]))


def test_what_an_arm_did_is_learned(config: Config) -> None:
    truth = prior_belief(config, 60, seed=3).parameters[41]
    command, pose = commands(config, (0.5, 0.35)), np.array([-1.54, 0.05])
    position = respond(Physics.of(truth), resting(pose), command, 400.0, feedback_of(config)).position
    prior = prior_belief(config, 96)
    belief = prior.after(config, Seen(command, command, np.round(position / 0.0015) * 0.0015, pose, pose))
    for name in ("gravity_1", "gravity_2", "inertia_1", "coulomb_1"):
        assert median(belief, name) == pytest.approx(truth[name], rel=0.12), name
        assert belief.spread(name) < 0.5 * prior.spread(name), name
        assert abs(np.log(median(belief, name) / truth[name])) < 4 * belief.spread(name), name


def test_a_joint_that_stood_still_asks_for_friction_and_nothing_else(config: Config) -> None:
    command, pose = commands(config, (0.2, 0.12)), np.array([-1.57, 0.0])
    seen = Seen(command, command, np.repeat(pose[:, None], command.shape[1], axis=1), pose, pose)
    prior = prior_belief(config, 60)
    belief = prior.after(config, seen)
    for joint in (1, 2):
        assert median(belief, f"coulomb_{joint}") > 1.2 * median(prior, f"coulomb_{joint}")
        assert belief.spread(f"coulomb_{joint}") > 0.1, "how much more is unknown"
        assert median(belief, f"gravity_{joint}") == median(prior, f"gravity_{joint}")
    assert (np.ptp(belief._motions(config, seen), axis=2) < 0.03).mean() > 0.95
    assert belief.ensemble().source == "belief" and prior.ensemble().source == "prior"


@pytest.mark.parametrize(("gravity", "rest", "needed"), [(9.81, -1.57, False), (0.0, 0.3, True), (9.81, 1.57, True)])
def test_arms_that_do_not_come_back_are_given_gains_that_hold_them(
    config: Config, gravity: float, rest: float, needed: bool
) -> None:
    arm = config.arm.model_copy(update={"gravity": gravity, "rest_pose": [rest, 0.0]})
    turned = config.model_copy(update={"arm": arm})
    belief = prior_belief(turned, 48)
    assert wandering(turned, belief).any() == needed
    held = with_stabiliser(turned, belief)
    assert (held.stabiliser is not None) is needed
    if not needed:
        return
    assert with_stabiliser(held, belief) is held, "configured gains are kept"
    push = np.zeros((2, 1600))
    push[:, :80] = 0.2 * np.array([[2.1], [1.4]])
    feedback = feedback_of(held)
    away = []
    for parameters in belief.parameters:
        start = resting(np.array([rest, 0.0]) + 0.1)
        position = respond(Physics.of(parameters), start, push, 400.0, feedback).position
        away.append(float(np.abs(position[:, -1] - [rest, 0.0]).max()))
    assert np.mean(np.array(away) < 0.5) > 0.95


def upright(config: Config, rate: float) -> Config:
    arm = config.arm.model_copy(update={"rest_pose": [np.pi / 2, 0.0]})
    experiment = config.experiment.model_copy(update={"rate": rate})
    return config.model_copy(update={"arm": arm, "experiment": experiment})


@pytest.fixture(scope="module")
def standing(config: Config) -> Belief:
    return prior_belief(upright(config, 400.0), 48)


@pytest.mark.parametrize("model", ["XM430-W350", "XL430-W250"])
def test_the_proposed_gains_are_admissible_at_the_smallest_rate_named_and_hold_every_arm(
    config: Config, standing: Belief, model: str
) -> None:
    """The second joint's servo has less friction than the spring's delay takes away, at most rates."""
    first, second = config.joints
    if model != second.model:
        by_voltage = {"current_limit": None, "voltage_limit": 3.3, "torque_constant": None, "torque_per_volt": 0.125}
        second = second.model_copy(update={"model": model, **by_voltage})
    given = config.model_copy(update={"joints": [first, second]})
    with pytest.raises(
        ConfigError, match=r"experiment\.rate = 10 is too low to hold joint .* to at least \d+\.$"
    ) as no:
        with_stabiliser(upright(given, 10.0), standing)
    rate = float(str(no.value).rpartition(" ")[2][:-1])
    with pytest.raises(ConfigError, match=f"to at least {rate:.0f}"):
        with_stabiliser(upright(given, rate - 1.0), standing)
    push = np.zeros((2, round(4.0 * rate)))
    for each in (rate, 2.0 * rate, 1000.0):
        held = with_stabiliser(upright(given, each), standing)
        assert too_slow(held) == "" and held.stabiliser is not None
        for arm in standing.parameters:
            pull = gravity_stiffness(held, arm) + np.diag(held.stabiliser.stiffness)
            assert np.linalg.eigvalsh(pull).min() > 0.0
    held = with_stabiliser(upright(given, rate), standing)
    away = [
        respond(Physics.of(arm), resting(np.array([np.pi / 2 + 0.1, 0.1])), push, rate, feedback_of(held)).position
        for arm in standing.parameters
    ]
    assert np.mean([np.abs(each[:, -1] - [np.pi / 2, 0.0]).max() < 0.3 for each in away]) > 0.95


def test_a_joint_that_friction_holds_against_its_weight_gets_a_spring_alone(config: Config) -> None:
    belief = prior_belief(config, 48)
    assert with_stabiliser(config, belief) is config
    rough = dataclasses.replace(belief, coordinates=belief.coordinates.copy())
    weight = median(belief, "gravity_2")
    rough.coordinates[:, belief.names.index("coulomb_2")] = np.log(2.0 * weight)
    held = with_stabiliser(config, rough)
    assert held.stabiliser is not None
    assert held.stabiliser.stiffness[0] == held.stabiliser.damping[0] == 0.0
    assert held.stabiliser.stiffness[1] > weight
    kept = with_stabiliser(config, belief, np.array([False, True])).stabiliser
    assert kept is not None and kept.stiffness[0] == 0.0 < kept.stiffness[1], "a joint that had a spring keeps it"


@pytest.mark.slow
def test_the_search_gives_up_at_the_current_limit_only_and_says_what_it_tried(tmp_path: Path) -> None:
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
    path = tmp_path / "held.toml"
    text = replaced(text, ("coulomb = 0.050", "coulomb = 9.0"), ("current_limit = 0.8", "current_limit = 0.1"))
    path.write_text(text, encoding="utf-8")
    held = load_config(path)
    said: list[str] = []
    with pytest.raises(
        ExperimentError, match=r"Elbow moved by fewer than 26 encoder steps\. Tried: Pilot .*; Pilot 2 "
    ) as error:
        identify_in_steps(held, RunFolder.create(tmp_path / "run", held), path, lambda _: None, said.append)
    assert "configured limits allow" in str(error.value) and "stronger servo" in str(error.value)
    assert any("did not move: friction is larger than this torque" in line for line in said)
