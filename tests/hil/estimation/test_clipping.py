"""A motor that receives less current than commanded is found; one whose current is read one sample later is not."""

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.settled_warnings import clipping_warnings
from tests.support.paths import CONFIGS


def recording(rate: float, share: float, limit: float = np.inf) -> np.ndarray:
    """Samples with currents that follow the goals of one sample before, by `share` and up to `limit` [A]."""
    time = np.arange(0.0, 4.0, 1.0 / rate)
    goal = 0.5 * np.sin(2 * np.pi * 0.5 * time) + 0.3 * np.sin(2 * np.pi * 5.0 * time)
    current = share * np.concatenate(([0.0], goal[:-1])).clip(-limit, limit)
    samples = np.zeros(time.size, dtype=[("goal_current", float, (2,)), ("current", float, (2,))])
    samples["goal_current"], samples["current"] = goal[:, None], current[:, None]
    return samples


@pytest.mark.parametrize("rate", [100.0, 200.0, 400.0])
def test_a_current_read_one_sample_later_is_not_clipped(rate: float) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    assert clipping_warnings(config, recording(rate, 1.0)) == []
    assert clipping_warnings(config, recording(rate, 0.9)) == []


@pytest.mark.parametrize("samples", [recording(100.0, 0.7), recording(400.0, 1.0, limit=0.45)])
def test_a_clipped_current_is_named_for_each_joint(samples: np.ndarray) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    said = clipping_warnings(config, samples)
    assert [each.split()[0] for each in said] == ["shoulder", "elbow"]
    assert all("received less than" in each for each in said)
