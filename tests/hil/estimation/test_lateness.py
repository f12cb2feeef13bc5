"""Recorded lateness of the computer has no effect on the estimate."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.estimation.lateness import acting_torque
from hil.estimation.settled_warnings import warnings_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.runs.recording import Phase, sample_type
from hil.runs.run_folder import RunFacts
from tests.support.stream import late_loop

Arm = Callable[..., Config]


def test_torque_between_deadlines_is_the_mean_of_what_acted() -> None:
    goals = np.array([[0.0, 1.0, 3.0], [2.0, 2.0, -2.0]])
    mean = acting_torque(goals, np.array([0.25e-2, 0.5e-2]), rate=100.0)
    assert mean == pytest.approx(np.array([[0.75, 2.0], [2.0, 0.0]]))


def test_jitter_of_the_loop_is_taken_back(arm_file: Callable[..., Path]) -> None:
    found = late_loop.measure(load_config(arm_file()), 800e-6)
    assert found["real"]["residual_ticks"] < 0.30
    assert found["nominal"]["residual_ticks"] > 0.7, "or this test could not fail"
    assert found["real"]["worst_error"] < 0.02, "as without jitter, in the 2 s that this test has"
    assert found["real"]["held_out_rms"] < 0.7 * found["nominal"]["held_out_rms"], "0.2 to 0.6 with other multisines"


@pytest.mark.parametrize(
    ("late", "said"),
    [(12, "this computer was late for 6.0 % of the samples: close other"), (0, "check the cable")],
)
def test_lost_samples_are_blamed_on_what_lost_them(arm_file: Callable[..., Path], late: int, said: str) -> None:
    config = load_config(arm_file())
    rate, count = config.experiment.rate, 200
    samples = np.zeros(count, sample_type(2))
    samples["phase"] = Phase.PERIODIC
    samples["deadline"] = np.arange(count) / rate
    samples["time_before_write"] = samples["deadline"] + 2e-5
    samples["time_before_write"][:late] += 0.5 / rate
    samples["time_after_read"] = samples["time_before_write"] + 1e-3
    angle = np.tile(np.sin(np.arange(count) / 20), (2, 1))
    angle[:, :16] = np.nan
    step = np.full(2, 0.0015)
    period = SettledPeriod(rate, 0.1 * np.ones((2, count)), angle, 1e-3, step)
    facts = RunFacts("arm.toml", 1e-3, step.tolist(), ("identify",), monitoring="Goals were hardly read back.")
    told = warnings_of(config, facts, samples, period)
    assert facts.monitoring in told
    lost = [each for each in told if "are missing or far" in each]
    assert len(lost) == 2 and all("8.0 % of the samples" in each and said in each for each in lost)
