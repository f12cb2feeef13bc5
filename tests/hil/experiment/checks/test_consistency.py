"""Position and velocity are compared on every sample: frozen readings are detected, healthy ones accepted."""

import math
from collections.abc import Callable
from random import Random

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from hil.drivers.state import State
from hil.experiment.checks.consistency import (
    CURVED,
    CURVED_AT_FIRST,
    LAG_S,
    LONG_EVERY_S,
    LONG_S,
    MORE_LAG_S,
    MORE_SCALE,
    SCALE,
    SHORT_S,
    STDS,
    moved_at_standstill,
)
from hil.experiment.velocity.lag import ALL_INFORMATION, BLOCK_S, ENOUGH_INFORMATION, LASTS_S, NOISE_RAD
from tests.support.one_joint import STEP, TICK, Consistency, learnt_motion, quantised, seen_after

RATES = (20, 100, 400, 1000)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("speed", [0.7, 3.0, 15.0])
def test_an_encoder_that_freezes_while_the_joint_moves(rate: int, speed: float) -> None:
    frozen_at = 1.0
    when = seen_after(rate, lambda now: speed * min(now, frozen_at), lambda now: speed)
    assert 0.0 < when - frozen_at <= 0.1 + 1e-9


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("speed", [1.0, 6.0])
def test_a_velocity_that_stays_at_zero(rate: int, speed: float) -> None:
    when = seen_after(rate, lambda now: speed * now, lambda now: speed if now < 1.0 else 0.0)
    assert 0.0 <= when - 1.0 <= 0.15 + 1e-9


@pytest.mark.parametrize("rate", (100, 400, 1000))
@pytest.mark.parametrize("phase", [0.3, 0.5, 1.3, 1.5])
def test_a_velocity_that_freezes_while_the_joint_accelerates(rate: int, phase: float) -> None:
    """In the first moments of a run any lag is possible, and would explain the difference for a fifth of a second."""
    frozen_at = phase / 4 / 1.5

    def speed(now: float) -> float:
        return 3.8 * math.sin(math.tau * 1.5 * now)

    def angle(now: float) -> float:
        return -3.8 / (math.tau * 1.5) * math.cos(math.tau * 1.5 * now)

    when = seen_after(rate, angle, lambda now: speed(min(now, frozen_at)))
    assert 0.0 < when - frozen_at <= 0.12


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("lag", [0.0, 0.015, 0.03])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.004])
def test_a_velocity_that_stays_the_same_until_the_joint_turns_round_is_accepted(
    rate: int, lag: float, noise: float
) -> None:
    """A motor at the limit of its supply, say: a steady pace, and a sudden reversal."""
    random = Random(3)

    def angle(now: float) -> float:
        return 1.5 * now if now < 2.0 else 3.0 + 1.5 * (now - 2.0) - 20.0 * (now - 2.0) ** 2

    def velocity(now: float) -> float:
        return 1.5 if now < 2.0 + lag else 1.5 - 40.0 * (now - lag - 2.0)

    look = Consistency()
    for index in range(int(2.15 * rate)):
        now = index / rate
        position = quantised(angle(now) + noise * random.gauss(0.0, 1.0), STEP)
        assert not look.look(position, quantised(velocity(now), TICK), 1 / rate), now


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize(("scale", "lag"), [(0.5, 0.0), (1.5, 0.0), (-1.0, 0.0), (1.0, 0.15)])
def test_a_velocity_that_is_scaled_turned_round_or_old(rate: int, scale: float, lag: float) -> None:
    def speed(now: float) -> float:
        return 4.0 * math.sin(math.tau * now)

    def felt(now: float) -> float:
        return speed(now) if now < 2.0 else scale * speed(now - lag)

    when = seen_after(rate, lambda now: -4.0 / math.tau * math.cos(math.tau * now), felt)
    assert 0.0 <= when - 2.0 <= 0.25 + 2 / rate, "a sine at its zero: nothing can be seen at once"


RAMP_S = 0.3
"""Time in which a motion from rest reaches its course [s]."""


