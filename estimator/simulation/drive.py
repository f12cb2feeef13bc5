"""Motor torque from the commanded torque: held, delayed, and averaged over each integration step."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, embedded


def motor_torque(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float | Array, lag: float | Array
) -> Array:
    """Return the mean motor torque (joints, samples, steps) [N m] over each of the `steps` steps that follow a sample.

    The means are exact, even for a step in which the command changes.

    Args:
        command: periodic command (joints, samples) [N m], each value held until the next.
        rate: sampling rate [1/s].
        command_to_sample: time from command k's effect to sample k [s].
        steps: integration steps per sample.
        delay: delay of the torque [s], one value or one per joint.
        lag: time constant of a subsequent first-order lag [s], one value or one per joint.
    """
    return _torque(command, rate, command_to_sample, steps, delay, lag)[0]


def torque_and_slopes(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float | Array, lag: float | Array
) -> tuple[Array, Array]:
    """Return `motor_torque` and its derivatives (2, joints, samples, steps) [N m/s] with respect to delay and lag.

    Without a lag, the two derivatives are equal, as they are in the limit of a small lag.
    If a command changes exactly at the edge of a step and there is no lag, the derivative with respect to delay is
    one-sided, towards smaller delays.
    """
    torque, late, change = _torque(command, rate, command_to_sample, steps, delay, lag)
    return torque, np.stack((late, change))


def _torque(
    command: Array, rate: float, command_to_sample: float, steps: int, delay: float | Array, lag: float | Array
) -> tuple[Array, Array, Array]:
    """Return the mean torque over each step, and its derivatives with respect to delay and lag."""
    joints, samples = command.shape
    total = np.zeros((joints, samples + 1))
    np.cumsum(command, axis=1, out=total[:, 1:])
    delays, lags = (np.resize(np.asarray(each, dtype=np.float64), joints) for each in (delay, lag))
    edges = np.arange(steps + 1) / (steps * rate) + command_to_sample - delays[:, None]
    shifts = np.floor(edges * rate)
    phases = edges - shifts / rate
    fading = np.where(lags[:, None] > 0.0, np.exp(-phases / np.where(lags > 0.0, lags, 1.0)[:, None]), 0.0)
    torque, late, change = (np.empty((joints, samples, steps)) for _ in range(3))
    lagging = np.empty((2, samples))
    _average(
        *(
            np.ascontiguousarray(command),
            total,
            rate,
            lags,
            shifts.astype(np.int64),
            phases,
            fading,
        ),
        *(lagging, torque, late, change),
    )
    return torque, late, change


# Compiled code takes its arguments by position. For joint j, edge i of each sample's steps lies `phases[j, i]` [s]
# after the command that is `shifts[j, i]` commands later; `fading[j, i]` is the fraction of the lag's deviation that
# then remains.
def _average_loop(
    command: Any,
    total: Any,
    rate: float,
    lags: Any,
    shifts: Any,
    phases: Any,
    fading: Any,
    lagging: Any,
    torque: Any,
    late: Any,
    change: Any,
) -> None:
    joints, samples, steps = torque.shape
    per_time = steps * rate
    for j in range(joints):
        lag = lags[j]
        _follow(command, j, rate, lag, lagging)
        for k in range(samples):
            gathered_before = present_before = by_lag_before = 0.0
            for i in range(steps + 1):
                turns, at = shifts[j, i] // samples, shifts[j, i] % samples + k
                if at >= samples:
                    turns, at = turns + 1, at - samples
                held = command[j, at]
                # Integral of the held command since command 0.
                gathered = (turns * total[j, samples] + total[j, at]) / rate + held * phases[j, i]
                left = (lagging[0, at] - held) * fading[j, i]
                present = held + left
                by_lag = left * phases[j, i] / (lag * lag) + lagging[1, at] * fading[j, i] if lag > 0.0 else 0.0
                if i > 0:
                    # lag y' = u - y, integrated over a step: the mean of y is that of u minus the change stored by the
                    # lag.
                    stored = (present - present_before) * per_time
                    torque[j, k, i - 1] = (gathered - gathered_before) * per_time - lag * stored
                    late[j, k, i - 1] = -stored
                    change[j, k, i - 1] = -stored - lag * (by_lag - by_lag_before) * per_time
                gathered_before, present_before, by_lag_before = gathered, present, by_lag


def _follow(command: Any, j: int, rate: float, lag: float, lagging: Any) -> None:
    """Compute joint j's lagging torque, which is periodic, at each command, and its derivative with respect to lag.

    The result is written to `lagging` (2, samples). The torque obeys y[k + 1] = a y[k] + (1 - a) u[k]; the steady state
    follows from the value after one period that starts at zero.
    """
    samples = command.shape[1]
    a = math.exp(-1.0 / (rate * lag)) if lag > 0.0 else 0.0
    a_by_lag = a / (rate * lag * lag) if lag > 0.0 else 0.0
    y = by_a = 0.0
    for turn in range(2):
        for k in range(samples):
            u = command[j, k]
            lagging[0, k], lagging[1, k] = y, by_a * a_by_lag
            y, by_a = a * y + (1.0 - a) * u, a * by_a + y - u
        if turn == 0:
            left = a**samples
            y /= 1.0 - left
            by_a = (by_a + samples * a ** (samples - 1) * y) / (1.0 - left)


_follow = embedded(_follow)
_average: Callable[..., None] = compiled(_average_loop)
