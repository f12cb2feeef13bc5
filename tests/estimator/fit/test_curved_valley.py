"""The minimiser follows a curved valley: the encoder zero of a small motion, gravity, and an offset of the torque."""

import numpy as np
import pytest

from hil.estimator.fit.segmented_least_squares import minimise_segmented

TRUE = np.array([1.0, 0.0, 0.0])
"""Gravity [N m], zero [rad] and offset [N m]."""
NOISE = 1e-5
SEGMENTS, SAMPLES = 20, 30


@pytest.mark.parametrize("zero", [-0.9, -0.4, 0.5, 0.9])
def test_a_zero_is_found_from_a_small_swing(zero: float) -> None:
    random = np.random.default_rng(7)
    angle = np.linspace(-0.2, 0.2, SAMPLES) - 1.2
    own = np.ones((SEGMENTS, 1))
    trend = np.linspace(0.0, 1.0, SAMPLES)
    measured = [torque(TRUE, angle) + trend + NOISE * random.standard_normal(SAMPLES) for _ in range(SEGMENTS)]

    def residual(segment: int, shared: np.ndarray, slope: np.ndarray) -> np.ndarray:
        return (torque(shared, angle) + slope * trend - measured[segment]) / NOISE

    def derivative(segment: int, shared: np.ndarray, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gravity, zero, _ = shared
        columns = np.cos(angle + zero), -gravity * np.sin(angle + zero), np.ones(SAMPLES), trend
        return residual(segment, shared, slope), np.stack(columns, axis=1) / NOISE

    start = np.array([1.3, zero, 0.3])
    found = minimise_segmented(residual, derivative, start, own, 3e-6)
    std = np.sqrt(np.diag(found.covariance()))
    assert np.all(np.abs(found.shared - TRUE) < 4.0 * std)
    assert found.iterations < 60


def torque(shared: np.ndarray, angle: np.ndarray) -> np.ndarray:
    gravity, zero, offset = shared
    return np.asarray(gravity * np.cos(angle + zero) + offset)
