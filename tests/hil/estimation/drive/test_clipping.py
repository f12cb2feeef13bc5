"""A motor that receives less current than commanded is found; one whose current is read one sample later is not."""

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.drive.currents import current_findings, settled_current_findings
from hil.runs.recording import Phase
from tests.support.paths import CONFIGS


def recording(rate: float, share: float, limit: float = np.inf) -> np.ndarray:
    """Samples with currents that follow the goals of one sample before, by `share` and up to `limit` [A]."""
    time = np.arange(0.0, 4.0, 1.0 / rate)
    goal = 0.5 * np.sin(2 * np.pi * 0.5 * time) + 0.3 * np.sin(2 * np.pi * 5.0 * time)
    current = share * np.concatenate(([0.0], goal[:-1])).clip(-limit, limit)
    samples = np.zeros(time.size, dtype=[("goal_current", float, (2,)), ("current", float, (2,)), ("phase", int)])
    samples["goal_current"], samples["current"] = goal[:, None], current[:, None]
    samples["phase"] = Phase.PERIODIC
    return samples


@pytest.mark.parametrize("rate", [100.0, 200.0, 400.0])
def test_a_current_read_one_sample_later_is_not_clipped(rate: float) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    assert current_findings(config, recording(rate, 1.0)).warnings == ()
    assert current_findings(config, recording(rate, 0.9)).warnings == ()


@pytest.mark.parametrize("samples", [recording(400.0, 1.0, limit=0.2), recording(400.0, 1.0, limit=0.45)])
def test_a_clipped_current_is_named_for_each_joint(samples: np.ndarray) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    found = settled_current_findings(config, samples)
    said = found.warnings
    assert [each.split()[0] for each in said] == ["shoulder", "elbow"]
    assert all(
        "received less than" in each and "clipped by the servo's own limit or, at speed, by the supply" in each
        for each in said
    )
    assert found.disturbances == ()


def overwritten(every: int) -> np.ndarray:
    """Every `every`-th current is that of a foreign goal."""
    samples = recording(200.0, 1.0)
    samples["current"][::every] = -0.4
    return samples


def noisy(samples: np.ndarray, sigma: float, smooth: int = 1) -> np.ndarray:
    """The samples after a second at rest, with noise [A RMS] on the currents; smooth: samples over which it lasts."""
    noisy = np.concatenate((np.zeros(200, samples.dtype), samples))
    noise = np.random.default_rng(0).standard_normal((len(noisy) + smooth - 1, 2))
    mean = [np.convolve(each, np.full(smooth, smooth**-0.5), "valid") for each in noise.T]
    noisy["current"] += sigma * np.transpose(mean)
    return noisy


def held(samples: np.ndarray, before: float, after: float) -> np.ndarray:
    """The samples after and before a second at rest, in which goals and currents have these values [A]."""
    rest = [np.zeros(200, samples.dtype) for _ in range(2)]
    for part, value in zip(rest, (before, after), strict=True):
        part["goal_current"] = part["current"] = value
    return np.concatenate((rest[0], samples, rest[1]))


def test_currents_that_hold_the_arm_are_no_noise() -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    assert settled_current_findings(config, held(recording(200.0, 1.0), 0.3, -0.2)).warnings == ()
    assert len(settled_current_findings(config, held(overwritten(5), 0.3, -0.2)).warnings) == 2


@pytest.mark.parametrize("is_settled", [True, False])
@pytest.mark.parametrize(("sigma", "smooth"), [(0.1, 1), (0.6, 1), (0.3, 10)])
def test_noise_of_the_reading_is_no_other_current(sigma: float, smooth: int, is_settled: bool) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    find = settled_current_findings if is_settled else current_findings
    assert find(config, noisy(recording(200.0, 1.0), sigma, smooth)).warnings == ()
    if smooth == 1:
        assert current_findings(config, noisy(recording(100.0, 1.0), sigma)[200:]).warnings == (), "never at rest"


@pytest.mark.parametrize(
    "samples",
    [
        *(recording(100.0, 0.7), recording(400.0, 0.6), overwritten(6), overwritten(9), overwritten(2)),
        *(noisy(recording(400.0, 0.6), 0.02), noisy(overwritten(3), 0.1), noisy(overwritten(9), 0.1)),
    ],
)
def test_a_current_that_is_another_one_is_not_said_to_be_clipped(samples: np.ndarray) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    found = settled_current_findings(config, samples)
    said = found.warnings
    assert len(said) == 2
    assert all("by another program, or its current sensor" in each and "supply" not in each for each in said)
    (verdict,) = found.disturbances
    assert verdict.startswith("The current of shoulder and elbow was not the commanded one")