@pytest.mark.parametrize("rate", RATES)
@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    lag=st.floats(0.0, 0.02),
    scatter=st.floats(0.0, 0.7),
    amplitude=st.floats(0.0, 1.0),
    from_rest=st.booleans(),
)
@example(seed=600, lag=0.0, scatter=0.0, amplitude=1.0, from_rest=False)  # begins with a peak between two samples
@example(seed=938, lag=0.0195, scatter=0.0, amplitude=1.0, from_rest=True)  # reaches 10 rad/s
def test_healthy_joints_are_never_stopped(
    rate: int, seed: int, lag: float, scatter: float, amplitude: float, from_rest: bool
) -> None:
    """Multisines up to a quarter of the rate, filtered velocities, encoder noise, joints at rest.

    A motion begins from rest, as a run does, or in full course, as after lost replies. In that case a lag of 15 to 20
    ms at more than 6 rad/s could not be told from a fault; in any case, one of 20 ms at more than 15 rad/s.
    """
    random = Random(seed)
    lag = min(lag, 0.5 / rate) if rate < 100 else lag if from_rest else 0.7 * lag
    waves = [(random.uniform(0.1, min(5.0, rate / 4.2)), random.uniform(0, math.tau)) for _ in range(6)]
    fine = np.arange(-0.05, 6.0, 2.5e-4)
    share = np.clip(fine / RAMP_S, 0.0, 1.0)
    started = share * share * (3.0 - 2.0 * share) if from_rest else np.ones_like(fine)
    motion = amplitude / 6 * started * np.sum([np.sin(math.tau * f * fine + phase) for f, phase in waves], axis=0)
    time = np.arange(6 * rate) / rate
    moved, speed = np.interp(time, fine, motion), np.interp(time - lag, fine, np.gradient(motion, fine))
    assume(np.abs(speed).max() <= 15.0)
    look = Consistency()
    for angle, velocity in zip(moved.tolist(), speed.tolist(), strict=True):
        read = quantised(angle + random.gauss(0.0, scatter * STEP), STEP)
        assert not look.look(read, quantised(velocity, TICK), 1 / rate)


@pytest.mark.parametrize("rate", [100, 400, 1000])
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), share=st.floats(0.02, 0.5), latest=st.floats(0.001, 0.008), since=st.floats(0, 5))
@example(seed=2, share=0.3, latest=0.008, since=3.0)
def test_healthy_joints_are_not_stopped_because_exchanges_are_late(
    rate: int, seed: int, share: float, latest: float, since: float
) -> None:
    """On a busy computer, a servo measures at any time between the write and the read, which are far apart.

    share, latest: fraction of late exchanges, and their largest delay [s]. since: when the computer becomes busy [s].
    After a gap that is too long, the check begins anew, as it does in `joint_checks`.
    """
    random = Random(seed)
    look, now, last, nearly = Consistency(), 0.0, 0.0, 1e-4
    frequency, speed = random.uniform(0.3, 2.0), random.uniform(1.0, 4.0)
    waves = [(frequency * ratio, random.uniform(0, math.tau)) for ratio in (1.0, 2.3)]
    while now < 6.0:
        late = random.uniform(0.0, latest) if now > since and random.random() < share else 0.0
        measured = now + random.choice((0.0, 1.0, random.random())) * late + nearly
        angle = sum(speed / 2 / (math.tau * f) * math.sin(math.tau * f * measured + phase) for f, phase in waves)
        velocity = sum(speed / 2 * math.cos(math.tau * f * measured + phase) for f, phase in waves)
        if now - last > 3 / rate:
            look.lost()
        assert not look.look(quantised(angle, STEP), quantised(velocity, TICK), now - last, late)
        last, done = now, now + late + 2 * nearly
        now = max(now + 1 / rate, done)


def test_after_a_lost_reply_it_begins_anew() -> None:
    look = Consistency()
    for index in range(400):
        assert not look.look(0.01 * index, 4.0, 0.0025)
    look.lost()
    assert not look.look(9.0, 4.0, 0.0025), "the motion during lost replies is not checked here"
    for index in range(400):
        assert not look.look(9.0 + 0.01 * (index + 1), 4.0, 0.0025)


@pytest.mark.parametrize("rate", [100, 400, 1000])
@pytest.mark.parametrize(("speed", "most"), [(0.25, 0.4), (-0.25, 0.5), (1.0, 0.12), (0.1, 2.0)])
def test_a_position_that_creeps_is_seen_before_it_is_far_off(rate: int, speed: float, most: float) -> None:
    begun = 4.0
    when = seen_after(
        rate,
        lambda now: learnt_motion(now)[0] + speed * max(now - begun, 0.0),
        lambda now: learnt_motion(now)[1],
    )
    assert 0.0 < when - begun <= most


