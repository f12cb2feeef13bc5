"""The comparison of predicted and measured peaks, as the terminal shows it."""

import numpy as np
import pytest

from hil.pilot.steps import Step


@pytest.mark.parametrize("joints", [1, 2, 4, 7])
def test_it_fits_eighty_columns_for_any_arm(joints: int) -> None:
    median, quantile, seen = np.random.default_rng(1).uniform(-9, 9, (3, 6, joints))
    lines = str(Step("Pilot", np.full(joints, 0.5), median, quantile, seen, "")).splitlines()
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    for row in (*median[:3], *quantile[:3], *seen[:3]):
        assert ", ".join(f"{value:.2f}" for value in row) in text
