"""Predicted overshoot of a stopped arm, compared with the independent plant of the fake arm."""

from functools import cache
from itertools import product

import numpy as np
import pytest

from hil.config.schema import Config
from hil.drivers.state import State
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.stopping_distance import LONGEST_S, Stopping, Way, beyond_when_passed, stopping_distance
from hil.dry_run.summary import _stops
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import Feedback, respond, resting
from hil.fakes.plants.arm import base_parameters
from hil.fakes.plants.two_link import TwoLink
from hil.plan.brake import GETS_FASTER
from hil.plan.plan import Plan, make_plan, scaled
from tests.support.edits import replaced
from tests.support.motion import brake_of
from tests.support.short_experiment import CONFIG, short_config

NONE = Feedback.none(2)
SPEEDS = np.array([3.0, 2.0])
CLOSE = (("[-4.2, 1.06]", "[-2.6, -0.3]"), ("[-3.1, 3.1]", "[-0.4, 0.4]"))


def close_config(*changes: tuple[str, str]) -> Config:
    text = CONFIG.read_text(encoding="utf-8")
    text = replaced(text, *CLOSE, *changes)
    return short_config(text)


@cache
def fake_itself() -> Ensemble:
    """An ensemble with only the fake arm, described by the model's parameters."""
    arm = close_config().fake.arm  # type: ignore[union-attr]
    assert arm is not None
    known = base_parameters(arm) | {"lag": arm.drives[0].current_lag}
    for joint, drive in enumerate(arm.drives, start=1):
        known |= {f"stribeck_rise_{joint}": drive.stribeck_rise, f"stribeck_velocity_{joint}": drive.stribeck_velocity}
        known[f"coulomb_width_{joint}"] = 0.01
    return Ensemble((Physics.of(known),), np.ones((1, 2)), "fake")


@cache
def predicted(*changes: tuple[str, str]) -> Stopping:
    config = close_config(*changes)
    return stopping_distance(config, make_plan(config), fake_itself(), SPEEDS)


def plant_of(config: Config, pose: np.ndarray, speed: np.ndarray) -> TwoLink:
    assert config.fake is not None and config.fake.arm is not None
    return TwoLink(config.fake.arm.model_copy(update={"start": tuple(pose.tolist())}), tuple(speed.tolist()))


