"""Check on every sample that a joint's position and velocity agree.

A frozen encoder still answers, and a velocity that stays at zero is within every limit. But the integral of the
velocity must equal the change in position. The difference,

    apart = position - integral of velocity,

is tracked with three fading memories (leaky integrators): a short one, which reveals a sudden fault at once; a long
one, which reveals a gradual fault; and a slow one, which reveals creep. Encoder noise and rounding of positions do not
accumulate in this difference. The contributions that a healthy servo makes to it are known:

- a velocity that lags by tau, because the servo filters it: tau times (velocity minus its mean over the memory). Any
  lag up to `LAG_S` is accepted;
- a velocity with a scale error: the same fraction of the distance covered within the memory, at most `SCALE`;
- a velocity that is rounded towards zero, or always downwards (a servo may do either). In the slow memory, rounding
  towards zero adds one register step times the difference between the times of motion in the two directions. Rounding
  downwards adds up to half a step times the time in motion; this bias is accepted unless the motion so far rules it out
  (`hil.experiment.velocity.bias`). While the register shows zero, motion below one step does not count;
- the motion between two samples: the trapezoidal rule's errors cancel over a smooth motion, except at its ends, where a
  fraction `CURVED` of the change of velocity times the interval remains. They do not cancel where the velocity jumps:
  in the slow memory, which contains many jumps, their sum is a random walk.

Readings that jump back and forth, as with a stuck bit, cancel in these memories. The difference over each single
interval is therefore also compared with the encoder noise observed so far: `STEPS` jumps, each within `STEPS_S` of the
one before, count as a fault.

If a healthy servo reports exactly the same velocity for some time, the joint really moved at that velocity, except
perhaps during the last `LAG_S`. The distance covered before that must therefore equal velocity times time; otherwise,
the reported velocity is frozen.

Lag and scale error are properties of a servo and do not change. A lag that changes is a fault
(`hil.experiment.velocity.lag`). Once the motion has revealed lag and scale error, up to twice the estimated values are
accepted, plus `MORE_LAG_S` and `MORE_SCALE` and twice their standard deviations.

Part of the compiled loop `joint_checks`; a record of type `MEMORY` holds a joint's state.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from hil.drivers.state import State
from hil.errors import Cause, SafetyStop
from hil.estimator.compiled import embedded, inner
from hil.experiment.velocity import bias, lag

__all__ = ["MEMORY", "begin", "check_standstill", "look", "lost", "moved_at_standstill"]

SHORT_S, LONG_S, SLOW_S = 0.3, 1.2, 20.0
"""Time constants of the memories [s]."""

LONG_EVERY_S = 0.0099
"""Shortest interval after which the long and slow memories are updated [s]: the sample interval at 100 Hz, minus a
margin for rounding errors.
"""

UNSURE_RAD, LONG_UNSURE_RAD, SLOW_UNSURE_RAD = 0.02, 0.045, 0.04
"""Tolerances of the memories [rad]. They allow for rounding, encoder noise and, except in the slow memory, a velocity
that is rounded towards zero.
"""

LAG_S = 0.03
MORE_LAG_S = 0.008
STDS = 2.0
"""Number of standard deviations by which the estimates of lag and scale error may be wrong."""

BIAS_LAG_S, BIAS_SCALE, BIAS_LAG_SHARE = 0.002, 0.005, 0.1
"""Constants of the check for creep. The first two are added to the standard deviations of lag and scale error [s, 1].
The last one allows for a lag that is not a pure delay, as a fraction of the lag times the range of velocities.
"""

_LAG_SHARE = 0.25
"""Allowance for a lag that is not a pure delay, as a fraction of the lag times the range of velocities."""

STEP_RAD, STEP_TIMES = 0.0077, 7.0
"""Smallest difference between the change of position and the integral of velocity that counts as a jump [rad] (five
ticks), and its smallest ratio to the RMS of ordinary differences.
"""

STEPS, STEPS_S = 4, 0.5
"""Number of jumps that counts as a fault, and the longest time between one jump and the next [s]."""

BLOCK_S = 0.0099
"""Shortest interval between two stored values of the distance covered while the velocity reading is unchanged [s]. The
latest three values span `LAG_S`.
"""

SLOW_RAD_S, RESOLUTION_RAD_S = 0.3, 0.025
"""Velocity below which the reading may stay the same while a joint sticks and slips, and resolution of the velocity
register [rad/s].
"""

LONGEST_GAP_S = 0.06
"""If two exchanges are farther apart than this [s], the velocity in between counts as unknown. Even at 20 Hz, the
interval is shorter.
"""

SCALE, MORE_SCALE = 0.06, 0.02
CURVED = 0.35
"""Allowance for the velocity between samples, as a fraction of its change times the interval. The fastest wave that is
used has only four samples per period and needs 0.27.
"""

ROUGH_TIMES = 2.0
"""Allowance of the slow memory for a velocity that jumps between samples, as when gears cross their backlash. An error
is estimated for each sample: `CURVED` times the interval times the difference between successive velocity changes. The
allowance is this multiple of the root sum of squares of these errors. A jump within an interval causes an RMS error of
0.29 times the jump times the interval, and appears in two of the differences.
"""

CURVED_AT_FIRST = 0.3
"""Allowance for the first interval, as a fraction of the motion. Around the peak of a wave with four samples per
period, two successive samples may have the same velocity, and there is no earlier change to compare with.
"""


_FADING = np.dtype(
    [(name, "f8") for name in ("apart", "far", "mean", "span", "curved", "unknown", "highest", "lowest")]
)
"""A fading memory.

