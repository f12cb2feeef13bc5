"""The model watch accepts healthy arms, detects others, and its tolerance follows from the prior knowledge."""

import math
import re
from collections.abc import Sequence

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.drivers.state import State
from hil.dry_run.ensemble import prior_ensemble
from hil.errors import Cause, SafetyStop
from hil.estimator.models.momentum_observer import NAMES
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation.closed_loop import Feedback, respond, resting
from hil.experiment.model_watch import JOLT_BACK_S, JOLT_RAD_S, JOLT_TIMES, ModelWatch, known_arm
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import Plant, make_plant
from tests.support.jolts import Jolts
from tests.support.paths import CONFIGS

RATE = 400.0
TICK, STEP = 0.229 * math.tau / 60, math.tau / 4096


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(CONFIGS / "first_time.toml")


def waves(seconds: float, peaks: tuple[float, float], seed: int) -> np.ndarray:
    """Random torques (2, samples) [N m]."""
    random = np.random.default_rng(seed)
    when = np.arange(round(seconds * RATE)) / RATE
    frequency, phase = random.uniform(0.3, 4.0, (2, 6, 1)), random.uniform(0, math.tau, (2, 6, 1))
    torque = np.sin(math.tau * frequency * when + phase).sum(axis=1)
    return torque / np.abs(torque).max(axis=1, keepdims=True) * np.array(peaks)[:, None]


