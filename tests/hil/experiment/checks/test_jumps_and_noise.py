"""Jumps of the position are detected; encoder noise is not mistaken for them, whether the joint moves or rests."""

import math
from random import Random

import pytest

from tests.support.one_joint import STEP, TICK, Consistency, learnt_motion, seen_after


@pytest.mark.parametrize("rate", [100, 400, 1000])
@pytest.mark.parametrize("bit", [3, 4, 6])
def test_a_stuck_bit_is_seen_though_its_jumps_cancel(rate: int, bit: int) -> None:
    def position(now: float) -> float:
        ticks = round(learnt_motion(now)[0] / STEP)
        return STEP * (ticks if now < 3.0 else ticks | 1 << bit)

    when = seen_after(rate, position, lambda now: learnt_motion(now)[1])
    assert 3.0 <= when < 3.6


@pytest.mark.parametrize("noise", [0.7, 2.0, 5.0])
def test_a_noisy_encoder_and_single_glitches_are_no_stuck_bit(noise: float) -> None:
    random = Random(noise)
    glitches = {400 * second for second in range(1, 6)}

    def position(now: float) -> float:
        glitch = 0.02 if round(400 * now) in glitches else 0.0
        return learnt_motion(now)[0] + glitch + random.gauss(0.0, noise * STEP)

    assert seen_after(400, position, lambda now: learnt_motion(now)[1]) == math.inf


def test_a_creep_slower_than_a_tick_of_velocity_is_taken_for_rounding() -> None:
    assert seen_after(400, lambda now: 0.03 * now, lambda now: 0.0) == math.inf


@pytest.mark.parametrize(("jumps", "seen"), [((0.4, 0.5, 0.6), False), ((0.4, 0.5, 0.6, 0.7), True)])
def test_four_jumps_are_too_many(jumps: tuple[float, ...], seen: bool) -> None:
    """Back and forth, so that nothing accumulates. Each pair of steps is one jump; the return is half of the next."""
    times = [round(400 * jump) for jump in jumps]

    def position(now: float) -> float:
        return 0.012 * (sum(round(400 * now) >= each for each in times) % 2)

    assert (seen_after(400, position, lambda now: 0.0) < math.inf) is seen


@pytest.mark.parametrize("rate", [100, 333, 1000])
@pytest.mark.parametrize("noise", [1.0, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("resting", [0.5, 1.0])
def test_noise_of_a_joint_that_stands_still_does_not_accumulate(rate: int, noise: float, resting: float) -> None:
    """A fifth of the changes due to this noise exceed a jump; their sum over 30 s would exceed any tolerance.

    resting: fraction of the time in which the joint stands still.
    """
    random, look = Random(rate + int(10 * noise)), Consistency()
    for index in range(30 * rate):
        phase = max(index / rate % 4 / 4 - resting, 0.0) / max(1.0 - resting, 0.01)
        angle = 0.3 * (1.0 - math.cos(math.tau * phase))
        speed = 0.3 * math.tau / (4 * (1.0 - resting)) * math.sin(math.tau * phase) if phase else 0.0
        position = STEP * round(angle / STEP + random.gauss(0.0, noise))
        assert not look.look(position, TICK * int(speed / TICK), 1 / rate), index / rate


@pytest.mark.parametrize("rate", [20, 100, 400, 1000])
@pytest.mark.parametrize(("speed", "detected"), [(0.02, False), (0.06, True)])
def test_a_joint_that_turns_at_rest_may_do_so_at_one_step_of_velocity_only(
    rate: int, speed: float, detected: bool
) -> None:
    assert (seen_after(rate, lambda now: speed * now, lambda now: 0.0) < math.inf) is detected
