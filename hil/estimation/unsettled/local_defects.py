"""Locate and classify the parts of a recording that the fitted model explains much worse than the rest.

The kinds are frozen readings, missing torques, single wrong samples, and impacts on end stops.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array, Mask
from hil.estimator.data.recording import Recording

FAR_ABOVE = 10.0  # residual of a window or stretch, relative to the usual residual of its joint
ABOVE_NOISE = 5.0  # the same, relative to the noise
MOST_WINDOWS = 0.3  # largest fraction of windows far above; with more, the defect is not local
SHORTEST, FEWEST = 0.2, 10  # minimum duration [s] and number of samples of a constant value
MOST_STRETCHES = 5  # if there are more constant stretches, they are normal for this joint or these commands
SPIKE_NOISES, SPIKE_USUAL, USUAL_QUANTILE = 20.0, 10.0, 0.95
LONG = 1.5  # a duration of five neighbouring samples above this, relative to the usual one, indicates a gap
MOST_SPIKES = 0.05  # if a larger fraction of the samples seems wrong, none of them is reported
IMPACT_TIME = 0.01  # s; time over which the velocities before and after an impact are measured
IMPACT_USUAL, IMPACT_STEPS = 4.0, 20.0  # minimum change of velocity: relative to the usual one, in encoder steps
FEWEST_IMPACTS = 3
SAME_PLACE = 0.02  # width of one place, as a fraction of the range of motion
SHOWN = 3


@dataclass(frozen=True)
class _Joint:
    """One joint of a recording, with the residual of the fit. name: the joint's name in messages."""

    name: str
    time: Array
    position: Array
    torque: Array
    residual: Array
    usual: float
    noise: float
    step: float

    def is_unexplained(self, part: slice) -> bool:
        """Whether the residual in `part` is far above its usual level."""
        inside = self.residual[part]
        known = np.isfinite(inside)
        if not known.any():
            return False
        return float(np.sqrt(np.mean(inside[known] ** 2))) > max(FAR_ABOVE * self.usual, ABOVE_NOISE * self.noise)


def local_defects(
    recordings: Sequence[Recording], names: Sequence[str], predicted: Sequence[Array], window: float
) -> tuple[str, ...]:
    """One sentence for each local defect; for use if a fit leaves much of the motion unexplained.

    predicted: simulated positions of each recording (joints, samples) [rad]. window: length of the parts whose
    residuals are compared [s].
    """
    joints = list(_joints(recordings, names, predicted, window))
    return tuple(
        said for each in joints for said in _frozen(each) or _silent(each, joints) or _spikes(each) or _stop(each)
    )


def local_residual(
    recordings: Sequence[Recording], names: Sequence[str], predicted: Sequence[Array], window: float
) -> tuple[str, ...]:
    """One sentence for each joint whose residual is far above its usual value in a few places; arguments as in
    `local_defects`.
    """
    return tuple(said for each in _joints(recordings, names, predicted, window) for said in _windows(each, window))


def _joints(
    recordings: Sequence[Recording], names: Sequence[str], predicted: Sequence[Array], window: float
) -> Iterator[_Joint]:
    for number, (recording, motion) in enumerate(zip(recordings, predicted, strict=True)):
        prefix = f"{names[number]}, " if len(recordings) > 1 and len(names) == len(recordings) else ""
        residual = recording.position - motion
        for joint in range(recording.joints):
            levels = _levels(recording.time, residual[joint], window)[1]
            yield _Joint(
                f"{prefix}joint {joint + 1}",
                recording.time,
                recording.position[joint],
                recording.torque[joint],
                residual[joint],
                float(np.median(levels)) if levels.size else np.inf,
                float(recording.noise[joint]),
                float(recording.position_step[joint]),
            )


def _levels(time: Array, residual: Array, window: float) -> tuple[Array, Array]:
    """Starts [s] and RMS residuals of windows, omitting those that were not simulated."""
    known = np.isfinite(residual)
    number = np.floor((time[known] - time[0]) / window).astype(int)
    if not number.size:
        return np.empty(0), np.empty(0)
    count = np.bincount(number)
    square = np.bincount(number, residual[known] ** 2)
    seen = count > 0
    return time[0] + window * np.flatnonzero(seen), np.sqrt(square[seen] / count[seen])


def _constant(time: Array, values: Array) -> list[slice]:
    """Stretches in which a value stays exactly the same for a long time; empty if there are many."""
    edges = np.flatnonzero(np.diff(values) != 0.0) + 1
    starts, ends = np.concatenate(([0], edges)), np.concatenate((edges, [values.size]))
    long = (ends - starts >= FEWEST) & (time[ends - 1] - time[starts] >= SHORTEST)
    found = [slice(int(start), int(end)) for start, end in zip(starts[long], ends[long], strict=True)]
    return found if len(found) <= MOST_STRETCHES else []


def _frozen(joint: _Joint) -> list[str]:
    return [
        f"The position of {joint.name} stays at {joint.position[part.start]:.4g} rad {_from_to(joint.time, part)}, "
        "although the rest of the recording shows that the joint should move: the reading was frozen, or something "
        "held the joint. Leave that part out."
        for part in _constant(joint.time, joint.position)
        if joint.is_unexplained(part)
    ]


def _silent(joint: _Joint, joints: Sequence[_Joint]) -> list[str]:
    together = [each for each in joints if each.time is joint.time]
    return [
        f"The torque of {joint.name} stays at {joint.torque[part.start]:.4g} N m {_from_to(joint.time, part)}, but the "
        "motion contradicts this: the column lacks the torque that acted at that time. Leave that part out."
        for part in _constant(joint.time, joint.torque)
        if any(each.is_unexplained(part) for each in together)
    ]