@pytest.mark.parametrize("rate", [100, 400])
def test_a_slow_creep_is_seen_before_the_position_is_far_off(rate: int) -> None:
    """In a long memory of little over a second it would stay below what rounding may cause."""
    when = seen_after(
        rate,
        lambda now: 0.25 * math.sin(math.tau * now) + 0.04 * max(now - 3.0, 0.0),
        lambda now: 0.25 * math.tau * math.cos(math.tau * now),
    )
    assert 4.0 < when <= 5.5


@pytest.mark.parametrize(("rate", "most"), [(100, 3.5), (400, 2.6), (1000, 2.6)])
@pytest.mark.parametrize(("speed", "begun"), [(0.035, 0.55), (0.04, 1.3), (-0.04, 1.3)])
def test_a_creep_that_begins_in_the_first_moments_is_seen_before_the_position_is_far_off(
    rate: int, speed: float, begun: float, most: float
) -> None:
    """What a velocity's bias may be is known before the creep, which cannot widen it afterwards."""
    when = seen_after(
        rate,
        lambda now: learnt_motion(now)[0] + speed * max(now - begun, 0.0),
        lambda now: learnt_motion(now)[1],
    )
    assert 0.5 < when - begun <= most


def filtered(lag: float, rate: int, since: float = 0.0, before: float = 0.0) -> Callable[[float], float]:
    """The velocity of `learnt_motion` through a first-order filter of this lag [s] from `since` on."""
    state = [learnt_motion(0.0)[1]]

    def velocity(now: float) -> float:
        time_constant = lag if now >= since else before
        kept = math.exp(-1 / rate / time_constant) if time_constant else 0.0
        state[0] = kept * state[0] + (1.0 - kept) * learnt_motion(now)[1]
        return state[0]

    return velocity


@pytest.mark.parametrize("rate", [100, 400, 1000])
@pytest.mark.parametrize(("before", "after"), [(0.0, 0.021), (0.006, 0.028)])
def test_a_lag_of_the_velocity_that_changes_is_seen(rate: int, before: float, after: float) -> None:
    """Any servo may have had the new lag from the start; but no servo's filter changes."""
    when = seen_after(rate, lambda now: learnt_motion(now)[0], filtered(after, rate, since=1.0, before=before))
    assert 1.0 < when <= 1.4


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("lag", [0.004, 0.012, 0.025])
def test_a_lag_that_a_servo_always_had_is_accepted(rate: int, lag: float) -> None:
    assert seen_after(rate, lambda now: learnt_motion(now)[0], filtered(lag, rate)) == math.inf


@pytest.mark.parametrize("speed", [0.047, 0.11])
def test_a_velocity_that_is_rounded_towards_zero_in_a_long_motion_one_way_is_accepted(speed: float) -> None:
    assert seen_after(100, lambda now: speed * now, lambda _: TICK * int(speed / TICK)) == math.inf


def test_a_velocity_that_is_rounded_downwards_is_accepted() -> None:
    look = Consistency()
    for index in range(3000):
        velocity = TICK * math.floor(0.25 * math.tau * math.cos(math.tau * 0.01 * index) / TICK)
        assert not look.look(quantised(0.25 * math.sin(math.tau * 0.01 * index), STEP), velocity, 0.01)


