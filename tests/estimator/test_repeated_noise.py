"""Noise from the difference between two passes of one motion, rounding included."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hil.estimator.data.fourier import white_noise
from hil.estimator.data.repeated_noise import agreed_noise, coloured_noise, repeated_noise

STEP = np.array([1.5e-3, 1.5e-3])
SAMPLES = 4000


def fast_motion() -> np.ndarray:
    """A motion with corners, sampled so slowly that its lines reach the Nyquist frequency [steps]."""
    order = np.arange(1, SAMPLES // 2)
    lines = np.exp(2j * np.pi * np.random.default_rng(5).random((2, order.size))) / order**1.5
    return SAMPLES * np.fft.irfft(np.pad(300.0 * lines, ((0, 0), (1, 0))), SAMPLES)


def passes(std: float, count: int = 2) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    motion = fast_motion()
    return [np.round(motion + std * rng.standard_normal(motion.shape)) * STEP[:, None] for _ in range(count)]


@pytest.mark.parametrize("std", [0.0, 0.05, 0.13, 0.2, 0.34, 0.56, 1.5])
def test_noise_is_measured_whatever_the_motion(std: float) -> None:
    found = repeated_noise(passes(std), STEP)
    assert found is not None
    np.testing.assert_allclose(found / STEP, np.sqrt(1.0 / 12.0 + std**2), rtol=0.08)


def test_a_single_period_takes_the_corners_of_the_motion_for_noise() -> None:
    """Otherwise the test above would pass without any difference being taken."""
    assert np.all(white_noise(passes(0.0)[0]) > 0.35 * STEP)


def test_the_mean_of_several_passes_is_less_noisy_but_rounded_alike() -> None:
    for std in (0.0, 0.13, 0.8):
        several = passes(std, 5)
        found = repeated_noise(several, STEP, averaged=4)
        assert found is not None
        error = np.mean(several[1:], axis=0) / STEP[:, None] - fast_motion()
        np.testing.assert_allclose(found / STEP, np.sqrt(np.mean(error**2, axis=1)), rtol=0.1)


def test_missing_samples_are_bridged_and_single_passes_say_nothing() -> None:
    one, other = passes(0.34)
    one[0, 100:140] = np.nan
    one[0, ::50] = np.nan
    found = repeated_noise([one, other], STEP)
    assert found is not None
    np.testing.assert_allclose(found / STEP, np.sqrt(1.0 / 12.0 + 0.34**2), rtol=0.12)
    assert repeated_noise([one], STEP) is None
    assert repeated_noise([one[:, :19], other[:, :19]], STEP) is None


@pytest.mark.parametrize("std", [0.3, 1.5])
def test_few_samples_suffice(std: float) -> None:
    """At 20 Hz, half a period of 2 s has 20 samples, and the motion's own lines reach up to the Nyquist frequency."""
    rng, turn = np.random.default_rng(7), 2.0 * np.pi * np.arange(20) / 20
    found = []
    for _ in range(100):
        motion = 300.0 * np.sin(turn + rng.uniform(0.0, 6.0)) + 80.0 * np.sin(3.0 * turn + rng.uniform(0.0, 6.0))
        three = [np.round(motion + std * rng.standard_normal((1, 20))) for _ in range(3)]
        noise = repeated_noise(three, np.ones(1))
        assert noise is not None
        found.append(noise[0] / np.hypot(std, 12**-0.5))
    assert np.median(found) == pytest.approx(1.0, abs=0.15)
    assert np.quantile(found, 0.05) > 0.5 and np.quantile(found, 0.95) < 2.0


@pytest.mark.parametrize("lost", [0.05, 0.15])
def test_lost_samples_do_not_make_the_noise_smaller(lost: float) -> None:
    """Interpolated samples have less high-frequency noise than received ones."""
    several = passes(0.8, 6)
    for index, each in enumerate(several):
        each[np.random.default_rng(index).random(each.shape) < lost] = np.nan
    found = repeated_noise(several, STEP)
    assert found is not None
    np.testing.assert_allclose(found / STEP, np.sqrt(1.0 / 12.0 + 0.8**2), rtol=0.04)
    one = several[0] - fast_motion() * STEP[:, None]
    valid = np.isfinite(one)
    index = np.arange(SAMPLES)
    filled = np.stack([np.interp(index, index[on], row[on]) for row, on in zip(one, valid, strict=True)])
    np.testing.assert_allclose(white_noise(filled, valid) / STEP, np.sqrt(1.0 / 12.0 + 0.8**2), rtol=0.06)


