"""Pilot and full run from joint limits and link lengths only, and arms that need a stabiliser."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

import hil
from hil.cli.views.result_table import print_result
from hil.config.schema import Config, load_config
from hil.dry_run import stopping_distance
from hil.errors import Cause, ConfigError, DidNotMove, ExperimentError, NotSettled, SafetyStop
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.fakes.servo.registers import Register
from hil.fakes.servo.servo import EmulatedServo
from hil.pilot import identify_in_steps, steps
from hil.pilot.belief import prior_belief
from hil.pilot.search import Search
from hil.pilot.steps import Played, Step
from hil.report.page import make_page
from hil.report.run_data import RunData
from hil.results.result import SettledResult
from hil.runs.recording import sample_type
from hil.runs.run_folder import RunFolder
from tests.support.dry_runs import worst_relative_std
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

Writes = Counter[tuple[int, str]]
"""Writes of each servo's EEPROM registers by instructions, counted by ID and register."""


@contextmanager
def counted_eeprom_writes() -> Iterator[Writes]:
    written: Writes = Counter()
    write = EmulatedServo._write

    def counting(servo: EmulatedServo, register: Register, value: int) -> None:
        if register.eeprom:
            written[servo.id, register.name] += 1
        write(servo, register, value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(EmulatedServo, "_write", counting)
        yield written


@pytest.fixture(scope="module")
def first_time(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """The bundled file with a shorter experiment at a lower rate, whose pilots settle roughly."""
    path = tmp_path_factory.mktemp("first_time") / "first_time.toml"
    text = replaced(
        (CONFIGS / path.name).read_text(encoding="utf-8"),
        ("rate = 400.0 ", "settle_within = 0.03\nrate = 100.0 "),
        ("period = 10.0 ", "period = 6.0 "),
        ("band = [0.1,", "band = [0.167,"),
    )
    path.write_text(text, encoding="utf-8")
    return load_config(path)


@pytest.fixture(scope="module")
def in_steps_counted(
    first_time: Config,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[tuple[SettledResult, Path, list[str]], Writes]:
    config = first_time
    assert config.experiment.peak_torque is None and config.arm.prior is None
    run = RunFolder.create(tmp_path_factory.mktemp("steps") / "run", config)
    said: list[str] = []
    with counted_eeprom_writes() as written, pytest.MonkeyPatch.context() as patch:
        patch.setattr(stopping_distance, "_ARMS", 2)
        _, result = identify_in_steps(config, run, config.path, lambda _: None, said.append)
    return (result, run.path, said), written


@pytest.fixture(scope="module")
def in_steps(in_steps_counted: Any) -> Any:
    return in_steps_counted[0]


def test_a_whole_identification_writes_four_eeprom_registers_a_joint_at_most(
    in_steps_counted: Any,
) -> None:
    """Mode and current limit, set once and restored once, whatever the number of steps."""
    (result, _, _), eeprom_writes = in_steps_counted
    assert len(result.steps) >= 2
    assert {servo_id for servo_id, _ in eeprom_writes} == {1, 2}
    for servo_id in (1, 2):
        assert sum(count for (owner, _), count in eeprom_writes.items() if owner == servo_id) <= 4, eeprom_writes


def used_range(result: SettledResult) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Fraction of each joint's position range that the full run used (joints,)."""
    low, high = np.array(result.steps[-1].seen)[:2] if result.steps else np.zeros((2, 2))
    limits = [joint.position_limit for joint in load_config(CONFIGS / "first_time.toml").joints]
    return np.asarray((high - low) / np.ptp(limits, axis=1))


def test_the_full_run_uses_most_of_the_room(in_steps: Any) -> None:
    assert (used_range(in_steps[0]) >= 0.7).all()


def test_the_full_run_beats_the_pilot(in_steps: Any) -> None:
    result, path, _ = in_steps
    pilot = estimate_run(RunFolder.open(path / "pilot-1"))
    assert worst_relative_std(pilot) / worst_relative_std(result) >= 10
    for name, entry in result.parameters.items():
        assert entry.std < pilot.parameters[name].std, name
        assert abs(entry.value - result.truth[name]) <= 0.01 * abs(result.truth[name]), name


def test_every_step_says_predicted_against_seen(in_steps: Any) -> None:
    result, _, said = in_steps
    assert result.steps[0].name == "Pilot"
    assert sum("predicted" in line and "99 % within" in line for line in said) == len(result.steps)
    full = result.steps[-1]
    rest = np.array([-np.pi / 2, 0.0])
    for row, origin in ((0, rest), (1, rest), (2, 0.0)):
        foreseen, seen = (np.array(rows)[row] - origin for rows in (full.predicted_median, full.seen))
        assert np.abs(foreseen / seen - 1).max() <= 0.10


def test_the_run_folder_estimates_again_with_the_torque_that_was_found(in_steps: Any, first_time: Config) -> None:
    result, path, _ = in_steps
    folder = RunFolder.open(path)
    assert folder.load_config().experiment.peak_torque == pytest.approx(result.steps[-1].peak_torque)
    assert (path / "config.toml").read_bytes() == first_time.path.read_bytes()
    assert estimate_run(folder).parameters == result.parameters


def test_an_inverted_arm_is_identified_with_a_stabiliser(tmp_path: Path) -> None:
    text = (CONFIGS / "fake_inverted.toml").read_text(encoding="utf-8")
    text = replaced(text, ("rate = 400.0 ", "rate = 100.0 "), ("period = 10.0 ", "period = 6.0 "))
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    config = load_config(tmp_path / "arm.toml")
    run = RunFolder.create(tmp_path / "run", config)
    run_experiment(config, run, config.path, lambda _: None)
    result = estimate_run(run)
    for name in ("inertia_1", "inertia_2", "armature_2", "gravity_1", "gravity_2", "viscous_1", "coulomb_1"):
        assert abs(result.parameters[name].value / result.truth[name] - 1) <= 0.02, name
    assert max(result.validation.held_out_rms) <= 0.01
    share = result.stabiliser
    assert min(share.rms) > 0.0 and np.greater(share.peak, share.rms).all()
    console = Console(record=True, width=200, file=StringIO())
    print_result(result, config, run.path, console)
    shoulder = f"shoulder {share.rms[0]:.3f} of {share.commanded_rms[0]:.3f} N m RMS"
    page = make_page(RunData.load(run.path))
    for said in (console.export_text(), page):
        assert "Torque from the stabiliser" in said and shoulder in said
    assert "uses the total commanded torque" in page


@pytest.mark.slow
def test_a_second_run_starts_from_the_first_and_needs_fewer_steps(
    in_steps: Any, first_time: Config, tmp_path: Path
) -> None:
    first, _, _ = in_steps
    config = first_time
    said: list[str] = []
    run = RunFolder.create(tmp_path / "run", config)
    _, second = identify_in_steps(config, run, config.path, lambda _: None, said.append, first)
    assert [step.name for step in second.steps] == ["Pilot", "Full run"] and len(first.steps) > 2
    assert not any("starting from the prior" in line for line in said)
    for name, entry in second.parameters.items():
        assert abs(entry.value - second.truth[name]) <= 0.01 * abs(second.truth[name]), name


def test_an_earlier_result_narrows_the_belief_and_is_dropped_when_the_arm_moves_otherwise(
    in_steps: Any, first_time: Config
) -> None:
    first, _, _ = in_steps
    config = first_time
    said: list[str] = []
    search = Search.of(config, Mock(), Mock(say=said.append), earlier=first)
    prior = prior_belief(config, 96)
    for name in ("inertia_1", "gravity_1", "coupling", "coulomb_1", "viscous_2"):
        assert search.belief.spread(name) < 0.5 * prior.spread(name), name
        assert search.belief.middle[name] == pytest.approx(first.values[name], rel=0.05), name
    peaks = np.zeros((4, 2))
    beyond = Step("Pilot", np.array([0.3, 0.2]), peaks, peaks, peaks + 1.0)
    search.learn(config, Played(beyond, None, "", None))
    assert search.belief.spread("gravity_1") == prior.spread("gravity_1") and not search.from_earlier
    assert any("starting from the prior" in line for line in said)


def test_an_earlier_run_needs_a_pilot_to_start_from(in_steps: Any) -> None:
    _, path, _ = in_steps
    with pytest.raises(ConfigError, match=r"pilot \(experiment\.pilot = true\), but this file gives peak_torque"):
        hil.identify("fake_two_link", start_from=path)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            DidNotMove("Joint 'elbow' moved by only 0.0046 rad in a whole period: it is stuck. Move it by hand."),
            "period.",
        ),
        (NotSettled("After 5 periods of 4 s the motion is still drifting: 4 % of its RMS. Check it."), "drifting."),
        (SafetyStop("Joint 'elbow' is at 2 rad, outside its position limit [-1, 1].", Cause.POSITION), "[-1, 1]."),
    ],
)
def test_a_run_says_in_one_sentence_why_it_ended_early(
    first_time: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: ExperimentError, said: str
) -> None:
    """Not what to do about it: the pilot does that itself."""
    samples = np.zeros(0, dtype=sample_type(2))
    monkeypatch.setattr(steps, "punctual", Mock(side_effect=error))
    monkeypatch.setattr(steps, "load_samples", lambda *_: samples)
    monkeypatch.setattr(steps, "peaks_of", lambda *_: np.zeros((6, 2)))
    told: list[str] = []
    found = Mock(peak_torque=np.zeros(2), prediction=Mock(median=np.zeros((6, 2)), quantile=np.zeros((6, 2))))
    player = steps.Player(first_time.path, lambda _: None, told.append)
    played = player.play(first_time, RunFolder.create(tmp_path / "run", first_time), "Step 4", found, Mock())
    (line,) = [each for each in told if "ended early" in each]
    assert line.startswith("Step 4 ended early: ") and line.endswith(said)
    assert line.count(". ") == 0 and played.error is error
