"""Run benchmarks/bus/fake_noise.py with ten thousand pieces of noise; the benchmark itself sends a million."""

import importlib

import pytest

from tests.support.paths import ROOT

BENCHMARKS = ROOT / "benchmarks"


@pytest.mark.parametrize("seed", [1, 2])
def test_after_noise_the_next_good_packet_is_answered(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    noise = importlib.import_module("fake_noise").NoiseRun(seed)
    noise.run(5_000)
    assert noise.answered == noise.asked == 500
