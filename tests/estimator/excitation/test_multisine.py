"""Multisines: the requested lines and peaks, low crest factors, and identical phases for the same seed."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hil.estimator.errors import ExcitationError
from hil.estimator.excitation import multisine
from hil.estimator.excitation.lbfgs import descend
from hil.estimator.excitation.multisine import design_multisine, detecting_lines, zippered_lines


@given(st.floats(1.0, 50.0), st.floats(0.0, 2.0), st.floats(2.5, 20.0), st.integers(1, 4))
def test_lines_are_shared_out_and_belong_to_one_joint(period: float, low: float, high: float, joints: int) -> None:
    assume(int(high * period) - int(low * period) >= joints)
    lines = zippered_lines(period, (low, high), joints)
    every = sorted(line for joint in lines for line in joint)
    assert every == list(range(every[0], every[-1] + 1))
    assert max(map(len, lines)) - min(map(len, lines)) <= 1
    assert low * period - 1e-6 <= every[0] < low * period + 1.0 + 1e-6 or every[0] == 1
    assert high * period - 1.0 - 1e-6 < every[-1] <= high * period + 1e-6


@pytest.mark.parametrize("joints", [1, 2])
def test_detecting_lines_are_odd_and_leave_one_in_four_out(joints: int) -> None:
    lines = detecting_lines(10.0, (0.1, 5.0), joints, seed=3)
    driven = sorted(line for joint in lines for line in joint)
    odd = list(range(1, 51, 2))
    assert set(driven) <= set(odd) and len(set(driven)) == len(driven) == 19
    for first in range(0, 24, 4):
        assert len(set(odd[first : first + 4]) - set(driven)) == 1
    assert max(map(len, lines)) - min(map(len, lines)) <= 1
    assert lines == detecting_lines(10.0, (0.1, 5.0), joints, seed=3) != detecting_lines(10.0, (0.1, 5.0), joints, 4)
    with pytest.raises(ExcitationError, match="odd harmonic"):
        detecting_lines(1.0, (2.0, 4.5), 2, 1)


@contextmanager
def _quickly() -> Iterator[None]:
    """Optimise from two starts instead of all, for what holds whatever the crest factor is; nothing is remembered."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multisine, "STARTS", 1)
        patch.setattr(multisine, "_low_crest_phases", multisine._low_crest_phases.__wrapped__)
        yield


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 1000), st.integers(4, 12))
def test_spectrum_and_peak_are_as_asked(seed: int, count: int) -> None:
    lines = (tuple(range(1, 2 * count, 2)), tuple(range(2, 2 * count + 1, 2)))
    with _quickly():
        wave = design_multisine(100.0, 2.0, lines, (0.7, 0.3), seed)
    spectrum = np.abs(np.fft.rfft(wave.torque, axis=1)) * 2.0 / wave.samples
    for joint, excited in enumerate(lines):
        others = np.delete(spectrum[joint], list(excited))
        assert np.allclose(spectrum[joint, list(excited)], wave.amplitudes[joint], rtol=1e-9)
        assert others.max() < 1e-12
    assert np.allclose(np.abs(wave.torque).max(axis=1), (0.7, 0.3), rtol=1e-12)


def test_the_sum_of_cosines_is_what_is_written() -> None:
    wave = design_multisine(50.0, 4.0, ((1, 3, 8), (2, 5)), (1.0, 2.0), 3)
    t = np.arange(wave.samples) / wave.rate
    for joint in range(wave.joints):
        lines = zip(wave.lines[joint], wave.amplitudes[joint], wave.phases[joint], strict=True)
        summed = sum(a * np.cos(2.0 * np.pi * k * t / wave.period + phase) for k, a, phase in lines)
        assert np.allclose(wave.torque[joint], summed, atol=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_crest_factor_is_low(seed: int) -> None:
    """Crest factors for 25 lines are at least 1.7 with Schroeder's phases and 2.5 to 3.5 with random ones."""
    wave = design_multisine(400.0, 10.0, zippered_lines(10.0, (0.1, 5.0), 2), (0.8, 0.42), seed)
    assert wave.crest_factor.max() < 1.43


def test_many_lines_take_no_more_evaluations_than_few(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluations = 0

    def counted(function: Any, x: np.ndarray, steps: int) -> np.ndarray:
        def each(at: np.ndarray) -> tuple[float, np.ndarray]:
            nonlocal evaluations
            evaluations += 1
            found: tuple[float, np.ndarray] = function(at)
            return found

        return descend(each, x, steps)

    monkeypatch.setattr(multisine, "descend", counted)
    wave = design_multisine(400.0, 100.0, zippered_lines(100.0, (0.1, 5.0), 2), (0.8, 0.42), 1)
    assert len(wave.lines[0]) == 246
    # 17 descents of 40 steps for each joint, most steps at the first length tried; 0.3 ms each.
    assert 2 * 17 * 40 <= evaluations < 1.1 * 2 * 17 * 40
    assert wave.crest_factor.max() < 1.43


def test_a_seed_is_a_multisine() -> None:
    lines = ((1, 3, 5, 7), (2, 4, 6, 8))
    with _quickly():
        once, again, other = (design_multisine(100.0, 1.0, lines, (1.0, 1.0), seed) for seed in (5, 5, 6))
    assert np.array_equal(once.torque, again.torque)
    assert np.abs(once.torque - other.torque).max() > 0.1


def test_a_seed_gives_the_same_phases_on_processors_that_compute_cosines_differently() -> None:
    """Without fused multiply-add, glibc's cosine differs in the last bit; elsewhere the setting has no effect."""
    code = """
from hil.estimator.excitation.multisine import design_multisine
for seed in range(1, 5):
    print(design_multisine(100.0, 4.0, (tuple(range(1, 41, 2)),), (1.0,), seed).phases)
"""
    plain = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX2_Usable,-FMA_Usable"}
    said = [
        subprocess.check_output([sys.executable, "-c", code], text=True, env={**os.environ, **setting}).splitlines()
        for setting in ({}, plain)
    ]
    assert said[0] == said[1] and len(said[0]) == 4


@pytest.mark.parametrize(
    ("lines", "peak", "said"),
    [
        (((1, 2), (2, 3)), (1.0, 1.0), "line 2 is given to joint 1 and joint 2"),
        (((1, 50), (2,)), (1.0, 1.0), "line 50 of joint 1 is outside 1 to 49"),
        (((1,), ()), (1.0, 1.0), "joint 2 has no lines"),
        (((1,), (2,)), (1.0, 0.0), "peak torque of joint 2"),
        (((1,), (2,)), (1.0,), "1 peak torques for 2 joints"),
    ],
)
def test_what_cannot_be_built_is_said(lines: tuple[tuple[int, ...], ...], peak: tuple[float, ...], said: str) -> None:
    with pytest.raises(ExcitationError, match=said):
        design_multisine(100.0, 1.0, lines, peak, 0)


def test_an_empty_band_and_a_broken_period_are_refused() -> None:
    with pytest.raises(ExcitationError, match="contains 1 harmonic of"):
        zippered_lines(1.0, (0.9, 1.1), 2)
    with pytest.raises(ExcitationError, match="whole number"):
        design_multisine(100.0, 1.005, ((1,),), (1.0,), 0)
