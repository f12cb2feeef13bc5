"""Ten thousand pieces of noise on the bus; benchmarks/bus/fake_noise.py itself sends a million."""

import pytest

from benchmarks.bus.fake_noise import NoiseRun


@pytest.mark.parametrize("seed", [1, 2])
def test_after_noise_the_next_good_packet_is_answered(seed: int) -> None:
    noise = NoiseRun(seed)
    noise.run(5_000)
    assert noise.answered == noise.asked == 500
