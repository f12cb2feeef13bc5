"""Joints that friction holds get more torque from run to run, between narrow limits, up to the current limit."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from hil.config.schema import Config, load_config, parse_config
from hil.dry_run.amplitude import Amplitude, most_torque, with_peaks
from hil.errors import Cause, DidNotMove, ExperimentError, NoSafeTorque, NotSettled, SafetyStop
from hil.pilot import full
from hil.pilot.breakaway import FrictionWindow, broke_free, narrowed, raised, resting_on_stop
from hil.pilot.options import PilotOptions
from hil.pilot.search import Search
from hil.pilot.seen import Seen
from hil.pilot.steps import Played, Step, tells_of_the_arm
from hil.plan.plan import Plan
from hil.runs.run_folder import RunFolder
from tests.support import recorded_arm
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

OPTIONS = PilotOptions()
SHOULDER = np.array([True, False])


@pytest.fixture(scope="module")
def config() -> Config:
    path = CONFIGS / "first_time.toml"
    short = (("rate = 400.0 ", "rate = 100.0 "), ("period = 10.0 ", "period = 4.0 "), ("band = [0.1,", "band = [0.25,"))
    return parse_config(replaced(path.read_text(encoding="utf-8"), *short), path)


def test_only_joints_that_stood_still_are_raised_and_no_farther_than_their_limit() -> None:
    torque, former, most = np.array([0.1, 0.1, 0.1]), np.array([0.1, 0.2, 0.3]), np.array([1.0, 1.0, 0.4])
    still = np.array([False, True, True])
    assert raised(torque, former, still, 1.6, most).tolist() == pytest.approx([0.1, 0.32, 0.4])


def test_limits_come_close_to_where_the_joint_is(config: Config) -> None:
    pose = np.array([-1.4, 0.1])
    near = narrowed(config, pose, SHOULDER, OPTIONS)
    low, high = near.joints[0].position_limit
    full_low, full_high = config.joints[0].position_limit
    assert full_low < low < pose[0] < high < full_high
    assert pose[0] - low == pytest.approx(OPTIONS.breakaway_room * (pose[0] - full_low))
    assert near.joints[1] == config.joints[1]


def test_a_joint_at_its_limit_has_room_for_its_motion_to_be_seen_but_none_beyond_the_limit(config: Config) -> None:
    low, _ = config.joints[0].position_limit
    near_low, near_high = narrowed(config, np.array([low, 0.0]), SHOULDER, OPTIONS).joints[0].position_limit
    assert near_low == low
    assert near_high >= low + OPTIONS.min_breakaway_steps * config.joints[0].joint.servo.position_unit


def test_passing_a_narrow_limit_is_told_from_passing_one_of_the_configuration(config: Config) -> None:
    pose = np.array([-1.5, 0.0])
    near = narrowed(config, pose, SHOULDER, OPTIONS)
    beyond = near.joints[0].position_limit[1] + 0.01
    seen = np.array([pose, [beyond, 0.3], [2.0, 1.0]])
    assert broke_free(config, near, seen).tolist() == [True, False]
    assert not broke_free(config, config, seen).any()


class Held:
    """A player of an arm whose joints move only once their torque exceeds `friction` (joints,) [N m]."""

    def __init__(self, friction: list[float]) -> None:
        self.friction = np.array(friction)
        self.torques: list[np.ndarray] = []
        self.configs: list[Config] = []

    def play(self, config: Config, _folder: object, name: str, found: object, _arms: object) -> Played:
        torque = found.peak_torque  # type: ignore[attr-defined]
        self.torques.append(torque)
        self.configs.append(config)
        moves = torque > self.friction
        seen = Mock(swing=np.where(moves, 0.3, 0.0), end=np.array(config.arm.rest_pose))
        zeros = np.zeros((4, len(torque)))
        error = None if moves.all() else DidNotMove("Elbow moved by 0.0000 rad")
        return Played(Step(name, torque, zeros, zeros, zeros, str(error or "")), seen, "", error)

    def say(self, _text: str) -> None:
        pass


def searched(config: Config, tmp_path: Path, player: Held) -> Search:
    few = PilotOptions(arms=24)
    search = Search.of(config, RunFolder.create(tmp_path / "run", config), player, few)  # type: ignore[arg-type]
    search.belief = Mock(
        wraps=search.belief,
        middle=search.belief.middle,
        parameters=search.belief.parameters,
        after=lambda *_: search.belief,
    )
    return search


@pytest.mark.parametrize("share", [0.02, 0.3, 0.95])
def test_the_pilot_reaches_any_friction_below_the_current_limit_in_few_runs(
    config: Config, tmp_path: Path, share: float
) -> None:
    most = most_torque(config)
    player = Held((share * most).tolist())
    search = searched(config, tmp_path, player)
    search._pilot()
    assert search.moved.all()
    assert len(player.torques) <= 12
    ratio = np.array(player.torques[1:]) / np.array(player.torques[:-1])
    assert np.all(ratio <= OPTIONS.breakaway_raise + 1e-9), "never much more than what did not move"
    assert np.all(np.array(player.torques) <= most)


def test_it_gives_up_only_at_the_current_limit(config: Config, tmp_path: Path) -> None:
    player = Held([0.0, 1e3])
    with pytest.raises(ExperimentError, match="Elbow moved by fewer than 26 encoder steps"):
        searched(config, tmp_path, player)._pilot()
    assert player.torques[-1][1] == pytest.approx(most_torque(config)[1])


class Jumpy(Held):
    """A player of an arm whose elbow exceeds its velocity limit as soon as it breaks away.

    early: the run ends so early that its recording is too short to learn from.
    """

    early = False

    def play(self, config: Config, folder: object, name: str, found: object, arms: object) -> Played:
        played = super().play(config, folder, name, found, arms)
        if played.step.peak_torque[1] <= self.friction[1]:
            return played
        played.seen.swing[1] = 0.01  # type: ignore[union-attr]
        seen = np.zeros((4, 2))
        seen[2] = 0.0, 1.1 * config.joints[1].velocity_limit
        stop = SafetyStop("Elbow moves at ...", Cause.VELOCITY)
        step = replace(played.step, seen=seen, ended=str(stop))
        return replace(played, step=step, seen=None if self.early else played.seen, error=stop)


@pytest.mark.parametrize("early", [False, True])
def test_more_torque_does_not_help_a_joint_that_exceeds_its_velocity_limit(
    config: Config, tmp_path: Path, early: bool
) -> None:
    player = Jumpy([1e3, 0.3 * most_torque(config)[1]])
    player.early = early
    with pytest.raises(ExperimentError, match=r"Elbow exceeded the velocity limit while .* raise velocity_limit"):
        searched(config, tmp_path, player)._pilot()
    torques = np.array(player.torques)[:, 1]
    first = int(np.argmax(torques > player.friction[1]))
    assert torques[first + 1] == pytest.approx(OPTIONS.torque_after_limit * torques[first])
    assert torques.max() <= OPTIONS.breakaway_raise * player.friction[1]


def test_without_any_torque_that_is_safe_in_the_whole_range_it_begins_between_narrow_limits(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(*_: object, **__: object) -> None:
        raise NoSafeTorque("No torque was found")

    player = Held((0.1 * most_torque(config)).tolist())
    search = searched(config, tmp_path, player)
    monkeypatch.setattr("hil.pilot.search.largest_amplitude", none)
    search._pilot()
    assert player.torques[0] == pytest.approx(OPTIONS.first_torque_share * most_torque(config))
    for joint, wide in zip(player.configs[0].joints, config.joints, strict=True):
        assert np.ptp(joint.position_limit) < 0.5 * np.ptp(wide.position_limit)


class Near(Held):
    """A player of an arm that, with torques above `most` (joints,) [N m], exceeds its position limits."""

    most = np.array([np.inf, np.inf])

    def play(self, config: Config, folder: object, name: str, found: object, arms: object) -> Played:
        played = super().play(config, folder, name, found, arms)
        low, high = np.array([joint.position_limit for joint in load_config(config.path).joints]).T
        over = played.step.peak_torque > self.most
        seen = np.stack((0.5 * (low + high), np.where(over, high + 0.01, 0.5 * (low + high)), 0.0 * low))
        stop = SafetyStop("Elbow is at ...", Cause.POSITION) if over.any() else played.error
        return replace(played, step=replace(played.step, seen=seen, ended=str(stop or "")), error=stop)


def careful(config: Config, tmp_path: Path, player: Held, safe: Sequence[float]) -> Search:
    """A search in which only the torques `safe` (joints,) [N m] are safe for all plausible arms."""
    search = searched(config, tmp_path, player)

    def amplitude(config: Config, share: float, plan: Plan | None = None) -> Amplitude:
        return search._with(config, with_peaks(config, np.array(safe)) if plan is None else plan, np.array(safe))

    search.amplitude = amplitude  # type: ignore[method-assign]
    return search


@pytest.mark.parametrize("friction", [0.7, 1.2, 2.5])
def test_no_run_repeats_a_torque_with_which_a_joint_stood_still(
    config: Config, tmp_path: Path, friction: float
) -> None:
    """Although no larger torque is safe for all plausible arms, as for a joint that rests near a limit."""
    safe = np.array([0.2, 0.1])
    player = Near([0.0, friction * safe[1]])
    search = careful(config, tmp_path, player, safe.tolist())
    search.swing = np.array([0.3, 0.3])  # both joints have already moved in a run with more torque
    _, found = search.find()
    elbow = np.array(player.torques)[:, 1]
    stood = elbow[elbow <= player.friction[1]]
    assert len(set(stood.tolist())) == len(stood), "no repetition"
    assert player.friction[1] < found.peak_torque[1] <= OPTIONS.breakaway_raise * max(player.friction[1], safe[1])
    width = np.ptp(config.joints[1].position_limit)
    tried: set[float] = set()
    for torque, each in zip(elbow.tolist(), player.configs, strict=True):
        is_first, is_narrow = torque not in tried, np.ptp(each.joints[1].position_limit) < width
        assert is_narrow == (is_first and torque > safe[1]), "more than the safe torque is tried between narrow limits"
        tried.add(torque)


@pytest.mark.parametrize("most", [1.25, 1.4, 1.7])
def test_a_joint_that_either_stands_still_or_exceeds_a_limit_ends_the_search(
    config: Config, tmp_path: Path, most: float
) -> None:
    player = Near([0.0, most * 0.1])
    player.most = np.array([np.inf, most * 0.1])
    search = careful(config, tmp_path, player, [0.2, 0.1])
    search.swing = np.array([0.3, 0.3])
    with pytest.raises(ExperimentError, match=r"'elbow'.* stood still with .* exceeded a limit with .* N m\. At rest"):
        search.find()
    assert len(player.torques) <= 8
    assert len({torque[1] for torque in player.torques}) == len(player.torques), "no repetition"


def test_stopping_a_joint_that_broke_free_does_not_cap_the_torque(config: Config, tmp_path: Path) -> None:
    search = searched(config, tmp_path, Held([0.0, 0.0]))
    pose = np.array(config.arm.rest_pose)
    near = narrowed(config, pose, SHOULDER, OPTIONS)
    zeros, torque = np.zeros((4, 2)), np.array([0.2, 0.1])
    peaks = np.array([pose, [near.joints[0].position_limit[1] + 0.02, 0.1], [1.0, 1.0], [0.0, 0.0]])
    stop = SafetyStop("Shoulder is at ...", Cause.POSITION)
    seen = Mock(swing=np.array([0.3, 0.1]), end=pose)
    search.learn(near, Played(Step("Pilot 2", torque, zeros, zeros, peaks, str(stop)), seen, "", stop))
    assert search.cap is None
    search.learn(config, Played(Step("Step 3", torque, zeros, zeros, peaks, str(stop)), seen, "", stop))
    assert search.cap == pytest.approx(OPTIONS.torque_after_limit * torque)


@pytest.mark.parametrize(
    ("error", "informative"),
    [
        (SafetyStop("unlike", Cause.UNLIKE_BEFORE), True),
        (SafetyStop("limit", Cause.POSITION), True),
        (NotSettled("drifts"), True),
        (DidNotMove("stuck"), True),
        (SafetyStop("hot", Cause.TEMPERATURE), False),
        (SafetyStop("frozen", Cause.FROZEN), False),
        (SafetyStop("supply", Cause.OUT_OF_VOLTAGE), True),
        (SafetyStop("weakened", Cause.GOALS_CHANGED), False),
    ],
)
def test_which_ends_of_a_run_are_informative(error: ExperimentError, informative: bool) -> None:
    assert tells_of_the_arm(error) is informative


@pytest.mark.parametrize("cause", [Cause.POSITION, Cause.VELOCITY, Cause.OUT_OF_VOLTAGE, Cause.UNLIKE_BEFORE])
def test_no_stop_of_a_joint_that_another_program_commanded_is_informative(cause: Cause) -> None:
    stop = SafetyStop("another program", cause)
    stop.overruled = True
    assert not tells_of_the_arm(stop)


def unlike(search: Search, times: int) -> list[Played]:
    """Full runs of which the first `times` do not repeat their motion."""
    error = SafetyStop("Elbow does not repeat its motion", Cause.UNLIKE_BEFORE)
    zeros = np.zeros((4, 2))
    return [
        Played(Step("Full run", np.array([0.3, 0.2]), zeros, zeros, zeros), None, "", error if number < times else None)
        for number in range(times + 1)
    ]


def test_a_period_unlike_the_one_before_repeats_the_full_run_with_less_torque_and_other_waves(
    config: Config, tmp_path: Path
) -> None:
    search = searched(config, tmp_path, Held([0.0, 0.0]))
    found = search._with(config, search.waves(config), np.array([0.3, 0.2]))
    search.play = Mock(side_effect=unlike(search, 1))  # type: ignore[method-assign]
    search.run = Mock()
    assert full._full(search, config, found).error is None
    first, second = (call.args for call in search.play.call_args_list)
    assert np.all(second[3].peak_torque <= OPTIONS.torque_after_unsettled * first[3].peak_torque + 1e-12)
    assert second[0].experiment.seed != first[0].experiment.seed


def test_a_joint_that_friction_holds_gets_waves_of_higher_frequency(config: Config, tmp_path: Path) -> None:
    """Fast waves need more torque for the same motion, and so exceed static friction without exceeding a limit."""
    search = searched(config, tmp_path, Held([0.0, 0.0]))
    found = search._with(config, search.waves(config), np.array([0.3, 0.2]))
    zeros = np.zeros((4, 2))
    held = Played(Step("Full run", found.peak_torque, zeros, zeros, zeros), None, "", DidNotMove("stuck"))
    search.play = Mock(side_effect=[held, replace(held, error=None)])  # type: ignore[method-assign]
    search.run = Mock()
    full._full(search, config, found)
    first, second = ((call.args[0].experiment.band, call.args[3].peak_torque) for call in search.play.call_args_list)
    assert second[0] == [3.0 * first[0][0], first[0][1]]
    assert (second[1] > first[1]).any()
    highest = config.model_copy(update={"experiment": config.experiment.model_copy(update={"band": [2.0, 5.0]})})
    assert full._faster(highest, OPTIONS) == []


def test_torque_that_hardly_exceeds_friction_is_not_lowered_and_a_joint_that_stood_gets_more(
    config: Config, tmp_path: Path
) -> None:
    search = searched(config, tmp_path, Held([0.0, 0.0]))
    friction = np.array([search.belief.middle["coulomb_1"], search.belief.middle["coulomb_2"]])
    torque = friction * (1.5, 8.0)
    found = search._with(config, search.waves(config), torque)
    after = full._after_unsettled(search, found, NotSettled("differs"))
    assert after == pytest.approx(torque * (1.0, OPTIONS.torque_after_unsettled))
    after = full._after_unsettled(search, found, DidNotMove("stuck"))
    assert after == pytest.approx(OPTIONS.breakaway_raise * torque)


def test_motion_that_never_repeats_ends_the_identification(config: Config, tmp_path: Path) -> None:
    search = searched(config, tmp_path, Held([0.0, 0.0]))
    found = search._with(config, search.waves(config), np.array([0.3, 0.2]))
    search.play = Mock(side_effect=unlike(search, 9))  # type: ignore[method-assign]
    search.run = Mock()
    with pytest.raises(SafetyStop, match="does not repeat"):
        full._full(search, config, found)
    assert search.play.call_count == OPTIONS.max_unlike_runs


def test_a_joint_that_stands_still_after_it_moved_counts_as_still(config: Config) -> None:
    zeros, torque = np.zeros((4, 2)), np.array([0.2, 0.1])
    error = DidNotMove("Elbow moved by only 0.0031 rad in a whole period: it is stuck")
    error.joint = 1
    played = Played(Step("Step 4", torque, zeros, zeros, zeros, str(error)), None, "", error)
    window = FrictionWindow.unknown(2).after(config, played, np.array([0.3, 0.3]))
    assert window.still.tolist() == [0.0, 0.1] and window.enough.tolist() == [0.2, np.inf]
    window = window.after(config, replace(played, error=None), np.array([0.3, 0.3]))
    assert window.still.tolist() == [0.0, 0.0], "the same torque has moved it since"


def test_a_limit_that_was_not_narrowed_is_one_of_the_configuration(config: Config) -> None:
    low, _ = config.joints[0].position_limit
    near = narrowed(config, np.array([low + 0.01, 0.0]), SHOULDER, OPTIONS)
    seen = np.array([[low - 0.01, 0.0], [low + 0.02, 0.0], [1.0, 0.0]])
    assert not broke_free(config, near, seen).any()


@pytest.mark.parametrize(
    ("friction", "rest", "peak", "rests"),
    [
        ({"stops": (-0.8, 3.0), "stop_stiffness": 200.0}, -0.795, 0.45, True),
        ({}, -np.pi / 2, 0.1, False),
        ({"coulomb": 0.3, "stribeck_rise": 0.5, "stribeck_velocity": 0.2}, -0.8, 0.6, False),
    ],
    ids=["stop", "hangs", "friction"],
)
def test_an_arm_that_rests_on_a_stop_is_distinguished_from_one_that_friction_holds(
    friction: dict[str, Any], rest: float, peak: float, rests: bool
) -> None:
    arm = recorded_arm.servo_arm(friction, joints=1, start=rest)
    motion = recorded_arm.record(arm, recorded_arm.wave(1, (peak,), 5.0))
    config = load_config(CONFIGS / "fake_pendulum.toml")
    config = config.model_copy(update={"arm": config.arm.model_copy(update={"rest_pose": [rest]})})
    position = motion.rounded().position
    said = resting_on_stop(config, Seen(motion.torque, motion.torque, position, np.array([rest]), position[:, -1]))
    assert said.startswith("Joint 'pendulum'") is rests and bool(said) is rests
    assert ("rests against something compliant (an end stop, a table or a cable) at -0.8" in said) is rests