apart: position minus integral of velocity [rad]. far: distance covered [rad]. mean, span: mean and range of the
velocity [rad/s]. curved: uncertainty due to the motion between samples [rad]. unknown: uncertainty due to the times of
the measurements [rad].
"""

_STEPS = np.dtype([("square", "f8"), ("age", "f8"), ("since", "f8"), ("count", "f8")])
"""Jumps in the position readings of a joint.

square: mean square of the ordinary differences [rad^2]. age: time since the start [s]. count: number of jumps in quick
succession. since: time since the latest one [s].
"""

_SAME = np.dtype(
    [(name, "f8") for name in ("seconds", "moved", "unknown", "since", "count", "d1", "t1", "d2", "t2", "d3", "t3")]
)
"""Motion since the velocity reading last changed.

seconds, moved, unknown: time, change of position and its uncertainty [s, rad, rad]. since: time since values were last
stored [s]. count: number of values stored so far. d1, t1 to d3, t3: the latest three stored values of `moved` and
`seconds`.
"""

MEMORY = np.dtype(
    [
        *((name, "f8") for name in ("position", "velocity", "unsure")),
        *((name, "f8") for name in ("seconds", "moved", "difference", "unknown", "most_curved")),
        *((name, "f8") for name in ("turn", "seen", "headed", "heading", "moving")),
        *((name, "f8") for name in ("behind", "rough", "roughness")),
        *((name, "f8") for name in ("learnt", "lag", "scale")),
        *bias.FIELDS,
        ("lags", lag.LAGS),
        ("steps", _STEPS),
        ("same", _SAME),
        ("short", _FADING),
        ("long", _FADING),
        ("slow", _FADING),
    ]
)
"""State of the check of one joint.