@pytest.mark.parametrize("std", [0.0, 0.13, 0.5])
@pytest.mark.parametrize("drift", [0.3, 1.0, 3.0])
def test_drift_is_not_noise(std: float, drift: float) -> None:
    """A slow change from pass to pass makes them round differently even without noise."""
    rng = np.random.default_rng(7)
    shape = 1.0 + 0.5 * np.sin(2.0 * np.pi * 3.0 * np.arange(SAMPLES) / SAMPLES)
    moved = [fast_motion() + each * drift * shape for each in range(5)]
    several = [np.round(each + std * rng.standard_normal(each.shape)) * STEP[:, None] for each in moved]
    found = repeated_noise(several, STEP)
    assert found is not None
    np.testing.assert_allclose(found / STEP, np.sqrt(1.0 / 12.0 + std**2), rtol=0.1)


def test_two_measurements_are_averaged_where_they_agree() -> None:
    white, repeated = np.array([1.0, 3.0, 1.0]), np.array([1.05, 1.0, 3.0])
    found = agreed_noise(white, repeated, SAMPLES)
    assert 1.0 < found[0] < 1.05
    np.testing.assert_allclose(found[1:], 1.0)
    np.testing.assert_allclose(agreed_noise(white, None, SAMPLES), white)


def slow_passes(std: float, correlation: float, change: float = 0.0) -> list[np.ndarray]:
    """Two passes of a band-limited motion that changes in between, with first-order filtered noise [steps]."""
    rng = np.random.default_rng(8)
    order = np.arange(1, SAMPLES // 2)
    size = 100.0 * np.exp(2j * np.pi * rng.random((2, order.size))) / np.maximum(1.0, order / 50.0) ** 4
    lines = [size, size * (1.0 + change * np.exp(2j * np.pi * rng.random(size.shape)))]
    noise = np.sqrt(1.0 - correlation**2) * rng.standard_normal((2, 2, 2 * SAMPLES))
    coloured = std * lfilter([1.0], [1.0, -correlation], noise)[..., SAMPLES:]
    return [
        np.round(SAMPLES / 2 * np.fft.irfft(np.pad(each, ((0, 0), (1, 0))), SAMPLES)[:, : SAMPLES // 2] + added[:, ::2])
        for each, added in zip(lines, coloured, strict=True)
    ]


@pytest.mark.parametrize("correlation", [0.6, 0.8])
@pytest.mark.parametrize("std", [0.3, 1.0])
def test_noise_that_a_servo_filters_is_measured(std: float, correlation: float) -> None:
    """Every second sample of it: the correlation of successive ones is 0.36 and 0.64."""
    passes = slow_passes(std, correlation)
    white, coloured = repeated_noise(passes, np.ones(2)), coloured_noise(passes, np.ones(2))
    assert white is not None and coloured is not None
    true = np.sqrt(1.0 / 12.0 + std**2)
    assert np.all(white < 0.93 * true)
    np.testing.assert_allclose(np.hypot(white, coloured), true, rtol=0.08)
    passes[0][:, ::15] = np.nan
    white, coloured = repeated_noise(passes, np.ones(2)), coloured_noise(passes, np.ones(2))
    assert white is not None and coloured is not None
    np.testing.assert_allclose(np.hypot(white, coloured), true, rtol=0.1)


@pytest.mark.parametrize("std", [0.0, 0.3])
@pytest.mark.parametrize("change", [0.0, 1e-4, 0.003, 0.02])
def test_motion_that_changes_is_no_noise(change: float, std: float) -> None:
    passes = slow_passes(std, 0.0, change)
    assert np.max(np.abs(passes[1] - passes[0])) >= 100.0 * change
    for lost in (1, 7):
        passes[0][:, ::lost] += 0.0 if lost == 1 else np.nan
        coloured = coloured_noise(passes, np.ones(2))
        assert coloured is not None and np.all(coloured < 0.12)
    assert coloured_noise(passes[:1], np.ones(2)) is None
