"""Currents that differ from the commanded ones: they were clipped, or this program's goals did not cause them.

A clipped current is smaller than a large goal, follows a small one, and never opposes its goal. Any other deviation has
another cause: goals were altered in transit or by another program, or the reported current is wrong.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array, Mask
from hil.runs.recording import Phase

LARGE = 0.5
"""Goals above this fraction of the largest one count as large; smaller ones reveal little about clipping."""

SHORT = 0.85
"""A current counts as clipped if it is below this fraction of the commanded one."""

OFTEN = 0.05
"""Clipping is reported if it affects more than this fraction of the samples with large goals."""

_RECENT = 4
"""Number of most recent goals that a lagging current may still be following."""

_BEYOND, _BEYOND_OFTEN = 0.25, 0.02
"""A current counts as different from the commanded one if it is outside the range spanned by 0 and all recent goals by
more than its noise and by more than this fraction of the largest goal. A warning is given if the fraction of such
samples exceeds the second value.
"""

_SIGMAS = 3.0
"""Largest deviation of a reading that is attributed to noise, in standard deviations."""

_QUANTILE, _OF_NORMAL = 0.25, 0.3186
"""Noise is estimated from this quantile of its magnitude, because goals that are altered occasionally must not count as
noise. The second value is the same quantile for the standard normal distribution.
"""

_FEWEST_AT_REST = 30
"""Minimum number of consecutive readings at a constant goal for measuring their noise."""

_SMALL, _LEAST = 0.5, 0.1
"""Highest and lowest goals that cannot be clipped but are large enough to evaluate, relative to the largest measured
current.
"""


@dataclass(frozen=True)
class CurrentFindings:
    """Problems with the currents of a recording.

    warnings: one sentence per joint whose current was not the commanded one. disturbances: a sentence for the verdict
    if a current was neither the commanded one nor merely clipped.
    """

    warnings: tuple[str, ...]
    disturbances: tuple[str, ...]


def current_findings(config: Config, samples: NDArray[np.void]) -> CurrentFindings:
    """Compare the currents in `samples` with the commanded ones."""
    return _findings(config, samples, np.ones(len(samples), bool))


def _findings(config: Config, samples: NDArray[np.void], judged: Mask) -> CurrentFindings:
    """Like `current_findings`, but only for the samples in `judged`; the others only help to measure the noise."""
    lower = "current_limit" if config.experiment.pilot else "peak_torque"
    warnings, names = [], []
    for name, every_goal, every in _currents(config, samples):
        goal, measured, margin = every_goal[judged], every[judged], _SIGMAS * _noise(every_goal, every)
        if said := _other(name, goal, measured, margin):
            names.append(name)
        if said := said or _clipped(name, goal, measured, margin, lower):
            warnings.append(said)
    disturbance = (
        f"The current of {' and '.join(names)} was not the commanded one (see the warning), so the values, especially "
        "offsets and friction, may be off by more than their standard errors."
    )
    return CurrentFindings(tuple(warnings), (disturbance,) if names else ())


def settled_current_findings(config: Config, samples: NDArray[np.void]) -> CurrentFindings:
    """Like `current_findings`, but only for the periodic samples, on which a settled estimate is based."""
    return _findings(config, samples, samples["phase"] == Phase.PERIODIC)


def _currents(config: Config, samples: NDArray[np.void]) -> list[tuple[str, Array, Array]]:
    """Name, goals and currents of each joint that is driven by current and measures its motor current."""
    return [
        (joint.name, samples["goal_current"][:, index], samples["current"][:, index])
        for index, joint in enumerate(config.joints)
        if joint.drive_mode is Mode.CURRENT and not joint.joint.servo.senses_supply
    ]


def _noise(goal: Array, measured: Array) -> float:
    """Standard deviation of a current reading, estimated from the recording.

    It is the larger of two values: the scatter at constant goals, and the scatter of the deviation from the goals (or
    of that deviation's second difference, if smaller). Since the current may lag the goal by a few samples, the lag
    that leaves the smallest deviation is used.
    """
    count = len(goal) - _RECENT
    if count < _RECENT:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(goal, _RECENT)
    at_rest = np.flatnonzero(np.ptp(windows, axis=1) == 0.0) + _RECENT - 1
    # The arm may be held by one current at the start and by another at the end.
    parts = np.split(measured[at_rest], np.flatnonzero(np.diff(at_rest) > 1) + 1)
    levelled = [part - np.nanmedian(part) for part in parts if np.isfinite(part).sum() >= _FEWEST_AT_REST]
    still = _sigma(np.concatenate(levelled)) if levelled else 0.0
    lagging = [measured[_RECENT:] - goal[_RECENT - lag :][:count] for lag in range(_RECENT)]
    moving = min(min(_sigma(each), _sigma(np.diff(each, 2)) / 6.0**0.5) for each in lagging)
    return float(max(still, moving))


def _sigma(errors: Array) -> float:
    known = np.abs(errors[np.isfinite(errors)])
    return float(np.quantile(known, _QUANTILE)) / _OF_NORMAL if len(known) else 0.0


def _other(name: str, goal: Array, measured: Array, margin: float) -> str:
    """Describe a current that was not the commanded one; "" if it was, or was merely clipped."""
    if len(goal) < _RECENT or not goal.any():
        return ""
    recent = np.lib.stride_tricks.sliding_window_view(goal, _RECENT)
    low, high = np.minimum(recent.min(axis=1), 0.0), np.maximum(recent.max(axis=1), 0.0)
    late = measured[_RECENT - 1 :]
    away = np.maximum(low - late, late - high)
    beyond = float(np.mean(away > max(_BEYOND * np.abs(goal).max(), margin)))
    why = (
        "goals were altered in transit or by another program, or its current sensor is wrong. Make sure that nothing "
        "else commands the servos, and record again."
    )
    if beyond > _BEYOND_OFTEN:
        return (
            f"{name} carried a current opposite to the commanded one, or larger than it, in {100 * beyond:.0f} % "
            f"of the samples: {why}"
        )
    part = _short_part(goal, measured, margin)
    if part > OFTEN and _follows_small_goals(goal, measured) < SHORT:
        return (
            f"{name} received less than {100 * SHORT:.0f} % of the commanded current in {100 * part:.0f} % of the "
            f"high-torque samples, and just as little at low torque, where nothing clips it: {why}"
        )
    return ""


def _clipped(name: str, goal: Array, measured: Array, margin: float, lower: str) -> str:
    """Describe a motor that receives less current than commanded because its supply sags or its servo limits it."""
    part = _short_part(goal, measured, margin)
    if part <= OFTEN:
        return ""
    return (
        f"{name} received less than {100 * SHORT:.0f} % of the commanded current in {100 * part:.0f} % of the "
        "high-torque samples. If the reading is right, the current is clipped by the servo's own limit or, at speed, "
        f"by the supply voltage: lower {lower} or raise the supply voltage."
    )


def _least(goal: Array) -> Array:
    """The smaller magnitude of two successive goals, which the motor has had time to reach; 0 if the signs differ.

    A sample's current responds to the previous sample's goal, and a current loop that merely lags must not count as
    clipping.
    """
    return np.asarray(np.minimum(np.abs(goal[1:]), np.abs(goal[:-1])) * (goal[1:] * goal[:-1] > 0.0))


def _short_part(goal: Array, measured: Array, margin: float) -> float:
    """Fraction of the samples with large goals whose current is too small."""
    least = _least(goal)
    large = (least > LARGE * np.abs(goal).max()) & np.isfinite(measured[1:])
    if not large.any():
        return 0.0
    return float(np.mean(np.abs(measured[1:])[large] < np.minimum(SHORT * least, least - margin)[large]))


def _follows_small_goals(goal: Array, measured: Array) -> float:
    """Ratio of the measured to the commanded current while the goal is far below the motor's largest current."""
    least = _least(goal)
    most = np.nanquantile(np.abs(measured), 0.99)
    small = (least > _LEAST * most) & (least < _SMALL * most) & np.isfinite(measured[1:])
    if not small.any():
        return 1.0
    along = measured[1:][small] * np.sign(goal[1:][small])
    return float(np.sum(along * least[small]) / np.sum(least[small] ** 2))
