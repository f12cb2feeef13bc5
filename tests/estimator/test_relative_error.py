"""Prediction errors relative to the motion, with and without encoder noise."""

import numpy as np
import pytest

from hil.estimator.data.relative_error import relative_error


def test_noise_of_the_encoders_is_subtracted_and_errors_of_the_model_are_not() -> None:
    rng = np.random.default_rng(1)
    motion = np.stack([np.sin(np.arange(4000) / 50.0), np.cos(np.arange(4000) / 30.0)])
    noise = np.array([0.02, 0.005])
    measured = motion + noise[:, None] * rng.standard_normal(motion.shape)
    assert relative_error(measured, motion)[0] == pytest.approx(0.028, rel=0.05)
    assert relative_error(measured, motion, noise).max() < 0.006
    wrong = 0.97 * motion
    assert relative_error(measured, wrong, noise) == pytest.approx(0.03, rel=0.1)
