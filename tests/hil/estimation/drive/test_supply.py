"""A supply that sags under load is found in sparse, rounded readings, and corrected for where it matters."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.estimation.drive.supply import supply_notes, supply_sag, torque_factor
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.runs.recording import sample_type
from hil.runs.run_folder import RunFolder
from tests.hil.test_pwm import by_voltage as driven_by_voltage
from tests.support.edits import WITHOUT_HELD_OUT, replaced
from tests.support.paths import CONFIGS

COUNT = 8000
OHM = 1.5


def recording(resistance: float, seed: int = 1) -> np.ndarray:
    """Two joints under random load, with the voltage of one of them read every 20 samples, in steps of 0.1 V."""
    random = np.random.default_rng(seed)
    samples = np.zeros(COUNT, dtype=sample_type(2))
    seconds = np.arange(COUNT) / 400.0
    for joint in range(2):
        tones = random.uniform(0.2, 2.0, 4)[:, None] * seconds + random.uniform(0, 7, 4)[:, None]
        samples["goal_current"][:, joint] = np.sin(2 * np.pi * tones).mean(axis=0) * 3.0
        samples["velocity"][:, joint] = 2.0 * np.cos(2 * np.pi * tones).mean(axis=0)
    goal, velocity = samples["goal_current"], samples["velocity"]
    drawn = (0.1 * goal**2 + 0.02 * goal * velocity).sum(axis=1)
    volts = 11.93 - resistance * drawn
    samples["supply_voltage"] = np.nan
    for joint in range(2):
        rows = slice(10 * joint, None, 40)
        samples["supply_voltage"][rows, joint] = np.round(volts[rows], 1)
    return samples


@pytest.fixture(scope="module")
def by_voltage() -> Config:
    return load_config(CONFIGS / "xl430_two_link.toml")


@pytest.fixture(scope="module")
def by_current() -> Config:
    return load_config(CONFIGS / "xm430_two_link.toml")


def test_the_drop_of_every_sample_is_known_from_a_few_rounded_readings(by_voltage: Config) -> None:
    samples = recording(OHM)
    sag = supply_sag(by_voltage, samples)
    assert sag is not None
    goal, velocity = samples["goal_current"], samples["velocity"]
    true = 1.0 - OHM * (0.1 * goal**2 + 0.02 * goal * velocity).sum(axis=1) / 11.93
    found = torque_factor(by_voltage, sag, samples)
    assert true.min() < 0.93
    assert np.abs(found - np.minimum(true, 1.0)[:, None]).max() < 0.003


@pytest.mark.parametrize("seed", range(6))
def test_a_stiff_supply_is_not_suspected(by_voltage: Config, by_current: Config, seed: int) -> None:
    samples = recording(0.0, seed)
    assert supply_sag(by_voltage, samples) is None and supply_sag(by_current, samples) is None
    assert np.all(torque_factor(by_voltage, None, samples) == 1.0)


def test_current_control_makes_up_for_it_and_the_note_says_so(by_current: Config) -> None:
    samples = recording(OHM)
    sag = supply_sag(by_current, samples)
    assert np.all(torque_factor(by_current, sag, samples) == 1.0)
    (said,) = supply_notes(by_current, sag)
    assert "supply sags" in said and "control their current" in said


def test_too_few_readings_tell_nothing(by_voltage: Config) -> None:
    assert supply_sag(by_voltage, recording(OHM)[:300]) is None


@pytest.mark.parametrize("resistances", [(6.0,), pytest.param((5.0, 6.0, 8.0), marks=pytest.mark.slow)])
def test_an_arm_on_a_weak_supply_is_identified_and_the_supply_is_named(
    resistances: tuple[float, ...], arm_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # How much of the error the correction removes differs from recording to recording.
    for ohm in resistances:
        left, left_without = left_with_and_without(ohm, arm_file, tmp_path, monkeypatch)
        assert left < 0.7 * left_without


def left_with_and_without(
    ohm: float, arm_file: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[float, float]:
    """The residual beyond noise with and without the correction [encoder steps]."""
    path = driven_by_voltage(arm_file)
    text = replaced(path.read_text(encoding="utf-8"), *WITHOUT_HELD_OUT)
    path.write_text(f"{text}\n[fake.supply]\nresistance_ohm = {ohm}\n", encoding="utf-8")
    config = load_config(path)
    run = RunFolder.create(tmp_path / f"run-{ohm:g}", config)
    run_experiment(config, run, path, lambda _: None)
    result = estimate_run(run)
    assert any("supply sags" in sentence for sentence in result.verdict.sentences)
    with monkeypatch.context() as without:
        without.setattr("hil.estimation.settled_period.supply_sag", lambda *_: None)
        uncorrected = estimate_run(run)
    noise = 0.29
    left, left_without = (max(each.fit.residual_rms_ticks) - noise for each in (result, uncorrected))
    return left, left_without