position, velocity, turn: latest values, and latest change of velocity [rad, rad/s]; the position is NaN before the
first one and after a long gap. unsure: uncertainty of the time of the latest measurement [s]. seconds, moved,
difference, unknown: sums since the long memory was last updated; most_curved: largest uncertainty due to the motion
between samples since then. seen: `difference`, except for motion that is too slow for the velocity register; behind:
position relative to a reference that follows such motion [rad]. headed: time of motion in the positive direction minus
time of motion in the negative direction, since that update [s]. rough: sum of squares of the errors that velocity jumps
may have caused since then [rad^2]. heading, roughness, moving: `headed`, `rough` and the time in motion, accumulated in
the slow memory [s, rad^2, s]. learnt: information about the lag when lag and scale error were last estimated [rad^2/s].
lag, scale: their largest accepted values [s, 1]. The remaining fields hold the range of the bias and the sums from
which lag and scale error are estimated.
"""


def begin(memory: Any) -> None:
    """Initialise a zero-filled record."""
    memory["position"] = np.nan
    bias.begin(memory)
    memory["lag"], memory["scale"] = LAG_S, SCALE


def look(memory: Any, position: float, velocity: float, seconds: float, unsure: float) -> bool:
    """Process the latest sample, `seconds` after the previous one. Returns whether it is inconsistent.

    unsure: excess duration of its exchange [s], which is the uncertainty of the measurement time.
    """
    former, before, also_unsure = memory.position, memory.velocity, memory.unsure
    memory.position, memory.velocity, memory.unsure = position, velocity, unsure
    short = memory.short
    unknown = unsure * abs(velocity)
    if np.isnan(former):
        _restart(short, velocity, unknown)
        _restart(memory.long, velocity, unknown)
        _restart(memory.slow, velocity, unknown)
        memory.turn = memory.heading = memory.roughness = 0.0
        memory.moving = memory.behind = 0.0
        _forget_sums(memory)
        _begin_same(memory.same)
        _forget_block(memory.lags)
        return False
    moved = position - former
    turned = abs(velocity - before)
    difference = moved - 0.5 * (before + velocity) * seconds
    curved = CURVED * seconds * turned
    if short.far == 0.0 and short.curved == 0.0:
        curved = max(curved, CURVED_AT_FIRST * 0.5 * seconds * abs(before + velocity))
    # A late measurement shortens the next interval by as much as it lengthens its own.
    at_both_ends = unknown + also_unsure * abs(before)
    known = LAG_S * turned + SCALE * abs(moved) + curved + at_both_ends
    if _has_jumped(memory.steps, abs(difference) - known, seconds):
        return True
    if velocity != before or abs(velocity) < SLOW_RAD_S:
        _begin_same(memory.same)
    elif _is_frozen(memory.same, moved, velocity, seconds, at_both_ends, memory.scale):
        return True
    _add(short, SHORT_S, moved, difference, velocity, seconds, curved, unknown)
    if _is_wrong(short, short.apart, UNSURE_RAD, velocity, memory.lag, memory.scale):
        return True
    if not unsure > seconds and _add_to_lags(memory.lags, velocity - short.mean, short.far, short.apart, seconds):
        return True
    # The long memories process several intervals at once, so that the short intervals at a high rate are not lost in
    # rounding.
    memory.moved += moved
    memory.difference += difference
    jumped = CURVED * seconds * (velocity - before - memory.turn)
    memory.turn = velocity - before
    memory.rough += jumped * jumped
    heads = before + velocity
    if heads != 0.0:
        memory.headed += seconds if heads > 0.0 else -seconds
        memory.moving += seconds
        memory.seen += difference
    else:
        memory.seen += _moved_at_rest(memory, moved, seconds)
    memory.unknown += unknown
    memory.most_curved = max(memory.most_curved, curved)
    memory.seconds += seconds
    if memory.seconds >= LONG_EVERY_S and _looks_long(memory, velocity):
        return True
    if memory.lags.information != memory.learnt:
        _learn(memory)
    return False


def lost(memory: Any) -> None:
    """Restart the check at the next reply, because too many replies are missing."""
    memory.position = np.nan


def moved_at_standstill(states: Iterable[State], joint: int, still: float) -> str:
    """Describe how far a joint moved while its velocity was reported to be below `still` [rad/s]; "" if not at all.

    states: the latest states, the most recent first.
    """
    said, last, later = "", None, None
    for state in states:
        # During a gap, the joint may have moved at any velocity.
        is_gap = later is not None and later.time_before_write - state.time_before_write > LONGEST_GAP_S
        if is_gap or not abs(state.velocity[joint]) < still:
            break
        last, later = state if last is None else last, state
        seconds = last.time_before_write - state.time_before_write
        moved = last.position[joint] - state.position[joint]
        if abs(moved) > STEP_RAD + still * seconds:
            said = f"its position has changed by {moved:+.3f} rad in the last {1e3 * seconds:.0f} ms"
    return said


def check_standstill(name: str, states: Iterable[State], joint: int, still: float) -> None:
    """Raise SafetyStop if a joint moved while its velocity was reported to be below `still` [rad/s].

    states: as in `moved_at_standstill`.
    """
    states = list(states)
    if moved := moved_at_standstill(states, joint, still):
        raise SafetyStop(
            f"{name} reports a velocity of {states[0].velocity[joint]:+.2f} rad/s that contradicts its position: "
            f"{moved}. One of the two readings is wrong. Check the encoder and its magnet; replace the servo if "
            "necessary.",
            Cause.FROZEN,
        )


def _looks_long(memory: Any, velocity: float) -> bool:
    """Add the intervals since the last call to the long memories; return whether either shows a disagreement."""
    long, slow, seconds = memory.long, memory.slow, memory.seconds
    moved, difference, unknown = memory.moved, memory.difference, memory.unknown
    _add(long, LONG_S, moved, difference, velocity, seconds, memory.most_curved, unknown)
    _add(slow, SLOW_S, moved, memory.seen, velocity, seconds, memory.most_curved, 0.0)
    slow.unknown = long.unknown  # as above: the next interval cancels the error
    fades = min(seconds / SLOW_S, 1.0)
    memory.heading += memory.headed - fades * memory.heading
    memory.moving -= fades * memory.moving
    memory.roughness += memory.rough - fades * memory.roughness
    of_rounding, of_jumps = RESOLUTION_RAD_S * abs(memory.heading), ROUGH_TIMES * np.sqrt(memory.roughness)
    creeps = memory.learnt > 0.0 and _creeps(memory, velocity, of_rounding + of_jumps)
    apart = _unexplained(memory, slow.apart, memory.moving)
    unsure = SLOW_UNSURE_RAD + of_jumps
    _forget_sums(memory)
    return bool(
        creeps
        or _is_wrong(long, long.apart, LONG_UNSURE_RAD, velocity, memory.lag, memory.scale)
        or (
            _is_wrong(slow, apart, unsure, velocity, memory.lag, memory.scale)
            and _is_wrong(slow, slow.apart, unsure + of_rounding, velocity, memory.lag, memory.scale)
        )
    )


def _creeps(memory: Any, velocity: float, unsure: float) -> bool:
    """Whether the position creeps, given the known velocity errors.

    unsure: allowance for rounding and jumps [rad].
    """
    slow, lags = memory.slow, memory.lags
    of_lag = velocity - slow.mean
    lag_error, scale_error = BIAS_LAG_S + STDS * lags.lag_std, BIAS_SCALE + STDS * lags.scale_std
    known = BIAS_LAG_SHARE * abs(lags.lag) * slow.span + lag_error * abs(of_lag) + scale_error * abs(slow.far)
    errors = max(NOISE_RAD, NOISE_TIMES * lags.noise) + known + slow.curved + memory.unknown + unsure
    return bool(_look_at_bias(memory, slow.apart - lags.lag * of_lag - lags.scale * slow.far, errors, memory.moving))


def _moved_at_rest(memory: Any, moved: float, seconds: float) -> float:
    """Process an interval in which the velocity reads zero; return the motion that contradicts this [rad].

    A reference follows the position at a speed of up to one step of the velocity register. Where this is too slow, the
    reference jumps, so that it is never more than `STEP_RAD` away from the position. The jump is returned. A sum of all
    large position changes would accumulate encoder noise. A sum of these jumps does not, because the noise always
    returns to its mean.
    """
    slow = RESOLUTION_RAD_S * seconds
    behind = memory.behind + moved
    behind -= min(max(behind, -slow), slow)
    memory.behind = min(max(behind, -STEP_RAD), STEP_RAD)
    return float(behind - memory.behind)


def _forget_sums(memory: Any) -> None:
    memory.seconds = memory.moved = memory.difference = memory.unknown = memory.most_curved = 0.0
    memory.seen = memory.headed = memory.rough = 0.0


def _learn(memory: Any) -> None:
    """From now on, accept a multiple of the estimated lag and scale error, not the largest values of any servo."""
    lags = memory.lags
    memory.learnt = lags.information
    memory.lag = min(LAG_S, 2.0 * max(lags.lag, 0.0) + MORE_LAG_S + STDS * lags.lag_std)
    memory.scale = min(SCALE, 2.0 * abs(lags.scale) + MORE_SCALE + STDS * lags.scale_std)


def _begin_same(same: Any) -> None:
    same.seconds = same.moved = same.unknown = same.since = same.count = 0.0


def _is_frozen(same: Any, moved: float, velocity: float, seconds: float, unknown: float, scale: float) -> bool:
    """Process an interval over which the velocity has not changed; return whether its reading is frozen.

    moved, unknown: change of position and its uncertainty [rad]. scale: largest accepted scale error.
    """
    same.seconds += seconds
    same.moved += moved
    same.unknown += unknown
    same.since += seconds
    if same.since < BLOCK_S:
        return False
    notes = np.ceil(LAG_S / same.since - 0.05)
    covered, time = same.d1, same.t1
    if notes >= 2.0:
        covered, time = same.d2, same.t2
    if notes >= 3.0:
        covered, time = same.d3, same.t3
    known = same.count >= notes
    same.d3, same.t3, same.d2, same.t2 = same.d2, same.t2, same.d1, same.t1
    same.d1, same.t1 = same.moved, same.seconds
    same.count += 1.0
    same.since = 0.0
    allowed = UNSURE_RAD + scale * abs(covered) + RESOLUTION_RAD_S * time + same.unknown
    return bool(known and abs(covered - velocity * time) > allowed)


def _has_jumped(steps: Any, step: float, seconds: float) -> bool:
    """Process the unexplained part of the difference over one interval [rad]; return whether jumps are too frequent."""
    if seconds <= 0.0:
        return False
    steps.since += seconds
    steps.age += seconds
    beyond = max(step, 0.0)
    square = beyond * beyond
    most = max(STEP_RAD * STEP_RAD, STEP_TIMES * STEP_TIMES * steps.square)
    if square > most and steps.age > SHORT_S:  # before that, the usual differences are being learnt
        steps.count = steps.count + 1.0 if steps.since < STEPS_S else 1.0
        steps.since = 0.0
        square = most
    steps.square += seconds / min(steps.age, LONG_S) * (square - steps.square)
    return bool(steps.count >= STEPS)


def _restart(fading: Any, velocity: float, unknown: float) -> None:
    fading.apart = fading.far = fading.span = fading.curved = 0.0
    fading.unknown = unknown
    fading.mean = fading.highest = fading.lowest = velocity


def _add(
    fading: Any,
    time_constant: float,
    moved: float,
    difference: float,
    velocity: float,
    seconds: float,
    curved: float,
    unknown: float,
) -> None:
    """Add one interval of `seconds`, at the end of which the joint has `velocity`.

    moved: change of position [rad]. difference: this change minus the integral of velocity [rad]. curved, unknown:
    uncertainties of the difference [rad]; only `unknown` accumulates.
    """
    kept = 1.0 - seconds / time_constant if seconds < time_constant else 0.0
    new = 1.0 - kept
    fading.apart = kept * fading.apart + difference
    fading.far = kept * fading.far + moved
    fading.unknown = kept * fading.unknown + unknown
    fading.curved = max(kept * fading.curved, curved)
    fading.mean += new * (velocity - fading.mean)
    fading.highest = max(kept * fading.highest + new * velocity, velocity)
    fading.lowest = min(kept * fading.lowest + new * velocity, velocity)
    fading.span = fading.highest - fading.lowest


def _is_wrong(fading: Any, apart: float, unsure: float, velocity: float, lag: float, scale: float) -> bool:
    """Whether position and velocity disagree.

    apart: their difference in this memory, minus any known bias [rad]. unsure: tolerance of this memory [rad]. lag,
    scale: largest accepted lag [s] and scale error.
    """
    allowed, of_lag = _explained(fading, unsure, velocity, lag, scale)
    if of_lag > 0.0:
        return bool(apart > allowed + of_lag or apart < -allowed)
    return bool(apart > allowed or apart < of_lag - allowed)


def _explained(fading: Any, unsure: float, velocity: float, lag: float, scale: float) -> tuple[float, float]:
    """Return the difference accepted in either direction, and the offset due to the largest lag [rad]."""
    allowed = unsure + scale * abs(fading.far) + fading.curved + fading.unknown + _LAG_SHARE * lag * fading.span
    return allowed, lag * (velocity - fading.mean)


_explained = embedded(_explained)
_restart, _add, _is_wrong, _has_jumped, _forget_sums, _begin_same, _is_frozen = map(
    embedded, (_restart, _add, _is_wrong, _has_jumped, _forget_sums, _begin_same, _is_frozen)
)
NOISE_RAD, NOISE_TIMES, _look_at_bias, _unexplained = bias.NOISE_RAD, bias.NOISE_TIMES, bias.look, bias.unexplained
_add_to_lags, _forget_block = lag.add, lag.forget
_creeps, _moved_at_rest = map(embedded, (_creeps, _moved_at_rest))
_looks_long, _learn = map(embedded, (_looks_long, _learn))
look, lost = map(inner, (look, lost))