def _spikes(joint: _Joint) -> list[str]:
    """Single samples that are far from both neighbours, and from a smooth motion through them."""
    known = np.flatnonzero(np.isfinite(joint.position))
    if known.size < FEWEST:
        return []
    time, values = joint.time[known], joint.position[known]
    windows = np.lib.stride_tricks.sliding_window_view
    span = np.ptp(windows(np.pad(time, 2, mode="edge"), 5), axis=1)
    away = np.abs(values - np.median(windows(np.pad(values, 2, mode="edge"), 5), axis=1))
    far = away > max(SPIKE_NOISES * joint.noise, SPIKE_USUAL * float(np.quantile(away, USUAL_QUANTILE)))
    # A wrong sample also moves the medians of its neighbours.
    found = far & (away > 0.5 * windows(np.pad(away, 2), 5).max(axis=1))
    found &= (span < LONG * np.median(span)) & _departs(time, values, found, SPIKE_NOISES * joint.noise)
    spikes = known[found]
    if not 0 < spikes.size <= MOST_SPIKES * known.size:
        return []
    value = float(np.median(joint.position[spikes]))
    same = np.mean(np.abs(joint.position[spikes] - value) <= joint.step) > 0.5
    where = f", most at {value:.4g} rad" if same and spikes.size > 1 else ""
    return [
        f"Single positions of {joint.name} are far from their neighbours: {spikes.size} of {known.size} samples"
        f"{where}, {_at(joint.time[spikes])}. Remove these samples, or leave their fields empty."
    ]


def _departs(time: Array, values: Array, doubtful: Mask, least: float) -> Mask:
    """Return which `doubtful` samples (samples,) differ by more than `least` from the cubic through their neighbours.

    At a reversal, samples lie beyond their neighbours but still on the same smooth curve.
    """
    departs = np.zeros_like(doubtful)
    sound = np.flatnonzero(~doubtful)
    if sound.size < 4:
        return doubtful
    at = np.flatnonzero(doubtful)
    first = np.clip(np.searchsorted(sound, at) - 2, 0, sound.size - 4)
    near = sound[first[:, None] + np.arange(4)]
    smooth = np.zeros(at.size)
    for i in range(4):
        others = [j for j in range(4) if j != i]
        weight = np.prod(
            [(time[at] - time[near[:, j]]) / (time[near[:, i]] - time[near[:, j]]) for j in others], axis=0
        )
        smooth += weight * values[near[:, i]]
    departs[at] = np.abs(values[at] - smooth) > least
    return departs


def _stop(joint: _Joint) -> list[str]:
    """Repeated impacts at one angle, which the joint never passes."""
    known = np.isfinite(joint.position)
    time, position = joint.time[known], joint.position[known]
    lag = max(1, round(IMPACT_TIME / float(np.median(np.diff(time)))))
    velocity = (position[lag:] - position[:-lag]) / (time[lag:] - time[:-lag])
    change = velocity[lag:] - velocity[:-lag]
    if not change.size:
        return []
    usual = float(np.quantile(np.abs(change), USUAL_QUANTILE))
    least = max(IMPACT_USUAL * usual, IMPACT_STEPS * joint.step / IMPACT_TIME)
    margin = SAME_PLACE * float(np.ptp(position))
    found = []
    for side in (1, -1):
        hits = np.flatnonzero(
            (side * velocity[:-lag] > 0.0) & (side * velocity[lag:] <= 0.0) & (-side * change > least)
        )
        groups = [each for each in np.split(hits, np.flatnonzero(np.diff(hits) > 3 * lag) + 1) if each.size]
        at = np.array([int(each[np.argmax(np.abs(change[each]))]) + lag for each in groups], dtype=np.int64)
        if at.size < FEWEST_IMPACTS:
            continue
        angles = side * np.array([(side * position[k - lag : k + lag + 1]).max() for k in at])
        place = float(np.median(angles))
        if np.abs(angles - place).max() > margin or (side * (position[at[0] :] - place)).max() > margin:
            continue
        found.append(
            f"{joint.name[0].upper()}{joint.name[1:]} rebounds at {place:.4g} rad {at.size} times, {_at(time[at])}, "
            "and never moves past it: it hits an end stop or an object there, and no model covers impacts. Use the "
            "part before the first impact, or record motion that stays clear of it."
        )
    return found


def _windows(joint: _Joint, window: float) -> list[str]:
    starts, levels = _levels(joint.time, joint.residual, window)
    bad = levels > max(FAR_ABOVE * joint.usual, ABOVE_NOISE * joint.noise)
    if not 0.0 < float(np.mean(bad)) <= MOST_WINDOWS:
        return []
    groups = np.split(starts[bad], np.flatnonzero(np.diff(starts[bad]) > 1.5 * window) + 1)
    parts = ", ".join(f"{each[0]:.4g} to {each[-1] + window:.4g} s" for each in groups[:SHOWN])
    more = f" and {len(groups) - SHOWN} more" if len(groups) > SHOWN else ""
    times = float(levels[bad].max()) / max(joint.usual, 1e-12)
    return [
        f"The residual of {joint.name} is up to {times:.0f} times its usual value in {parts}{more}: something else "
        "acted on the arm there, or the recording is wrong. Inspect that part, or leave it out."
    ]


def _from_to(time: Array, part: slice) -> str:
    return f"from {time[part.start]:.3f} to {time[part.stop - 1]:.3f} s"


def _at(times: Array) -> str:
    shown = ", ".join(f"{each:.3f}" for each in times[:SHOWN])
    return f"at {shown} s" if len(times) <= SHOWN else f"the first at {shown} s"
