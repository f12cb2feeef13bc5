"""Reasons why a fit leaves much of the motion unexplained, if the recording reveals any."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimation.unsettled.agreement import disagreement
from hil.estimation.unsettled.defects import defect_said, is_certain, is_other_arm, likely_defect
from hil.estimation.unsettled.local_defects import local_defects, local_residual
from hil.estimation.unsettled.slips import unexplained
from hil.estimator.arrays import Array
from hil.estimator.baselines.torque_faults import (
    Clipped,
    Stop,
    suspect_clipped,
    suspect_drift,
    suspect_late,
    suspect_stop,
    suspect_uneven,
)
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.selection.verdict import MUCH_LEFT

CHANGES = ("step", "linear", "decay")  # time courses of defects within a recording


@dataclass(frozen=True)
class Fitted:
    """Fits of recordings. predicted: simulated positions of each recording (joints, samples) [rad]. plain: estimate of
    a model without terms that could imitate a defect. estimate: estimate of the chosen model. gravity: gravity in the
    arm's plane [m/s^2]. repeats: whether each recording is the mean of similar periods.
    """

    recordings: Sequence[Recording]
    names: Sequence[str]
    predicted: Sequence[Array]
    plain: ShootingEstimate
    estimate: ShootingEstimate
    gravity: float
    repeats: bool = False


def causes(fitted: Fitted) -> tuple[str, ...]:
    """Sentences about the cause: a defect of whole recordings, recordings that disagree, a local defect, a clipped
    torque or a clock that drifts. If none is found, they say where the residual is large.
    """
    recordings, names, estimate = fitted.recordings, fitted.names, fitted.estimate
    defect = likely_defect(recordings, fitted.plain, estimate, fitted.gravity > 0.0)
    if fitted.repeats and defect is not None and defect.hypothesis.course.kind in CHANGES:
        defect = None  # a change while the arm moves would make periods differ
    said = () if defect is None else (defect_said(defect, names),)
    if defect is not None and is_certain(defect) and not is_other_arm(defect):
        return said
    apart = disagreement(recordings, names, estimate, estimate.segment_length, estimate.zeros.size > 0)
    if apart or (defect is not None and is_certain(defect)):
        return apart or said
    if float(estimate.residual_over_noise.max()) <= MUCH_LEFT:
        return said
    where = recordings, names, fitted.predicted, estimate.segment_length
    found = local_defects(*where) or _stopped_or_clipped(recordings) or _late(recordings) or _drifting(recordings)
    return found or said or _uneven(recordings) or local_residual(*where)


def are_known(fitted: Fitted, found: tuple[str, ...]) -> bool:
    """Whether `found`, from `causes`, names a cause, not just places where the residual is large."""
    where = fitted.recordings, fitted.names, fitted.predicted, fitted.estimate.segment_length
    return bool(found) and found != local_residual(*where)


def _stopped_or_clipped(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Sentences about an end stop or about clipped torques, whichever leaves less of the torque unexplained."""
    stop, clipped = suspect_stop(recordings), suspect_clipped(recordings)
    if stop is None or any(each.residual < stop.residual for each in clipped if each.joint == stop.joint):
        return _clipped(recordings, clipped)
    return (_stop_said(stop),)


def stop_in(recordings: Sequence[Recording]) -> str:
    """Return a sentence about a joint that seems to press against an end stop; "" if there is none."""
    stop = suspect_stop(recordings)
    return "" if stop is None else _stop_said(stop)


def _stop_said(stop: Stop) -> str:
    than, stiffness = "above" if stop.side > 0 else "below", float(f"{stop.stiffness:.2g}")
    return (
        f"Joint {stop.joint} seems to press against something that yields (an end stop, a cable or an object) {than} "
        f"about {stop.at:.3g} rad: with a stiffness of {stiffness:g} N m/rad there, "
        f"{unexplained(stop.residual, stop.residual_given)}. Record a motion that does not reach that angle."
    )


def _clipped(recordings: Sequence[Recording], found: Sequence[Clipped]) -> tuple[str, ...]:
    return tuple(
        f"{_unsigned(recordings, each.joint)}The torque of joint {each.joint} seems to have been limited to about "
        f"{each.level:.3g} N m; its column exceeds this value in {100 * each.beyond:.2g} % of the samples. With "
        f"this limit, {unexplained(each.residual, each.residual_given)}. A "
        "current limit or the supply voltage clips it (saturation): use the measured current, or smaller commands."
        for each in found
    )


def _unsigned(recordings: Sequence[Recording], joint: int) -> str:
    """A sentence if the torque of a joint (numbered from 1) never changes sign; "" otherwise."""
    torque = np.concatenate([each.torque[joint - 1] for each in recordings])
    if torque.min() < 0.0 < torque.max():
        return ""
    return (
        f"The torque of joint {joint} never changes sign: its column may contain only magnitudes. If so, log the "
        "torque with its sign. Otherwise: "
    )


def _late(recordings: Sequence[Recording]) -> tuple[str, ...]:
    late = suspect_late(recordings)
    if late is None:
        return ()
    than = "late" if late.delay > 0.0 else "early"
    return (
        f"The torque of joint {late.joint} seems to be logged about {1e3 * abs(late.delay):.2g} ms too {than}, "
        f"compared with the other joint: with this corrected, inverse dynamics leaves {100 * late.residual:.2g} % of "
        f"the torque unexplained instead of {100 * late.residual_given:.2g} %. Shift its column, or log both "
        "torques at the same time.",
    )


def _uneven(recordings: Sequence[Recording]) -> tuple[str, ...]:
    found = suspect_uneven(recordings)
    if found is None:
        return ()
    return (
        f"The position of joint {found.late} may be logged about {1e3 * found.by:.2g} ms later, relative to its "
        f"torque, than that of joint {found.early}: for one of these joints, inverse dynamics leaves "
        f"{100 * found.residual:.2g} % of the torque unexplained with the joint's own delay, but "
        f"{100 * found.residual_given:.2g} % with that of the other joint. Log all columns at the same time, or shift "
        "those of one joint.",
    )


def _drifting(recordings: Sequence[Recording]) -> tuple[str, ...]:
    drift = suspect_drift(recordings)
    if drift is None:
        return ()
    return (
        f"The delay of the torque drifts from {1e3 * drift.start:+.3g} ms to {1e3 * drift.end:+.3g} ms over the "
        f"recording ({1e6 * drift.relative:+.0f} ppm): with this corrected, "
        f"{unexplained(drift.residual, drift.residual_given)}. Torque and position were timed by different "
        "clocks: correct the times of one of them, or log both with the same clock.",
    )
