"""Warnings about an estimate from unsettled data; each names the joint and a remedy."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimation.unsettled.slips import unexplained
from hil.estimator.baselines.signs import suspect_signs
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.models.terms import kind_of
from hil.estimator.selection.segment_verdict import relative_std
from hil.estimator.selection.verdict import MUCH_LEFT

LEAST_SWING = 30.0  # encoder steps
LOST = 0.01  # fraction of missing samples above which a warning is given
MANY_TURNS = 2.0
FLAT = 0.05  # fraction of samples at the largest torque that suggests clipping; for a sine wave, it is smaller
LEFT = 0.1  # largest usable RMS residual, relative to the motion's RMS
CERTAIN, LEAST_EARLY = 4.0, 0.1  # smallest negative delay that is reported: standard errors, intervals
EQUAL, MOSTLY = 0.1, 0.9  # limit on a step's deviation from whole intervals; minimum fraction of steps within it
WEAK, UNSEEN = 0.5, 10.0  # standard error, relative to the value, of a weak and of an undetermined parameter

UNITS_ADVICE = "check the units, signs and zero of position and torque; then try shorter segments"


@dataclass(frozen=True)
class Doubts:
    """Sentences: faults make the estimate unusable, doubts mean that it may be wrong, and warnings merely inform."""

    faults: tuple[str, ...]
    doubts: tuple[str, ...]
    warnings: tuple[str, ...]
    reason: str = ""
    """The faults in brief, phrased as the end of a sentence."""


def doubts_of(
    recordings: Sequence[Recording],
    estimate: ShootingEstimate,
    cause_known: bool = False,
    gravity: bool = True,
    unknown_zeros: bool = False,
) -> Doubts:
    """Find signs of errors in the recordings, or in how the estimate explains them.

    cause_known: whether the verdict says why much of the motion is unexplained. gravity: whether gravity acts in the
    arm's plane. unknown_zeros: whether nobody has stated the zeros of the angles.
    """
    faults, doubts, warnings = _signs(recordings, unknown_zeros), [], _rows(recordings)
    reasons = ["a sign is reversed (see the warning)"] if faults else []
    for joint in range(estimate.model.joints):
        name = f"Joint {joint + 1}"
        warnings += _motion(recordings, joint, name)
        doubts += _turns(recordings, joint, name)
        warnings += _flat(recordings, joint, name, float(estimate.residual_over_noise.max()) > MUCH_LEFT)
        motion = float(np.sqrt(np.mean([np.var(each.filled()[joint]) for each in recordings])))
        left = float(estimate.residual_rms[joint]) / motion
        if left > LEFT:
            advice = "the verdict names the cause" if cause_known else UNITS_ADVICE
            reasons.append(f"the fit leaves {100 * left:.2g} % of the motion of joint {joint + 1} unexplained")
            faults.append(
                f"{name}: the fit leaves {100 * left:.2g} % of the motion unexplained, so do not use these numbers: "
                f"{advice}."
            )
    early = [] if cause_known else _early(recordings, estimate)
    shown = (*warnings, *early, *_weak(recordings, estimate, gravity))
    return Doubts(tuple(faults), tuple(doubts), shown, " and ".join(reasons))


def _signs(recordings: Sequence[Recording], unknown_zeros: bool) -> list[str]:
    suspicion = suspect_signs(recordings, unknown_zeros)
    if suspicion is None:
        return []
    subject, several = suspicion.signs.said(), suspicion.signs.are_several
    seem, changed = ("seem", "these signs") if several else ("seems", "the sign")
    negative = f"; as given, {', '.join(suspicion.impossible)} would be negative" if suspicion.impossible else ""
    return [
        f"{subject.capitalize()} {seem} to be reversed: with {changed} changed, "
        f"{unexplained(suspicion.residual, suspicion.residual_given)}{negative}. Correct this in "
        "the file."
    ]


def _rows(recordings: Sequence[Recording]) -> list[str]:
    """Detect rows that are missing from otherwise regular time steps, apart from gaps."""
    steps = [np.diff(each.time)[np.diff(each.time) < each.longest_interval] / each.interval for each in recordings]
    step = np.concatenate(steps)
    whole = np.round(step)
    lost = 1.0 - step.size / max(float(whole.sum()), 1.0)
    if lost <= LOST or np.mean(np.abs(step - whole) < EQUAL) < MOSTLY:
        return []
    return [
        f"{100 * lost:.2g} % of the rows are missing: the torques of these rows are unknown, "
        "which increases the residual. Log every row."
    ]


def _motion(recordings: Sequence[Recording], joint: int, name: str) -> list[str]:
    found = []
    swing = max(float(np.ptp(each.filled()[joint])) for each in recordings)
    steps = swing / max(float(each.position_step[joint]) for each in recordings)
    if steps < LEAST_SWING:
        found.append(
            f"{name} moved by only {steps:.0f} encoder steps: rounding errors dominate its parameters; use more torque."
        )
    lost = 1.0 - float(np.mean(np.concatenate([np.isfinite(each.position[joint]) for each in recordings])))
    if lost > LOST:
        found.append(f"{name}: {100 * lost:.1f} % of its positions are missing.")
    return found


def _turns(recordings: Sequence[Recording], joint: int, name: str) -> list[str]:
    turns = max(float(np.ptp(each.filled()[joint])) for each in recordings) / (2.0 * np.pi)
    if turns <= MANY_TURNS:
        return []
    return [f"{name} seems to have moved {turns:.0f} turns. If it did not, the unit of its positions is wrong."]


def _flat(recordings: Sequence[Recording], joint: int, name: str, unexplained: bool) -> list[str]:
    """Detect a torque that was clipped at its largest value; a commanded torque is allowed to stay constant if that
    explains the motion.
    """
    for each in recordings:
        size = np.abs(each.torque[joint])
        at_most = float(np.mean(size > 0.9999 * size.max()))
        if (each.between == "linear" or unexplained) and FLAT < at_most < 0.9:
            return [
                f"{name}: its torque stays at {size.max():.3g} N m in {100 * at_most:.0f} % of the samples. If the "
                "current was clipped, use the measured current, or record with less torque."
            ]
    return []


def _early(recordings: Sequence[Recording], estimate: ShootingEstimate) -> list[str]:
    """Detect a torque that is logged after it acted: its fitted delay is negative."""
    if "delay" not in estimate.names:
        return []
    index = estimate.names.index("delay")
    delay, std = float(estimate.value[index]), float(estimate.std[index])
    intervals = -delay / float(np.median([each.interval for each in recordings]))
    if delay + CERTAIN * std >= 0.0 or intervals < LEAST_EARLY:
        return []
    return [
        f"The delay is negative, {1e3 * delay:.3g} ms ({intervals:.2g} samples): the torque acted before the time at "
        "which it is logged, or the positions are logged too early. The fit allows for this. Correct the times, or "
        "shift the torque column, before you use the delay."
    ]


def _weak(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool) -> list[str]:
    """Name the base parameters with a large relative error, except those whose torque is known to be negligible."""
    relative = relative_std(recordings, estimate, gravity)
    count = len(estimate.model.base_names)
    known = zip(estimate.names[:count], estimate.value, estimate.std, strict=False)
    torque = float(np.sqrt(np.mean([np.mean(each.torque**2) for each in recordings])))
    least = {"gravity": torque if gravity else np.inf, "offset": np.inf}
    weak = [
        f"{name} ({100 * std / abs(value):.0f} %)" if std < UNSEEN * abs(value) else f"{name} (not at all)"
        for name, value, std in known
        if std > WEAK * max(abs(value), least.get(kind_of(name), 0.0)) and relative.get(name, 0.0) > WEAK
    ]
    if not weak:
        return []
    return [f"Poorly identified from this motion: {', '.join(weak)}. Faster, wider motion of each joint would help."]
