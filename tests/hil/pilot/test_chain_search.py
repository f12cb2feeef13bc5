"""Spatial arms from description, limits and rest pose to the result, on the fake bus; here the smallest one."""

import pickle
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest

import hil
from hil.config.schema import Config, load_config, parse_config
from hil.drivers import bus as drivers_bus
from hil.drivers.port import Port, open_port
from hil.dry_run import chain_stop, chain_summary
from hil.dry_run.chain_prediction import predict_chain
from hil.dry_run.chain_prior import prior_arms
from hil.dry_run.chain_summary import chain_dry_run_json, chain_dry_run_lines, unsafe
from hil.errors import Cause, ConfigError, DidNotMove, NoSafeTorque, NotSettled, SafetyStop
from hil.estimator.chain.excitation import path_design
from hil.estimator.chain.excitation.fourier_path import Path as Motion
from hil.estimator.chain.excitation.path_design import Design
from hil.estimator.errors import ExcitationError
from hil.pilot import chain_search, chain_shares
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import RESERVE, Paths, Reserve, chain_config
from hil.pilot.chain_rehearsal import rehearse
from hil.pilot.chain_search import ChainSearch, Said
from hil.pilot.chain_shares import PILOT_SHARES, Found, SafeShares, step_config
from hil.pilot.steps import Say
from hil.plan.chain_model import known_chain
from hil.runs.recording import load_samples
from hil.setup.session.servo_session import servo_session
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

LEG = CONFIGS / "leg.toml"
TEXT = replaced(LEG.read_text(encoding="utf-8"), ("period = 10.0", "period = 4.0"), ("rate = 400.0", "rate = 100.0"))
"""A shorter experiment, so that designs and simulations take less time."""

DESIGNED: dict[bytes, Paths] = {}
GENERATIONS = path_design.GENERATIONS


@pytest.fixture(scope="module", autouse=True)
def _designed_once() -> Iterator[None]:
    """Most tests use the same immutable paths, and a design takes as long as most of these tests without it.

    A third of the design's generations is enough to find a usable path.
    """
    of = Paths.of

    def remembered(config: Config, thought: Any, reserve: Reserve = RESERVE, tell: Any = None) -> Paths:
        key = pickle.dumps((config.model_dump_json(), thought, reserve))
        if key not in DESIGNED:
            DESIGNED[key] = of(config, thought, reserve, tell)
        return replace(DESIGNED[key], config=config)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Paths, "of", remembered)
        patch.setattr(path_design, "GENERATIONS", 20)
        yield


def leg(*changes: tuple[str, str]) -> Config:
    return parse_config(replaced(TEXT, *changes), LEG)