def seen_beyond(config: Config, plant: TwoLink, current: np.ndarray) -> np.ndarray:
    """Overshoot when torque is cut two samples after a limit was exceeded under `current` [A]."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    beyond = np.zeros(2)
    for sample in range(round(LONGEST_S * config.experiment.rate)):
        plant.advance((sample + 1) / config.experiment.rate, current if sample < 2 else (0.0, 0.0))
        position = np.array(plant.position)
        beyond = np.maximum(beyond, np.maximum(low - position, position - high))
    return beyond


@pytest.mark.parametrize("pose", [(-0.3, 0.0), (-1.57, -0.4)], ids=["shoulder", "elbow"])
def test_a_cut_arm_goes_as_far_as_predicted_and_no_farther(pose: tuple[float, float]) -> None:
    config, plan = close_config(), make_plan(close_config())
    peak = np.abs(plan.segments[0].period_current).max(axis=0)
    seen = []
    for joint, outward, other, jams in product((0, 1), (-1.0, 1.0), (-1.0, 0.0, 1.0), (False, True)):
        speed, current = np.full(2, other) * SPEEDS, np.zeros(2)
        speed[joint], current[joint] = outward * SPEEDS[joint], outward * peak[joint]
        plant = plant_of(config, np.array(pose), speed)
        plant.jam(1 - joint, jams)
        seen.append(seen_beyond(config, plant, current))
    most = beyond_when_passed(config, plan, fake_itself(), SPEEDS, np.array(pose))[Way.CUT]
    assert most.max() > 0.1
    assert (np.max(seen, axis=0) <= 1.02 * most).all()
    assert (np.max(seen, axis=0) >= 0.9 * most).all()


def test_an_arm_whose_shoulder_jams_upwards_lets_its_elbow_fall_and_that_is_foreseen() -> None:
    config = close_config()
    raised, slow = np.array([-0.3, -0.4]), np.full(2, 0.05)
    plant = plant_of(config, raised, np.zeros(2))
    plant.jam(0, True)
    fallen = seen_beyond(config, plant, np.zeros(2))[1]
    foreseen = beyond_when_passed(config, make_plan(config), fake_itself(), slow, raised)[Way.CUT][1]
    hanging = np.array([-1.57, -0.4])
    no_fall = beyond_when_passed(config, make_plan(config), fake_itself(), slow, hanging)[Way.CUT][1]
    assert 0.0 < fallen <= 1.02 * foreseen
    assert no_fall < 0.5 * foreseen


def test_the_ways_of_stopping_in_their_order() -> None:
    ways = predicted()
    assert (ways.passed[Way.BRAKED] <= ways.passed[Way.CUT]).all()
    assert (ways.passed[Way.CUT] <= ways.passed[Way.REVERSED] + 1e-9).all()
    assert (ways.passed[Way.BRAKED] > 0.02).all()
    assert (ways.planned[Way.CUT] < ways.passed[Way.CUT]).all(), "the planned motion is slower at the limits"
    config = close_config()
    slower = beyond_when_passed(config, make_plan(config), fake_itself(), 0.5 * SPEEDS)
    assert all((slower[way] < ways.passed[way]).all() for way in slower)


def test_a_plan_that_passes_a_limit_is_stopped_there() -> None:
    """Motion beyond a limit never occurs, because the guard stops the arm there."""
    config = close_config()
    harder = scaled(config, make_plan(config), np.array([2.1, 1.4]))
    moved = respond(
        fake_itself().physics[0], resting(np.array(config.arm.rest_pose)), torque(config, harder), 200.0, NONE
    )
    beyond = float((moved.position[0] - config.joints[0].position_limit[1]).max())
    ways = stopping_distance(config, harder, fake_itself(), SPEEDS)
    assert ways.planned[Way.BRAKED][0] < 0.5 * beyond


@pytest.mark.parametrize(
    ("planned", "first"),
    [
        (
            0.001,
            "Whenever the arm is stopped, no joint overshoots its limits, even if the program is killed or the cable ",
        ),
        (
            0.2,
            "Whenever the arm is stopped, shoulder overshoots its limits by up to 0.20 rad; if the program is killed ",
        ),
    ],
)
def test_an_overshoot_is_said_joint_by_joint(planned: float, first: str) -> None:
    stopping = Stopping(
        {way: np.array([planned, 0.0]) for way in Way},
        {Way.BRAKED: np.array([7.0, 0.001]), Way.CUT: np.array([7.0, 1.5]), Way.SILENT: np.zeros(2)},
    )
    said = _stops(short_config(CONFIG.read_text(encoding="utf-8")), stopping)
    assert said[0].startswith(first)
    assert said[-3] == (
        "If something drives shoulder past a limit at its predicted speed (99 %), the joint overshoots by a turn or "
        "more when braked and by a turn or more when torque is cut."
    )
    assert (
        "elbow past a limit at its predicted speed (99 %), the joint overshoots by less than 0.01 rad when braked and "
        "by up to 1.5"
    ) in said[-2]


def test_without_braking_braked_is_cut() -> None:
    ways = predicted(("[model]\n", '[safety]\nstop = "cut"\n\n[model]\n'))
    assert (ways.passed[Way.BRAKED] == ways.passed[Way.CUT]).all()
    assert (ways.planned[Way.BRAKED] == ways.planned[Way.CUT]).all()


def torque(config: Config, plan: Plan) -> np.ndarray:
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    return np.ascontiguousarray((plan.segments[0].period_current * constants).T)


def moving(*velocity: float) -> State:
    return State(0.0, 0.001, (0.0, 0.0), (0.0, 0.0), velocity, (-1.57, 0.0), (0, 0), (False, False))


def test_a_brake_pulls_against_the_motion_within_the_limits_until_the_arm_is_slow() -> None:
    brake = brake_of(close_config(), moving(14.0, -1.0))
    first, second = brake.goals(moving(14.0, -1.0)) or (0.0, 0.0)
    assert first == pytest.approx(-1.2) and 0.0 < second < 0.8
    assert brake.goals(moving(0.05, -0.05)) is None


@pytest.mark.parametrize("faster", [1, 2])
def test_a_brake_that_makes_a_joint_faster_is_given_up(faster: int) -> None:
    brake = brake_of(close_config(), moving(5.0, -2.0))
    allowed = GETS_FASTER * 20.0
    assert brake.goals(moving(5.0, -2.0)) is not None
    assert brake.goals(moving(4.0, -2.0 - 0.9 * allowed)) is not None
    gone = moving(5.0 + 1.1 * GETS_FASTER * 15.0, -2.0) if faster == 1 else moving(3.0, -2.0 - 1.1 * allowed)
    assert brake.goals(gone) is None


def test_a_brake_that_cannot_feel_a_joint_is_given_up() -> None:
    for blind in ({"missing": (False, True)}, {"error": (0x80, 0)}):
        brake = brake_of(close_config(), moving(5.0, 2.0))
        assert brake.goals(moving(5.0, 2.0)._replace(**blind)) is None  # type: ignore[arg-type]
