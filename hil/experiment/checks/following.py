"""Check that a motor carries the commanded current, using the current (or voltage) reported in each reply.

A servo that loses its torque in the middle of a run (reboot, watchdog, another program) carries no current, whatever is
commanded. All thresholds are relative to the planned peak.

On every sample, two hypotheses are compared by a sequential test (E. S. Page, "Continuous inspection schemes",
Biometrika 41 (1954) 100): the current is the one commanded, or it is zero. Their log likelihood ratio, for errors of
standard deviation sigma, grows by

    [(distance from the commanded current)^2 - (distance from zero)^2] / (2 sigma^2)

per sample. The step is bounded so that no single reply decides. Any value between the last two goals counts as the
commanded current, because a reading may be taken before or after the motor follows the latest goal. A scale error of up
to `GAIN_ERROR` is also accepted.

Successive errors may be correlated, so each sample is weighted by the time that it represents. The unweighted sum must
also reach h = `LEAST_RATIO`. Starting from any given check, the probability that a healthy motor's sum ever reaches h
is at most exp(-h).

If all readings freeze while a joint stands still and its current equals its goal, seconds may pass before the goal is
far from the frozen value. But a motor's current follows its goal: if the readings of position, velocity and current all
stay exactly the same although the goals that they may reflect (those of the last `ANSWERS_S`) have changed, they are
frozen. A constant sensor error cancels in this comparison.

A current sensor may be noisier than assumed. Its noise is therefore measured at constant goals, while the arm rests
before the start (`current_noise`), and sigma is at least as large as this noise. With a noisy sensor, a loss of torque
is thus detected later, but a healthy motor does not stop the run.

Part of the compiled loop `joint_checks`; a record of type `MEMORY` holds a joint's state.
"""

from typing import Any

import numpy as np

from hil.config.joint import JointConfig
from hil.estimator.compiled import inner

__all__ = ["GOALS", "MEMORY", "allow_noise", "begin", "is_frozen", "look", "seen_above", "usual_sigma"]

GAIN_ERROR = 0.2
"""Largest scale error of a current sensor."""

SIGMA_SHARE = 0.05
"""Standard deviation of errors other than the scale error, relative to the planned peak."""

SIGMA_TICKS = 2.0
"""Lower bound on the standard deviation of current errors, in register ticks."""

ALLOWED_TICKS = 4.0
"""Lower bound on the accepted deviation, in register ticks."""

LOST_AFTER_S = 0.03
"""Time for which a current must look like zero, at full weight, before it counts as zero [s]."""

_FULL_WEIGHT = 5.0
"""Upper bound on the log likelihood ratio of one sample: its value if zero is measured at a goal of four sigma."""

LEAST_RATIO = 10.0
"""Log likelihood ratio at which a current counts as zero, however low the rate."""

NOISY_RATIO = 16.0
"""Replaces `LEAST_RATIO` if the measured noise of a sensor exceeds what is usually assumed; most sensors have far less
noise than that.
"""

_FEWEST = 2
"""Minimum number of successive samples that must differ from the goal before the deviation counts, however low the
rate.
"""

ALLOWED_SIGMAS = 4.0
"""A deviation within this multiple of the measured noise is accepted."""

_SOON_S = 0.1
"""Time within which lost torque should be detected [s]."""

ANSWERS_S, _BLOCKS = 0.03, 3
"""A reading may reflect any goal of the last `ANSWERS_S` [s], which are divided into `_BLOCKS` blocks."""

_BLOCK_S = 0.99 * ANSWERS_S / _BLOCKS  # at 100 Hz, a sample is a block despite rounding errors

GOALS = np.dtype(
    [(name, "f8") for name in ("most", "carried", "same_for", "age", "lowest", "highest")]
    + [("low", "f8", (_BLOCKS + 1,)), ("high", "f8", (_BLOCKS + 1,))]
)
"""Constant and state of the check for frozen readings of one joint.

most: largest change of the goal for which all readings may stay the same [A or V]. carried, same_for: current, and
how long all readings have been the same [s]. age: age of the latest block [s]. low, high: smallest and largest goal in
each block, the latest first. lowest, highest: smallest upper and largest lower limit of the goal ranges that
the readings may have reflected since they last changed.
"""

MEMORY = np.dtype(
    [
        *((name, "f8") for name in ("per_square", "least_ratio", "allowed", "share", "follow_time")),
        *((name, "f8") for name in ("former_goal", "evidence", "ratio", "count", "differs_for", "differs")),
    ]
)
"""Constants and state of the check of one joint.

per_square: 1 / (2 sigma^2). least_ratio: log likelihood ratio at which a current counts as zero. allowed: accepted
deviation [A or V]; share: the same, relative to the goal; follow_time: how long a larger deviation may last [s].
evidence, ratio, count: sums of the log likelihood ratios, weighted by time [s] and unweighted, and their number.
differs_for, differs: duration [s] of the present deviation and its number of samples.
"""