def fewer_arms(patch: pytest.MonkeyPatch) -> None:
    """Simulate a sixth of the arms, and the stops of three at a few moments, which take most of a search's time."""
    for place in ("chain_shares.SEARCH_ARMS", "chain_shares.ARMS", "chain_rehearsal.ARMS"):
        patch.setattr(f"hil.pilot.{place}", 4 if "SEARCH" in place else 12)
    patch.setattr(chain_stop, "MOMENTS", 5)
    patch.setattr(chain_stop, "ARMS", 3)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> hil.Identification:
    folder = tmp_path_factory.mktemp("leg")
    (folder / "leg.urdf").write_bytes((CONFIGS / "leg.urdf").read_bytes())
    (folder / "leg.toml").write_text(TEXT, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        fewer_arms(patch)
        return hil.identify(folder / "leg.toml", out=folder / "run")


def test_the_leg_is_identified_from_its_description_alone(found: hil.Identification) -> None:
    assert found.verdict.trust in ("yes", "with care")
    assert max(found.fit.residual_rms_ticks) < 0.31
    assert found.truth is not None
    away = [abs(each.value - found.truth[name]) / each.std for name, each in found.parameters.items()]
    assert np.mean(np.array(away) < 1.96) > 0.8


def test_each_step_says_what_was_foreseen_and_what_was_seen(found: hil.Identification) -> None:
    assert found.steps[0].name == "Pilot"
    assert found.steps[-1].name == "Full run"
    last = found.steps[-1]
    median, seen = np.array(last.predicted_median), np.array(last.seen)
    np.testing.assert_allclose(seen[:3], median[:3], atol=0.15)  # after the pilot hardly anything is unknown


def test_all_of_it_stays_within_limits_and_ends_at_rest(found: hil.Identification) -> None:
    config = load_config(LEG)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    for path in found.run.rglob("samples.npy"):
        position = load_samples(path, 3)["position"]
        assert ((position > low) & (position < high)).all()
        assert np.abs(position[-1] - np.array(config.arm.rest_pose)).max() < 0.06


def test_optimised_paths_are_twice_as_certain_as_random_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(path_design, "GENERATIONS", GENERATIONS)
    config = chain_config(leg(("rate = 100.0", "rate = 400.0")))  # velocities are compared with finite differences
    paths = Paths.of(config, ChainBelief.prior(config).torque)
    plain = [paths.designer.plain(paths.identify.centre, seed).worst for seed in range(5)]
    assert paths.identify.worst < 0.5 * np.median(plain)
    path = paths.identify.path
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    assert ((low < path.position.T) & (high > path.position.T)).all()
    velocity = np.gradient(path.position, 1 / config.experiment.rate, axis=1)
    np.testing.assert_allclose(velocity[:, 5:-5], path.velocity[:, 5:-5], atol=2e-3)


def test_a_motion_that_could_meet_a_box_is_not_safe() -> None:
    config = chain_config(leg())
    belief = ChainBelief.prior(config)
    paths = Paths.of(config, belief.torque)
    held = step_config(belief.with_stabiliser(config))
    plan = paths.plan(held, belief.torque, 0.3)
    arms = prior_arms(held, known_chain(held), 6)
    free = predict_chain(held, plan, arms)
    assert not unsafe(held, free)
    motion = plan.segments[0].paths[1]  # type: ignore[attr-defined]
    assert isinstance(motion, Motion)
    foot = hil_foot(config, motion)
    box = f'[[clearance.boxes]]\nname = "stone"\ncentre = {foot}\nsize = [0.03, 0.03, 0.03]\n\n[experiment]\n'
    blocked = step_config(belief.with_stabiliser(chain_config(leg(("[experiment]\n", box)))))
    why = unsafe(blocked, predict_chain(blocked, plan, arms))
    assert "stone" in why
    assert "s into 'identify'" in why


def hil_foot(config: object, motion: Motion) -> list[float]:
    """Where the lowest capsule's end is in the middle of a motion."""
    from hil.clearance.space import Space

    ends, _ = Space.of(config).ends(motion.position[:, motion.position.shape[1] // 2])  # type: ignore[arg-type]
    return [float(value) for value in ends[-1, 1]]


def test_no_room_is_said() -> None:
    config = chain_config(leg(("floor = -0.4 ", "floor = 0.02 ")))
    with pytest.raises(ConfigError, match=r"arm\.rest_pose puts shank .* into floor"):
        Paths.of(config, ChainBelief.prior(config).torque)


def test_learning_moves_the_arms_to_what_was_seen(found: hil.Identification) -> None:
    config = hil.load_run(found.run).config
    before = ChainBelief.prior(config)
    after = before.learn(config, load_samples(found.run / "samples.npy", 3))
    assert found.truth is not None
    index = list(before.arms.base.names).index("moment_z_2")
    true = found.truth["moment_z_2"]
    drawn = {key: belief.arms.rigid[:, index] for key, belief in (("before", before), ("after", after))}
    assert abs(drawn["after"].mean() - true) < 0.05 * abs(true)
    assert drawn["after"].std() < 0.2 * drawn["before"].std()


def test_only_a_limit_takes_amplitude_away_not_a_joint_that_friction_holds() -> None:
    config = chain_config(leg())
    belief = ChainBelief.prior(config)
    search = searching(config, belief, cast("Any", None), print)
    played = Found(0.3, cast("Any", None), cast("Any", None))
    search.limit_after(DidNotMove("knee moved by 0 rad"), played)
    search.limit_after(NotSettled("still drifts"), played)
    assert search.cap == 1.0
    search.limit_after(SafetyStop("knee is beyond its limit", Cause.POSITION), played)
    assert search.cap == pytest.approx(0.21)


@pytest.mark.parametrize("is_enough", [True, False])
def test_a_second_path_in_which_a_joint_does_not_move_is_done_without(
    monkeypatch: pytest.MonkeyPatch, is_enough: bool
) -> None:
    stuck, played, said = DidNotMove("knee moved by 0 rad"), Found(0.3, cast("Any", None), cast("Any", None)), Mock()
    search: Any = Mock(last=0.3, cap=1.0, torque="Torque is off.", say=said)
    search.safe.return_value, search.play.return_value = played, stuck
    monkeypatch.setattr(chain_search, "can_be_estimated", lambda _: is_enough)
    with nullcontext() if is_enough else pytest.raises(DidNotMove, match="knee"):
        assert chain_search._full(search) == "Torque is off."
    assert search.play.call_count == 3 and ("uses only that path" in str(said.call_args)) is is_enough
    search.play.return_value = SafetyStop("knee is beyond its limit", Cause.POSITION)
    with pytest.raises(SafetyStop):
        chain_search._full(search)


def test_a_joint_that_a_run_saw_beyond_its_rest_pose_is_not_said_to_lie_on_its_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config, belief = load_config(LEG), Mock()
    belief.learn.return_value = belief
    search, seen = searching(config, belief, cast("Any", None), print), []

    def predicted(*_: object, passed: Any) -> Any:
        seen.append(passed)
        return Mock(rooms=np.ones(3))

    def stopped(*given: Any) -> Any:
        seen.append(given[-1])
        return SimpleNamespace(unsafe="")

    monkeypatch.setattr(chain_shares, "predict_chain", predicted)
    monkeypatch.setattr(chain_shares, "foreseen_stops", stopped)
    monkeypatch.setattr(chain_shares, "unsafe", lambda *_: "")
    monkeypatch.setattr(chain_shares, "simulated_seconds", lambda _: 1.0)
    search.paths = Mock()
    for joint, way in ((1, -0.1), (2, 0.1)):
        samples = {"position": np.add(config.arm.rest_pose, [np.zeros(3), way * np.eye(3)[joint]])}
        monkeypatch.setattr(chain_search, "load_samples", lambda *_, samples=samples: samples)
        search.learn(config, cast("Any", Mock()))
    assert search._largest(config, (0.3,))[0] is not None
    assert [passed.tolist() for passed in seen] == 3 * [[[False, True, False], [False, False, True]]]


def searching(config: Config, belief: ChainBelief, paths: Paths, say: Say) -> ChainSearch:
    return ChainSearch(config, belief, paths, say, run=cast("Any", None), shown_path=LEG, watch=cast("Any", None))


def search_of(config: Config, belief: ChainBelief, said: list[str]) -> ChainSearch:
    return searching(config, belief, Paths.of(config, ChainBelief.prior(config).torque), said.append)


def heavier(belief: ChainBelief, times: float) -> ChainBelief:
    return replace(belief, arms=replace(belief.arms, rigid=times * belief.arms.rigid))


SLOW = pytest.mark.slow


@pytest.mark.parametrize("safe_at_first", [pytest.param(0.0, marks=SLOW), 0.18, pytest.param(0.4, marks=SLOW)])
def test_where_little_of_a_path_is_safe_another_one_with_more_reserve_is_tried(
    monkeypatch: pytest.MonkeyPatch, safe_at_first: float
) -> None:
    """It is used if more is learned from it, and never if nothing of it is safe."""
    config = chain_config(leg())
    said: list[str] = []
    search = search_of(config, ChainBelief.prior(config), said)
    designed, roomier = search.paths, []

    def largest(_: object, shares: tuple[float, ...]) -> tuple[Found | None, str, float]:
        share = safe_at_first if search.paths is designed else 0.64
        if search.paths is not designed:
            roomier.append(search.paths.reserve)
        found = Found(share, cast("Any", None), cast("Any", None)) if share else None
        return found, "shank and floor: 2 mm", 0.008

    monkeypatch.setattr(search, "_largest", largest)
    found = search.safe(search.config, (1.0, 0.64, 0.4, 0.18))
    assert found.share == 0.64
    assert search.paths.identify is not designed.identify
    assert said == ["Designed another path, which stays farther from the limits."]
    (reserve,) = roomier
    assert reserve.clearance == pytest.approx(designed.reserve.clearance + 0.008)
    assert reserve.torque < designed.reserve.torque and reserve.position > designed.reserve.position
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    room = reserve.position * (high - low)[:, None]
    position = search.paths.identify.path.position
    assert (position >= low[:, None] + 0.99 * room).all() and (position <= high[:, None] - 0.99 * room).all()


def test_an_arm_too_heavy_for_any_path_is_refused_with_the_reason_and_what_helps() -> None:
    config = chain_config(leg())
    search = search_of(config, heavier(ChainBelief.prior(config), 40.0), [])
    with pytest.raises(
        NoSafeTorque, match=r"not even the designed path at 90 % of its amplitude: .*needs about.*More accurate.*larger"
    ):
        search.safe(step_config(search.config), (1.0, 0.9))


@pytest.mark.slow
def test_paths_from_other_seeds_are_tried_before_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    config = chain_config(leg())
    said: list[str] = []
    search = search_of(config, ChainBelief.prior(config), said)
    first, seed = search.paths, config.experiment.seed
    monkeypatch.setattr("hil.pilot.chain_shares.REDESIGNS", 0)

    def largest(_: object, shares: tuple[float, ...]) -> tuple[Found | None, str, float]:
        is_last = search.given.experiment.seed == safe
        return (Found(shares[0], cast("Any", None), cast("Any", None)) if is_last else None), "shank hits floor", 0.0

    monkeypatch.setattr(search, "_largest", largest)
    safe = None
    with pytest.raises(NoSafeTorque, match=r"not even the designed path at 18 % of its amplitude: shank hits floor\."):
        search.safe(search.config, (1.0, 0.18))
    assert search.paths is first and search.given.experiment.seed == seed
    assert [line.partition("Trying another path ")[2] for line in said] == ["(1 of 2).", "(2 of 2)."]
    safe = seed + 200
    assert search.safe(search.config, (1.0, 0.18)).share == 1.0
    assert search.given.experiment.seed == safe and search.paths is not first


def test_a_pilot_starts_where_the_arm_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = LEG.read_text(encoding="utf-8")
    (tmp_path / "leg.urdf").write_bytes((CONFIGS / "leg.urdf").read_bytes())
    (tmp_path / "leg.toml").write_text(text.replace("start = [-0.24, 0.0, 0.0]", "start = [-0.24, 0.0, 0.1]"), "utf-8")
    lay: list[list[float]] = []
    opened: list[object] = []

    def of(config: Config, *_: object) -> ChainSearch:
        lay.append(config.arm.rest_pose)
        with servo_session(config):
            raise NoSafeTorque("none")

    def opens(*arguments: Any, **options: Any) -> Port:
        opened.append(arguments)
        return open_port(*arguments, **options)

    monkeypatch.setattr(ChainSearch, "of", of)
    monkeypatch.setattr(drivers_bus, "open_port", opens)
    with pytest.raises(NoSafeTorque):
        hil.identify(tmp_path / "leg.toml", out=tmp_path / "run")
    assert lay[0][2] == pytest.approx(0.1, abs=0.06) and lay[0][2] > 0.02
    assert len(opened) == 1, "a port that locks cannot be opened for each run"


def test_a_period_too_short_for_a_path_is_a_mistake_in_the_file() -> None:
    text = LEG.read_text(encoding="utf-8").replace("period = 10.0", "period = 1.0")
    with pytest.raises(ConfigError, match=r"experiment\.period = 1 s: .* Set period to at least"):
        parse_config(text, LEG)


def test_a_path_that_is_safe_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer_arms(monkeypatch)
    config = chain_config(leg())
    search = search_of(config, ChainBelief.prior(config), [])
    designed = search.paths
    assert search.safe(step_config(search.config), (0.3,)).share == 0.3
    assert search.paths is designed


def test_paths_that_are_rejected_do_not_make_later_ones_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    config = chain_config(leg())
    search = search_of(config, ChainBelief.prior(config), [])
    designed, tried = search.paths, []

    def of(_: object, __: object, reserve: Reserve, ___: object) -> Paths:
        tried.append(reserve)
        return replace(designed, reserve=reserve)

    def largest(_: object, __: object) -> tuple[Found | None, str, float]:
        share = 0.18 if search.paths is designed else 0.06
        return Found(share, cast("Any", None), cast("Any", None)), "shank and floor: 2 mm", 0.0

    monkeypatch.setattr(Paths, "of", of)
    monkeypatch.setattr(search, "_largest", largest)
    for _ in range(3):
        search.safe(search.config, (1.0, 0.18))
    assert search.paths is designed
    assert tried == 3 * [RESERVE.larger(0.0), RESERVE.larger(0.0).larger(0.0)]


def test_a_reserve_always_leaves_some_range() -> None:
    reserve = RESERVE
    for _ in range(8):
        reserve = reserve.larger(0.01)
    assert reserve.position < 0.35
    config = chain_config(leg())
    with pytest.raises(NoSafeTorque, match="no position range is left"):
        Paths.of(config, ChainBelief.prior(config).torque, replace(RESERVE, position=0.5))


def test_a_description_that_is_too_heavy_for_its_motors_is_named_as_the_cause() -> None:
    config = chain_config(leg())
    thought = ChainBelief.prior(config).torque
    with pytest.raises(
        NoSafeTorque,
        match=r"According to leg\.urdf, gravity alone requires more torque .* Check the masses .* Otherwise, widen",
    ):
        Paths.of(config, replace(thought, rigid=100.0 * thought.rigid))


@pytest.mark.parametrize("doubts", [(), ('leg.urdf: link "shank" is bulky.', "leg.urdf: another.")])
def test_a_doubtful_description_is_named_as_a_possible_cause(
    doubts: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = chain_config(leg())
    thought = ChainBelief.prior(config).torque
    monkeypatch.setattr("hil.pilot.chain_paths.doubted_inertias", lambda _: doubts)
    monkeypatch.setattr(path_design.PathDesigner, "design", Mock(side_effect=ExcitationError("no path is allowed")))
    with pytest.raises(NoSafeTorque) as refused:
        Paths.of(config, thought, replace(RESERVE, speed=0.59))
    said = str(refused.value).partition("no path is allowed. ")[2]
    if doubts:
        expected = "The description may be the cause (`hil check` lists 1 more): " + doubts[0] + " Otherwise, widen"
    else:
        expected = "Widen position_limit"
    assert said.startswith(expected)


def wider(paths: Paths, times: float) -> Paths:
    def design(each: Design) -> Design:
        return replace(each, path=paths.designer.scaled(each, times))

    return replace(paths, identify=design(paths.identify), held_out=design(paths.held_out))


def test_another_path_starts_with_no_more_amplitude_than_the_one_it_replaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of different paths cannot be compared; those of the previous run and of its limit are converted."""
    config = chain_config(leg())
    search = search_of(config, ChainBelief.prior(config), [])
    designed, tried = search.paths, []
    search.last, search.cap = 0.2, 0.8
    other = wider(designed, 4.0)
    assert other.amplitude_over(designed) == pytest.approx(4.0)

    def largest(_: object, shares: tuple[float, ...]) -> tuple[Found | None, str, float]:
        tried.append(shares)
        share = 0.0 if search.paths is designed else shares[0]
        return Found(share, cast("Any", None), cast("Any", None)) if share else None, "too much torque", 0.0

    monkeypatch.setattr(Paths, "of", lambda *_, **__: other)
    monkeypatch.setattr(search, "_largest", largest)
    found = search.safe(search.config, (1.0, 0.5), 2.5 * search.last)
    assert tried == [(0.5, 0.25), (pytest.approx(0.125), pytest.approx(0.0625))]
    assert found.share == pytest.approx(0.125)
    assert search.last == pytest.approx(0.05) and search.cap == pytest.approx(0.2)


def test_a_dry_run_decides_as_the_pilot_does(monkeypatch: pytest.MonkeyPatch) -> None:
    fewer_arms(monkeypatch)
    moments, stopped = chain_stop.MOMENTS, chain_stop.ARMS
    DESIGNED.clear()  # to see a design's progress
    config, told = leg(), list[int]()
    designed = list[tuple[int, int]]()
    first = rehearse(config, 4, tell=lambda _, of: told.append(of), designing=lambda *each: designed.append(each))
    assert (told.count(4), told.count(12)) == (4, 2 * 12)  # also while it searches
    assert told.count(2 * moments * stopped) == 2 * 2 * moments * stopped, "its stops as well"
    assert designed[0] == (1, designed[-1][1]) and designed[-1][0] == len(designed) == designed[-1][1]
    pilot = ChainSearch.of(config, cast("Any", None), LEG, cast("Any", None), lambda _: None)
    found = pilot.safe(step_config(pilot.config), PILOT_SHARES)
    assert (first.share, first.is_safe(first.config)) == (found.share, True)
    np.testing.assert_array_equal(first.prediction.values[:12], found.foreseen.peaks.values)
    assert chain_dry_run_json(first)["clearance"]["near_as_built"] == [["body", "thigh"]]

    # More arms than the pilot looks at may add a doubt, which the dry run tells but does not decide by.
    with monkeypatch.context() as patch:
        patch.setattr(chain_summary, "unsafe", lambda *_: "joint 'knee' reaches speed 9")
        assert first.is_safe(first.config)
        assert any("'knee' reaches speed 9" in line for line in chain_dry_run_lines(first))

    fall = replace(first.stops.fall, hits=None, seconds=1.5)
    lines = chain_dry_run_lines(replace(first, stops=replace(first.stops, fall=fall)))
    assert any(": it hits nothing within 1.50 s; " in line for line in lines)

    # Where no share is safe, both refuse, for the same reason.
    monkeypatch.setattr(SafeShares, "_largest", lambda *_: (None, "shank and floor: 2 mm", 0.0))
    monkeypatch.setattr("hil.pilot.chain_shares.REDESIGNS", 0)
    monkeypatch.setattr(Paths, "of", lambda *_, paths=pilot.paths, **__: paths)
    with pytest.raises(NoSafeTorque) as refused:
        pilot.safe(step_config(pilot.config), PILOT_SHARES)
    again = rehearse(config, 4)
    assert again.why_not(again.config) == str(refused.value)
    assert not again.is_safe(again.config)


def test_a_dry_run_of_more_arms_than_the_prior_has_draws_further_ones() -> None:
    belief = ChainBelief.prior(chain_config(leg()))
    arms = belief.at_least(belief.arms.size + 3)
    assert arms.size == belief.arms.size + 3
    np.testing.assert_array_equal(arms.rigid[:5], belief.at_least(5).rigid)
    assert not (arms.rigid[-2:] == arms.rigid[1:3]).all(axis=1).any()


class _Begun(Exception):
    pass


@pytest.mark.parametrize(("settled", "told"), [(0.0, 0), (0.1, 1)])
def test_an_arm_that_settles_in_its_rest_pose_is_not_said_to_lie_elsewhere(
    monkeypatch: pytest.MonkeyPatch, settled: float, told: int
) -> None:
    config = load_config(LEG)
    rest = np.array(config.arm.rest_pose)
    bus = Mock(read_positions=Mock(side_effect=[rest + 0.1, rest + settled]))
    session = MagicMock()
    session.return_value.__enter__.return_value = bus
    said: list[str] = []
    monkeypatch.setattr(chain_search, "servo_session", session)
    monkeypatch.setattr(chain_search, "wait_for_rest", lambda _: "")
    monkeypatch.setattr(chain_search.ChainSearch, "of", Mock(side_effect=_Begun))
    with pytest.raises(_Begun):
        chain_search.identify_chain_in_steps(config, Mock(), LEG, Mock(), said.append)
    assert len(said) == told
    assert all("does not lie in arm.rest_pose: '" in each for each in said)


def test_a_long_search_is_not_silent() -> None:
    times, lines = iter([0.0, 10.0, 31.0, 31.0, 50.0, 62.0, 62.0]), list[str]()
    said = Said(lines.append, lambda: next(times))
    for done in (1, 2, 3, 4):
        said.tell(done, 9)
    assert ["2 of 9" in lines[0], "4 of 9" in lines[1], len(lines)] == [True, True, 2]


def test_a_long_design_is_not_silent() -> None:
    times, lines = iter([0.0, 10.0, 31.0, 31.0]), list[str]()
    said = Said(lines.append, lambda: next(times))
    said.designing(1, 9)
    said.designing(2, 9)
    assert lines == ["Still designing a path: 2 of 9 steps."]


def test_a_long_search_says_which_of_how_many_paths_and_amplitudes_it_simulates() -> None:
    lines = list[str]()
    said = Said(lines.append, Mock(side_effect=[0.0, 31.0, 31.0]))
    said.trying("path 2 of at most 9, amplitude 3 of at most 4")
    said.tell(46, 72)
    (line,) = lines
    assert line.endswith("path 2 of at most 9, amplitude 3 of at most 4, 46 of 72 simulations of this amplitude.")


def counting(monkeypatch: pytest.MonkeyPatch, unsafe_above: float) -> tuple[ChainSearch, list[tuple[float, str]]]:
    """A search whose shares are safe up to this one, and what it has simulated."""
    config = load_config(LEG)
    search, tried = searching(config, Mock(), Mock(), print), list[tuple[float, str]]()

    def simulated(_: object, share: float, __: int, which: str) -> tuple[Any, str, float]:
        tried.append((share, which))
        return Mock(share=share), "shank hits floor" if share > unsafe_above else "", 0.0

    monkeypatch.setattr(search, "_unsafe", simulated)
    monkeypatch.setattr(search, "_unsafe_stop", lambda *_: "")
    return search, tried


def test_where_the_least_amplitude_is_not_safe_those_between_are_not_simulated(monkeypatch: pytest.MonkeyPatch) -> None:
    search, tried = counting(monkeypatch, 0.0)
    assert search._largest(search.given, (1.0, 0.8, 0.6, 0.4))[:2] == (None, "shank hits floor")
    assert [share for share, _ in tried] == [1.0, 0.4]
    search, tried = counting(monkeypatch, 0.7)
    found = search._largest(search.given, (1.0, 0.8, 0.6, 0.4))[0]
    assert found is not None and found.share == 0.6
    assert tried[-1] == (0.6, "amplitude 3 of at most 4")


def test_a_search_that_has_simulated_enough_tries_the_least_amplitude_only(monkeypatch: pytest.MonkeyPatch) -> None:
    search, tried = counting(monkeypatch, 0.7)
    search.simulated = 2.0 * chain_shares.MOST_SIMULATED_S
    found = search._largest(search.given, (1.0, 0.8, 0.6, 0.4))[0]
    assert found is not None and found.share == 0.4
    assert {share for share, _ in tried} == {1.0, 0.4}


def test_a_search_is_bounded_and_a_refusal_says_that_it_ended_early(monkeypatch: pytest.MonkeyPatch) -> None:
    slow, fast = (chain_config(leg(("rate = 100.0", f"rate = {rate}"))) for rate in (100.0, 400.0))
    said: list[str] = []
    belief = ChainBelief.prior(slow)
    search = searching(fast, belief, Paths.of(slow, belief.torque), said.append)  # no higher rate is advised
    monkeypatch.setattr(search, "_largest", lambda *_: (None, "shank hits floor", 0.0))
    designed = Mock(side_effect=AssertionError)
    monkeypatch.setattr(Paths, "of", designed)
    search.simulated = 2.0 * chain_shares.MOST_SIMULATED_S
    with pytest.raises(NoSafeTorque, match=r"hits floor\. The search ended early, after 33 h of simulated motion"):
        search.safe(search.config, (1.0, 0.18))
    assert said == [] and not designed.called


@pytest.mark.parametrize(("enough", "named"), [(80.0, "80"), (100.0, "140"), (1000.0, "")])
def test_a_refusal_names_a_rate_only_if_a_motion_is_safe_at_it(
    monkeypatch: pytest.MonkeyPatch, enough: float, named: str
) -> None:
    config = chain_config(leg(("rate = 100.0", "rate = 50.0")))
    belief = ChainBelief.prior(config)
    designed = Paths.of(chain_config(leg()), belief.torque)  # at a rate at which other tests need it
    search, paths, tried = searching(config, belief, designed, print), None, list[Config]()

    def largest(_: object, config: Config, __: object) -> tuple[Any, str, float]:
        tried.append(config)
        return (Mock() if config.experiment.rate >= enough else None), "shank hits floor", 0.0

    monkeypatch.setattr(SafeShares, "_largest", largest)
    monkeypatch.setattr(Paths, "of", lambda *_, **__: paths)
    monkeypatch.setattr(chain_shares, "REDESIGNS", 0)
    monkeypatch.setattr(chain_shares, "OTHER_SEEDS", 0)
    with pytest.raises(NoSafeTorque) as refused:
        search.safe(search.config, (1.0, 0.18))
    said = f"In a simulation at experiment.rate = {named}, a motion is safe. At 50 Hz, delay "
    assert (said in str(refused.value)) is bool(named)
    assert tried[-1].stabiliser == belief.gains(config).at(tried[-1].experiment.rate)
    assert search.given.experiment.rate == 50.0 and search.paths is not None
