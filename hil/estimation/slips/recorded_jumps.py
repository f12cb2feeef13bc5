"""Jumps of a recorded position that no smooth motion explains, for recordings without a velocity.

Around each interval between samples, a cubic with a step is fitted to the positions; the step is compared with those
at other intervals.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimation.slips.position_jumps import FAR_OUTSIDE, LEAST_STEPS, USUAL_QUANTILE
from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.data.recording import Recording

SIDE = 5  # number of samples on either side of an interval
ORDER = 3  # order of the polynomial that describes a smooth motion over these samples
LEAST_NOISES = 20.0  # standard deviations of the noise; about six encoder steps if the noise is due to rounding
FEWEST = 200  # samples
EVEN, MOST_UNEVEN = 1.01, 4.0  # longest interval around a jump, relative to the usual one: if even, if usable
AT_ONCE = 20_000  # number of uneven windows processed at once; each takes 1 kB
BETTER = 0.25  # largest sum of squared residuals with a step, relative to that with a bad reading or a kink


@dataclass(frozen=True)
class Jump:
    """A jump of `size` [rad] at `time` [s]. joint, recording: indices, counted from 0."""

    recording: int
    joint: int
    time: float
    size: float


def recorded_jumps(recordings: Sequence[Recording]) -> list[Jump]:
    """All jumps, in the order of the recordings, joints and times."""
    return [
        Jump(number, joint, time, size)
        for number, recording in enumerate(recordings)
        for joint in range(recording.joints)
        for time, size in _jumps(recording, joint)
    ]


def jump_sentences(
    recordings: Sequence[Recording], names: Sequence[str], stepped: Sequence[bool], joints: Sequence[str] = ()
) -> tuple[str, ...]:
    """One sentence for each joint whose position jumped in a recording.

    names: names of the recordings. stepped: whether each joint's encoder step is known. joints: names of the joints.
    """
    grouped: dict[tuple[int, int], list[Jump]] = {}
    for jump in recorded_jumps(recordings):
        grouped.setdefault((jump.recording, jump.joint), []).append(jump)
    return tuple(
        _sentence(jumps, names[number], joints[joint] if joints else f"Joint {joint + 1}", step)
        for (number, joint), jumps in grouped.items()
        for step in [float(recordings[number].position_step[joint]) if stepped[joint] else None]
    )


def _sentence(jumps: Sequence[Jump], recording: str, joint: str, step: float | None) -> str:
    largest = max(jumps, key=lambda jump: abs(jump.size))
    steps = "" if step is None else f" ({abs(largest.size) / step:.0f} encoder steps)"
    others = f" ({len(jumps)} jumps in all)" if len(jumps) > 1 else ""
    return (
        f"{recording}: {joint}: the position jumps by {largest.size:+.3f} rad{steps} at {largest.time:.3f} s{others}, "
        "between two samples. No motion explains this; all later positions are shifted. Check the horn's screws, the "
        "encoder's magnet and the cable, then record again, or use only the part before or after the jump."
    )


def _jumps(recording: Recording, joint: int) -> list[tuple[float, float]]:
    read = np.isfinite(recording.position[joint])
    time, position = recording.time[read], recording.position[joint][read]
    if len(time) < FEWEST:
        return []
    interval = recording.interval
    longest = np.lib.stride_tricks.sliding_window_view(np.diff(time), 2 * SIDE - 1).max(axis=1)
    usable = longest <= MOST_UNEVEN * interval
    sizes = np.where(usable, _steps(time, position, longest > EVEN * interval), 0.0)
    usual = float(np.quantile(np.abs(sizes[usable]), USUAL_QUANTILE)) if usable.any() else np.inf
    noise = float(recording.noise[joint])
    threshold = max(LEAST_STEPS * float(recording.position_step[joint]), LEAST_NOISES * noise, FAR_OUTSIDE * usual)
    found: list[tuple[float, float]] = []
    for place in np.flatnonzero(np.abs(sizes) > threshold).tolist():
        near = slice(max(0, place - SIDE), place + SIDE + 1)
        if abs(sizes[place]) < np.abs(sizes[near]).max():
            continue
        window = slice(place, place + 2 * SIDE)
        if _is_step(time[window], position[window], noise):
            found.append((float(time[place + SIDE]), float(sizes[place])))
    return found


def _steps(time: Array, position: Array, uneven: Mask) -> Array:
    """The step [rad] in the middle of each window of 2 * SIDE samples. uneven: mask of the windows with unequal
    intervals.
    """
    windows = np.lib.stride_tricks.sliding_window_view
    sizes = np.correlate(position, _weights(np.arange(2.0 * SIDE)[None, :])[0], mode="valid")
    places = np.flatnonzero(uneven)
    for first in range(0, places.size, AT_ONCE):
        some = places[first : first + AT_ONCE]
        weights = _weights(windows(time, 2 * SIDE)[some])
        sizes[some] = np.sum(weights * windows(position, 2 * SIDE)[some], axis=1)
    return sizes


def _weights(time: Array) -> Array:
    """Weights (windows, 2 * SIDE) that, applied to the positions at `time` (same shape), give the step."""
    at = time - 0.5 * (time[:, SIDE - 1 : SIDE] + time[:, SIDE : SIDE + 1])
    at = at / (time[:, -1:] - time[:, :1])
    design = np.stack((*(at**order for order in range(ORDER + 1)), at > 0.0), axis=-1)
    return np.asarray(linalg.pinv(design)[:, -1])


def _is_step(time: Array, position: Array, noise: float) -> bool:
    """Whether a step in the middle fits the positions much better than one bad reading or an impact (a kink) does."""
    at = (time - 0.5 * (time[SIDE - 1] + time[SIDE])) / (time[-1] - time[0])
    smooth = [at**order for order in range(ORDER + 1)]

    def left(*terms: Array) -> float:
        design = np.column_stack((*smooth, *terms))
        residual = position - design @ linalg.lstsq(design, position, rcond=None)[0]
        return float(residual @ residual)

    readings = (left((np.arange(at.size) == k).astype(float)) for k in range(at.size))
    kinks = (left(np.maximum(at - place, 0.0)) for place in (*at[1:-1], *(0.5 * (at[1:-2] + at[2:-1]))))
    floor = at.size * noise**2
    return bool(left((at > 0.0).astype(float)) < BETTER * (min(*readings, *kinks) + floor))
