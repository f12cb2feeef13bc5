"""Recorded lateness of the computer has no effect on the estimate."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.config.schema import Config, load_config
from hil.estimation.lateness import acting_torque
from tests.support import late_loop

Arm = Callable[..., Config]


def test_torque_between_deadlines_is_the_mean_of_what_acted() -> None:
    goals = np.array([[0.0, 1.0, 3.0], [2.0, 2.0, -2.0]])
    mean = acting_torque(goals, np.array([0.25e-2, 0.5e-2]), rate=100.0)
    assert mean == pytest.approx(np.array([[0.75, 2.0], [2.0, 0.0]]))


def test_jitter_of_the_loop_is_taken_back(arm_file: Callable[..., Path]) -> None:
    found = late_loop.measure(load_config(arm_file()), 400e-6)
    assert found["real"]["residual_ticks"] < 0.30
    assert found["nominal"]["residual_ticks"] > 0.45, "or this test could not fail"
    assert found["real"]["worst_error"] < 0.02, "as without jitter, in the 2 s that this test has"
    assert found["real"]["held_out_rms"] < 0.5 * found["nominal"]["held_out_rms"]