def test_a_velocity_that_jumps_between_samples_is_accepted() -> None:
    """Teeth that change sides: where in the interval they do is unknown, and adds up at random."""
    random = Random(5)
    look, position = Consistency(), 0.0
    former = 0.0
    for index in range(2000):
        velocity = 1.5 * (-1) ** (index // 20) * random.uniform(0.8, 1.2) if index % 20 == 0 else former
        share = random.uniform(0.0, 1.0)
        position += 0.01 * (share * former + (1.0 - share) * velocity)
        assert not look.look(position, velocity, 0.01)
        former = velocity


@pytest.mark.parametrize("scale", [1.25, 0.8, 1.1])
def test_a_position_that_is_scaled_contradicts_its_velocity(scale: float) -> None:
    def position(now: float) -> float:
        origin = learnt_motion(4.0)[0]
        own = learnt_motion(now)[0]
        return own if now < 4.0 else origin + scale * (own - origin)

    assert 4.0 < seen_after(100, position, lambda now: learnt_motion(now)[1]) < 5.5


@pytest.mark.parametrize(("lag", "scale"), [(0.03, 0.0), (0.0, 0.055), (0.02, -0.05), (0.01, 0.03)])
def test_lag_and_scale_error_that_a_servo_always_had_are_accepted(lag: float, scale: float) -> None:
    def velocity(now: float) -> float:
        late = now - lag
        return (1.0 + scale) * (0.4 * math.tau * math.cos(math.tau * late) + 0.2 * 5.3 * math.cos(5.3 * late))

    assert seen_after(400, lambda now: learnt_motion(now)[0], velocity) == math.inf


class _Reference:
    """The memory of one time constant, recomputed from everything added so far."""

    def __init__(self, seconds: float, first: float) -> None:
        self.seconds, self.first = seconds, first
        self.rows: list[tuple[float, ...]] = []

    def of(self) -> dict[str, float]:
        kept = np.array([max(1.0 - row[3] / self.seconds, 0.0) for row in self.rows])
        weight = np.array([np.prod(kept[index + 1 :]) for index in range(len(kept))])
        moved, difference, velocity, _, curved, unknown = np.array(self.rows).T
        high = low = self.first
        for each, keep in zip(velocity, kept, strict=True):
            high, low = max(each, keep * high + (1 - keep) * each), min(each, keep * low + (1 - keep) * each)
        return {
            "apart": weight @ difference,
            "far": weight @ moved,
            "mean": (weight * (1 - kept)) @ velocity + weight[0] * kept[0] * self.first,
            "span": high - low,
            "curved": (weight * curved).max(),
            "unknown": weight @ unknown,
        }


def test_both_memories_and_what_is_learnt_are_what_their_definitions_say() -> None:
    """Compared with sums over all samples and a least-squares fit, for a motion that curves, at uneven intervals."""
    random = Random(1)
    look, now, before, former = Consistency(), 0.0, 0.0, 0.0
    short = long = _Reference(SHORT_S, 0.0)
    waiting: list[tuple[float, ...]] = []
    updates: list[tuple[float, float, float, float]] = []
    learnt: tuple[float, ...] = ()
    done = since = 0.0
    for index in range(1100):
        seconds = random.choice((0.002, 0.0025, 0.004)) if index else 0.0
        now += seconds
        position, velocity = learnt_motion(now)[0] * 1.01, learnt_motion(now)[1]
        unsure = random.choice((0.0, 1e-5))
        assert not look.look(position, velocity, seconds, unsure)
        if not index:
            short, long = _Reference(SHORT_S, velocity), _Reference(LONG_S, velocity)
        else:
            moved = position - former
            row = (moved, moved - 0.5 * (velocity + before) * seconds, velocity, seconds)
            curved = CURVED * seconds * abs(velocity - before)
            if index == 1:
                curved = max(curved, CURVED_AT_FIRST * 0.5 * seconds * abs(velocity + before))
            row = (*row, curved, unsure * abs(velocity))
            short.rows.append(row)
            waiting.append(row)
            if sum(each[3] for each in waiting) >= LONG_EVERY_S:
                sums = [sum(each[place] for each in waiting) for place in (0, 1, 3, 5)]
                long.rows.append((*sums[:2], velocity, sums[2], max(each[4] for each in waiting), sums[3]))
                waiting = []
            memory = look.memory["short"]
            updates.append(
                tuple(float(each) for each in (velocity - memory["mean"], memory["far"], seconds, memory["apart"]))
            )
            since += seconds
            if since >= BLOCK_S:
                since = 0.0
                if done < ALL_INFORMATION:
                    learnt = _fitted(updates)
                    done = learnt[-1]
        before, former = velocity, position
    for memory, reference in ((look.memory["short"], short), (look.memory["long"], long)):
        for name, value in reference.of().items():
            assert memory[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name
    lag, scale, lag_std, scale_std, _ = learnt
    assert done > ENOUGH_INFORMATION
    assert look.memory["lag"] == pytest.approx(2 * lag + MORE_LAG_S + STDS * lag_std)
    assert look.memory["scale"] == pytest.approx(2 * scale + MORE_SCALE + STDS * scale_std)
    assert look.memory["lag"] < LAG_S and look.memory["scale"] < SCALE


def _fitted(updates: list[tuple[float, float, float, float]]) -> tuple[float, ...]:
    """Lag, scale error, their standard deviations and the information about the lag, from a weighted fit."""
    signals = np.array(updates)
    weights = np.sqrt(signals[:, 2])
    design = weights[:, None] * np.column_stack((signals[:, 0], signals[:, 1], np.ones(len(signals))))
    measured = weights * signals[:, 3]
    (lag, scale, _), *_ = solution = np.linalg.lstsq(design, measured, rcond=None)
    left = measured - design @ solution[0]
    variance = max(float(left @ left) / signals[:, 2].sum(), NOISE_RAD**2) * LASTS_S
    inverse = np.linalg.inv(design.T @ design)
    return lag, scale, math.sqrt(variance * inverse[0, 0]), math.sqrt(variance * inverse[1, 1]), 1.0 / inverse[0, 0]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_the_tolerance_is_the_sum_of_its_parts(sign: float) -> None:
    """After an interval of no duration, which changes nothing in the short memory but `apart`."""
    allowed = 0.02 + 0.05 * 2.0 + 0.003 + 0.002 + 0.25 * 0.01 * 3.0
    velocity = 1.0 + sign * 1.5
    of_lag = 0.01 * (velocity - 1.0)
    for apart, wrong in (
        (sign * (allowed + abs(of_lag)) * 0.999, False),
        (sign * (allowed + abs(of_lag)) * 1.001, True),
        (-sign * allowed * 0.999, False),
        (-sign * allowed * 1.001, True),
    ):
        look = Consistency()
        look.look(0.0, velocity, 0.0)
        short = look.memory["short"]
        short["far"], short["mean"], short["curved"], short["unknown"] = -2.0, 1.0, 0.003, 0.002
        short["highest"], short["lowest"] = 2.5, -0.5
        look.memory["lag"], look.memory["scale"] = 0.01, 0.05
        short["apart"] = apart
        assert look.look(0.0, velocity, 0.0) is wrong


@pytest.mark.parametrize(("moved", "velocities"), [(0.12, (0.0, 1.5)), (-0.09, (0.0, 0.0))])
def test_lag_and_scale_explain_part_of_a_jump(moved: float, velocities: tuple[float, float]) -> None:
    """A changing velocity may lag; a distance covered may be wrong by the scale error's share."""
    look = Consistency()
    look.look(0.0, velocities[0], 0.0)
    look.look(moved, velocities[1], 0.01, 0.001)
    change = abs(velocities[1] - velocities[0])
    known = LAG_S * change + SCALE * abs(moved) + CURVED * 0.01 * change + 0.001 * abs(velocities[1])
    steps = look.memory["steps"]
    assert steps["square"] == pytest.approx((abs(moved - 0.005 * sum(velocities)) - known) ** 2), "the first of them"
    assert steps["age"] == 0.01


def test_the_long_memory_takes_every_sample_of_100_hz() -> None:
    look = Consistency()
    for index in range(3):
        look.look(0.01 * index, 1.0, 0.01)
        assert look.memory["long"]["far"] == pytest.approx(0.01 * index, rel=0.02)


def test_a_velocity_that_was_always_a_tenth_too_high_is_more_than_a_servo_s_error() -> None:
    assert seen_after(400, lambda now: learnt_motion(now)[0], lambda now: 1.12 * learnt_motion(now)[1]) < math.inf


def test_an_interval_longer_than_a_memory_leaves_nothing_of_what_was_before() -> None:
    look = Consistency()
    look.look(0.0, 2.0, 0.0)
    look.look(0.2, 2.0, 0.1, 0.01)
    look.look(1.8, 3.0, 2 * SHORT_S, 0.0)
    short = look.memory["short"]
    assert short["far"] == pytest.approx(1.6) and short["apart"] == pytest.approx(1.6 - 2.5 * 2 * SHORT_S)
    assert (short["mean"], short["unknown"]) == (3.0, 0.0)


@pytest.mark.parametrize(("speed", "said"), [(0.8, "changed by +0.032 rad in the last 40 ms"), (0.05, "")])
def test_a_joint_that_moves_while_its_velocity_reads_zero_does_not_stand_still(speed: float, said: str) -> None:
    """Only the readings since the velocity fell to zero count: before, it moved at 2 rad/s."""
    states = [
        State(0.01 * n, 0.01 * n + 0.001, (0.0,), (0.0,), (velocity,), (position,), (0,), (False,))
        for n in range(9)
        for velocity, position in [(2.0, 0.02 * n) if n < 4 else (0.0, 0.08 + 0.01 * (n - 4) * speed)]
    ]
    assert (said in (found := moved_at_standstill(reversed(states), 0, 0.06))) and bool(found) == bool(said)
    gap = [State(-0.3, -0.299, (0.0,), (0.0,), (0.0,), (5.0,), (0,), (False,)), *states[4:]]
    assert moved_at_standstill(reversed(gap), 0, 0.06) == found, "what happened over a gap is unknown"