def begin(memory: Any, goals: Any, joint: JointConfig, planned: float, follow_share: float, follow_time: float) -> None:
    """Set the constants of `memory` and `goals`, zero-filled records.

    planned: the joint's largest goal [A, or V in PWM mode]. follow_share, follow_time: the [safety] settings of the
    same names.
    """
    memory["share"] = follow_share
    memory["follow_time"] = follow_time
    allow_noise(memory, goals, joint, planned, follow_share, 0.0)


def usual_sigma(joint: JointConfig, planned: float) -> float:
    """Return the standard deviation of current errors assumed for any sensor [A or V]."""
    return max(SIGMA_SHARE * planned, SIGMA_TICKS * abs(joint.joint.drive_unit(12.0)))


def allow_noise(memory: Any, goals: Any, joint: JointConfig, planned: float, follow_share: float, noise: float) -> None:
    """Set the thresholds for readings with this standard deviation [A or V]. Other arguments: as for `begin`."""
    tick = abs(joint.joint.drive_unit(12.0))
    usual = usual_sigma(joint, planned)
    memory["per_square"] = 0.5 / max(usual, noise) ** 2
    memory["least_ratio"] = LEAST_RATIO if noise <= usual else NOISY_RATIO
    noisy = ALLOWED_SIGMAS * noise
    scaled = min(GAIN_ERROR, follow_share) * planned
    memory["allowed"] = max(follow_share * planned, ALLOWED_TICKS * tick, scaled + noisy)
    # Because of a scale error, the current may change less than the goal; rounding hides up to one tick.
    goals["most"] = (max(SIGMA_SHARE * planned, ALLOWED_TICKS * tick, noisy) + tick) / (1.0 - GAIN_ERROR)


def seen_above(memory: Any, interval: float) -> float:
    """Return the smallest goal [A or V] at which lost torque is detected within 0.1 s.

    interval: time between two exchanges [s].
    """
    needed = max(memory["least_ratio"] * interval, _FULL_WEIGHT * LOST_AFTER_S) / _SOON_S
    return float(np.sqrt(needed / memory["per_square"]) / (1.0 - GAIN_ERROR))


def look(memory: Any, goal: float, carried: float, seconds: float) -> float:
    """Process a reply; return the duration of a deviation once it has lasted too long [s], otherwise -1.

    goal: latest goal [A or V]. carried: measured value in the reply [A or V]. seconds: time since the last reply [s].
    """
    former, memory.former_goal = memory.former_goal, goal
    low, high = min(goal, former), max(goal, former)
    off = max(low - carried, carried - high, 0.0)
    error = GAIN_ERROR * (abs(low) if carried < low else abs(high))
    beyond = max(off - error, 0.0)
    gain = (beyond * beyond - carried * carried) * memory.per_square
    gain = max(min(gain, _FULL_WEIGHT), -_FULL_WEIGHT)
    evidence = memory.evidence + gain * seconds
    if evidence > 0.0:
        memory.evidence = evidence
        memory.ratio += gain
        memory.count += 1.0
        if evidence >= _FULL_WEIGHT * LOST_AFTER_S and memory.ratio >= memory.least_ratio:
            return float(memory.count * seconds)
    else:
        memory.evidence = memory.ratio = memory.count = 0.0
    # A stabiliser may command more than was planned.
    if off <= memory.allowed or off <= memory.share * abs(goal):
        memory.differs_for = memory.differs = 0.0
        return -1.0
    memory.differs_for += seconds
    memory.differs += 1.0
    if memory.differs_for >= memory.follow_time and memory.differs >= _FEWEST:
        return float(memory.differs_for)
    return -1.0


def is_frozen(goals: Any, goal: float, carried: float, seconds: float, stands: bool) -> bool:
    """Process a reply; return whether all readings have stayed the same although the goals have changed.

    goal, carried, seconds: as for `look`. stands: whether position and velocity are exactly those of the last reply,
    and no reply was missed in between.
    """
    goals.age += seconds
    if goals.age >= _BLOCK_S:
        for block in range(_BLOCKS, 0, -1):
            goals.low[block], goals.high[block] = goals.low[block - 1], goals.high[block - 1]
        goals.age, goals.low[0], goals.high[0] = 0.0, goal, goal
    goals.low[0], goals.high[0] = min(goals.low[0], goal), max(goals.high[0], goal)
    low, high = goals.low.min(), goals.high.max()
    if not stands or carried != goals.carried:
        goals.carried, goals.same_for, goals.lowest, goals.highest = carried, 0.0, high, low
        return False
    goals.same_for += seconds
    goals.lowest, goals.highest = min(goals.lowest, high), max(goals.highest, low)
    return bool(goals.highest - goals.lowest > goals.most)


look, is_frozen = map(inner, (look, is_frozen))