def motion(config: Config, physics: Physics, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities as reported by the servos, rounded to ticks (2, samples)."""
    moved = respond(physics, resting(np.array(config.arm.rest_pose)), torque, RATE, Feedback.none(2))
    return np.round(moved.position / STEP) * STEP, np.round(moved.velocity / TICK) * TICK


def seen_after(
    watch: ModelWatch, config: Config, torque: np.ndarray, position: np.ndarray, velocity: np.ndarray
) -> float:
    """Time of the stop [s]; infinite if there is none."""
    constants = [joint.torque_per_goal for joint in config.joints]
    for index in range(torque.shape[1]):
        goal = tuple(torque[:, index] / constants)
        now = index / RATE
        told = tuple(position[:, index].tolist()), (0, 0), (False, False)
        state = State(now, now + 1e-3, goal, goal, tuple(velocity[:, index].tolist()), *told)
        try:
            watch.look(state)
        except SafetyStop as stop:
            assert stop.cause is Cause.UNEXPECTED and "any arm" in str(stop)
            return now
    return math.inf


def fastest(velocity: np.ndarray, since: float) -> int:
    """Index of the sample with the highest speed of the first joint within a second from `since` [s]."""
    first = round(since * RATE)
    return first + int(np.argmax(np.abs(velocity[0, first : first + round(RATE)])))


def planned(config: Config, torque: np.ndarray) -> list[float]:
    return [float(np.abs(t).max()) / j.torque_per_goal for t, j in zip(torque, config.joints, strict=True)]


@pytest.mark.parametrize("arm", range(6))
def test_arms_of_the_prior_pass_and_what_is_not_their_motion_does_not(config: Config, arm: int) -> None:
    physics = prior_ensemble(config, 8, seed=7).physics[arm]
    torque = waves(6.0, (0.5, 0.25), arm)
    position, velocity = motion(config, physics, torque)
    assert seen_after(ModelWatch(config, planned(config, torque)), config, torque, position, velocity) == math.inf
    # From some moment on, the readings of both joints freeze, as if everything were blocked.
    at = fastest(velocity, 3.0)
    held, still = position.copy(), velocity.copy()
    held[:, at:] = held[:, at - 1 : at]
    still[:, at:] = 0.0
    when = seen_after(ModelWatch(config, planned(config, torque)), config, torque, held, still)
    assert 0.0 < when - at / RATE < 0.1


@pytest.mark.parametrize("interval", [1 / RATE, 1 / (4 * RATE)])
def test_a_joint_that_stands_still_is_told_with_the_torques_of_the_last_moments(
    config: Config, interval: float
) -> None:
    """Whatever is commanded at the moment of the stop, which is often nothing, and however goals are held."""
    watch = ModelWatch(config, [0.5, 0.25], interval=interval)
    constants = np.array([joint.torque_per_goal for joint in config.joints])
    rest = tuple(config.arm.rest_pose)
    with pytest.raises(
        SafetyStop, match=r"is not moving, with [-+]\d\.\d+ to [-+]\d\.\d+ N m commanded in the last 0\.\d+ s"
    ) as stop:
        for index in range(4000):
            now = index * interval
            goal = tuple(np.array([1.0, 1.0]) * np.sin(math.tau * 5 * now) / constants)
            watch.look(State(now, now + 1e-4, goal, goal, (0.0, 0.0), rest, (0, 0), (False, False)))
    low, high = (float(each) for each in re.findall(r"[-+]\d\.\d+", str(stop.value))[:2])
    assert f"in the last {min(now, 0.3):.2g} s" in str(stop.value), "the time for which it has stood still"
    assert high - low > 0.9, "the wave has a peak of 1 N m and 5 Hz"


def test_torque_that_reaches_the_arm_no_more(config: Config) -> None:
    """Lost torque is detected from the motion alone, except on arms that these torques hardly move."""
    seen = 0
    for arm in range(6):
        physics = prior_ensemble(config, 8, seed=7).physics[arm]
        torque = waves(6.0, (0.5, 0.25), arm)
        cut = torque.copy()
        cut[:, round(3.0 * RATE) :] = 0.0
        position, velocity = motion(config, physics, cut)
        when = seen_after(ModelWatch(config, planned(config, torque)), config, torque, position, velocity)
        assert when > 3.0
        seen += when < 3.6
    assert seen >= 3


@pytest.mark.parametrize("arm", range(3))
def test_an_arm_of_which_nothing_is_known_is_learnt_before_it_is_judged(config: Config, arm: int) -> None:
    unknown = config.model_copy(update={"arm": config.arm.model_copy(update={"link_lengths": None})})
    physics = prior_ensemble(config, 8, seed=9).physics[arm]
    torque = waves(6.0, (0.5, 0.25), arm)
    position, velocity = motion(config, physics, torque)
    assert seen_after(ModelWatch(unknown, planned(config, torque)), config, torque, position, velocity) == math.inf
    at = fastest(velocity, 4.0)
    velocity[:, at:] = 0.0
    position[:, at:] = position[:, at - 1 : at]
    when = seen_after(ModelWatch(unknown, planned(config, torque)), config, torque, position, velocity)
    assert 0.0 < when - at / RATE < 0.1


def small_arm(rest_pose: tuple[float, float]) -> Plant:
    """An arm whose dry friction, after some presliding, is as large as half of the torque that it is moved with."""
    motor = {
        **{"mass": 0.018, "rotor_inertia": 1.8e-8, "gear_ratio": 353.5, "current_lag": 1e-3, "coulomb_width": 0.0},
        **{"stribeck_rise": 0.4, "stribeck_velocity": 0.15},
    }
    shoulder = {"torque_constant": 1.37, "viscous": 0.0105, "coulomb": 0.0056, "presliding_stiffness": 1.385}
    elbow = {"torque_constant": 1.517, "viscous": 0.006, "coulomb": 0.024, "presliding_stiffness": 2.46}
    links = [
        {"length": 0.147, "mass": 0.038, "centre": 0.081, "inertia": 1.5e-4},
        {"length": 0.18, "mass": 0.029, "centre": 0.112, "inertia": 4.2e-5},
    ]
    drives = [motor | shoulder, motor | elbow]
    return make_plant(Arm.model_validate({"start": rest_pose, "gravity": 9.81, "links": links, "drives": drives}))


@pytest.mark.parametrize("seed", [180, 224, 370, 436])
def test_friction_that_looks_viscous_over_a_small_motion_is_not_mistaken_for_a_fault(seed: int) -> None:
    known = load_config(CONFIGS / "xc330_two_link.toml")
    config = known.model_copy(update={"arm": known.arm.model_copy(update={"link_lengths": None})})
    torque = waves(1.6, (0.069, 0.034), seed)
    torque *= np.minimum(1.0, np.arange(torque.shape[1]) / (0.3 * RATE))
    constants = [joint.torque_per_goal for joint in config.joints]
    plant, current = small_arm(config.arm.rest_pose), (0.0, 0.0)
    position, velocity = np.empty((2, *torque.shape))
    for index, wanted in enumerate(torque.T):
        plant.advance(index / RATE + 3e-4, current)
        position[:, index] = np.round(np.array(plant.position) / STEP) * STEP
        velocity[:, index] = np.round(np.array(plant.velocity) / TICK) * TICK
        current = tuple(wanted / constants)
    assert seen_after(ModelWatch(config, planned(config, torque)), config, torque, position, velocity) == math.inf


def test_what_explains_the_lack_of_torque_is_asked_before_the_arm_is_blamed(config: Config) -> None:
    physics = prior_ensemble(config, 8, seed=7).physics[0]
    torque = waves(6.0, (0.5, 0.25), 0)
    position, velocity = motion(config, physics, torque)
    asked: list[tuple[int, float, bool]] = []

    def explain(joint: int, lacking: float, recent: Sequence[State]) -> None:
        asked.append((joint, lacking, recent[-1].velocity[joint] * velocity[joint].max() != 0.0))
        raise SafetyStop("any arm: supply", Cause.UNEXPECTED)

    watch = ModelWatch(config, planned(config, torque), explain=explain)
    at = fastest(velocity, 3.0)
    velocity[0, at:] *= -1.0
    assert seen_after(watch, config, torque, position, velocity) < math.inf
    assert len(asked) == 1 and asked[0][2] and asked[0][1] != 0.0


def test_a_lost_reply_and_a_stall_begin_anew(config: Config) -> None:
    physics = prior_ensemble(config, 8, seed=7).physics[0]
    torque = waves(4.0, (0.5, 0.25), 0)
    position, velocity = motion(config, physics, torque)
    # Two seconds and some earlier replies are missing: the arm is elsewhere, at another speed.
    constants = [joint.torque_per_goal for joint in config.joints]
    watch = ModelWatch(config, planned(config, torque))
    for index in (*range(400), *range(1200, 1600)):
        now, goal = index / RATE, tuple(torque[:, index] / constants)
        told = tuple(velocity[:, index].tolist()), tuple(position[:, index].tolist())
        watch.look(State(now, now + 1e-3, goal, goal, *told, (0, 0), (False, 390 < index < 400)))


def test_a_pendulum() -> None:
    pendulum = load_config(CONFIGS / "fake_pendulum.toml")
    watch = ModelWatch(pendulum, [0.19])
    rest = pendulum.arm.rest_pose[0]
    for index in range(400):
        now = index / RATE
        watch.look(State(now, now + 1e-3, (0.0,), (0.0,), (0.0,), (rest,), (0,), (False,)))


def jolt(velocities: list[float], interval: float = 0.01, jolts: Jolts | None = None) -> tuple[int, float] | None:
    """Index at which these velocities count as a jolt, and the change that began it."""
    jolts = Jolts(1, interval) if jolts is None else jolts
    for index, velocity in enumerate(velocities):
        found = jolts.look([velocity], interval, index * interval)
        if found is not None:
            return index, found[1]
    return None


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("interval", "back"), [(0.01, 1), (0.0025, 4), (0.05, 1)])
def test_a_velocity_that_jumps_and_is_back_is_a_jolt(sign: float, interval: float, back: int) -> None:
    jump = 1.05 * sign * JOLT_RAD_S * max(1.0, interval / 0.01)
    out, there = 40, 2 * back
    assert jolt([0.0] * out + [jump] * there + [0.0] * 20, interval) == (out + there, pytest.approx(jump))
    assert jolt([0.0] * out + [0.95 / 1.05 * jump] * there + [0.0] * 20, interval) is None


def test_a_velocity_that_stays_or_comes_back_slowly_or_later_is_none() -> None:
    assert jolt([0.0] * 40 + [2.0] * 100) is None
    assert jolt([0.0] * 40 + [2.0, *np.linspace(2.0, 0.0, 20).tolist()]) is None
    late = round(JOLT_BACK_S / 0.01) + 1
    assert jolt([0.0] * 40 + [2.0] * late + [0.0] * 20) is None
    assert jolt([0.0] * 40 + [2.0] * (late - 2) + [0.0] * 20) is not None


def test_teeth_that_change_sides_at_two_reversals_are_no_jolt() -> None:
    """A motor crosses the gap of its gear at both: velocities as measured on an arm with 9 mrad of play, at 100 Hz."""
    between = [-0.72, -1.03, -1.17, -1.22, -1.2, -1.05, -0.84, -0.58, -0.26]
    assert jolt([0.5] * 40 + [0.14, -1.25, *between, 0.95, 1.1, 1.3]) is None
    assert jolt([0.5] * 40 + [1.9] * 6 + [0.5] * 20) is not None, "no reversal"
    assert jolt([0.5] * 40 + [-1.25] * 2 + [-1.0, -0.6, -0.3, -0.1] + [-1.5] + [0.0] * 20) is not None, "one reversal"


@pytest.mark.parametrize(("jump", "later", "seen"), [(2.5, 1.0, False), (3.5, 1.0, True), (2.5, 12.0, True)])
def test_a_jolt_is_larger_than_single_impacts_before_it(jump: float, later: float, seen: bool) -> None:
    """A gear with much backlash: each tooth that strikes the opposite flank changes the velocity, and two impacts may
    follow each other by chance, as on an XM540 with a backlash of 0.5 degrees.
    """
    velocities = [3.0] * 40 + [5.0] * round(100 * later) + [5.0 - jump] * 5 + [5.0] * 20
    assert (jolt(velocities) is not None) is seen


def test_a_jolt_is_large_compared_with_the_usual_changes() -> None:
    usual = [0.0, 0.5] * 100
    assert jolt([*usual, 0.0, 0.0 + 0.9 * 0.5 * JOLT_TIMES, 0.0, 0.0]) is None
    assert jolt([*usual, 0.0, 0.0 + 1.2 * 0.5 * JOLT_TIMES, 0.0, 0.0]) is not None


def test_over_a_gap_nothing_is_known_of_the_velocity() -> None:
    jolts = Jolts(1, 0.01)
    assert jolt([0.0] * 40, jolts=jolts) is None
    jolts.forget()
    assert jolts.look([2.0], 0.05, 0.45) is None and jolts.look([0.0], 0.01, 0.46) is None, "one change only"


def test_a_horn_that_slips_at_the_first_motion_of_an_arm_without_a_description_is_found(config: Config) -> None:
    undescribed = config.model_copy(update={"arm": config.arm.model_copy(update={"link_lengths": None})})
    watch = ModelWatch(undescribed, [0.3, 0.2], interval=0.01)
    with pytest.raises(SafetyStop, match=r"'elbow'.* jerked: its velocity changed by \+2\.0 rad/s.*horn") as stopped:
        for index in range(40):
            speed = 2.0 if 20 <= index < 25 else 0.0
            turned = 0.02 * min(max(index - 20, 0), 5)
            now, nothing = 0.01 * index, (0.0, 0.0)
            watch.look(State(now, now + 1e-3, nothing, nothing, (0.0, speed), (-1.57, turned), (0, 0), (False, False)))
    assert stopped.value.cause is Cause.UNEXPECTED


@pytest.mark.parametrize("interval", [0.005, 0.02])
def test_teeth_that_change_sides_within_the_play_of_a_gear_are_no_horn_that_slips(
    config: Config, interval: float
) -> None:
    """A light link falls through the play and bounces: its velocity jumps, but it moves by no more than the play."""
    undescribed = config.model_copy(update={"arm": config.arm.model_copy(update={"link_lengths": None})})
    watch = ModelWatch(undescribed, [0.3, 0.2], interval=interval)
    for index in range(80):
        speed = 4.0 if index % 40 == 20 else 0.0
        turned = 0.009 * ((index + 20) // 40)
        now, nothing = interval * index, (0.0, 0.0)
        watch.look(State(now, now + 1e-3, nothing, nothing, (0.0, speed), (-1.57, turned), (0, 0), (False, False)))


def test_an_undescribed_arm_that_is_excited_slowly_may_be_heavy() -> None:
    """The paper's arm: 11.5 kg m^2 on joint 1, moved by 9 N m at 0.03 to 0.43 Hz."""
    heavy = load_config(CONFIGS / "paper_two_link.toml")
    usual = heavy.model_copy(update={"experiment": heavy.experiment.model_copy(update={"period": 1.2})})
    inertia, viscous = NAMES.index("inertia_1"), NAMES.index("viscous_1")
    slow, fast = (np.sqrt(np.diag(known_arm(each, np.array([9.0, 9.0]), None)[1])) for each in (heavy, usual))
    assert slow[inertia] > 11.5 > 3.0 * fast[inertia]
    assert slow[viscous] > 12.0 > fast[viscous]
