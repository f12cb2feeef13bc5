"""The verdict on an estimate from arbitrary motion, as in `hil.estimator.selection.verdict` but based on segments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.models.conflicts import Conflict, Trust, conflict_sentences, contradicted, lowered
from hil.estimator.models.terms import kind_of
from hil.estimator.selection.candidates import Candidate
from hil.estimator.selection.validation import relative_errors
from hil.estimator.selection.verdict import (
    EXPLAINED,
    GOOD_PREDICTION,
    MUCH_LEFT,
    NOTICEABLE,
    UNDETERMINED,
    USABLE_PREDICTION,
    WEAK,
    WELL_KNOWN,
    Verdict,
    percent,
    unexplained_motion,
)

NEARLY_EXPLAINED = 1.5  # ratio of residual to noise up to which undetermined friction near standstill does no harm
INERTIAS = ("inertia", "armature")
ZERO_INERTIA = 1e-3  # fraction of the arm's largest inertia below which one has ended at 0
AT_BOUND = (
    ", which ended at 0, the lower end of its range. The standard errors of the other inertias assume this value and "
    "may be far too small"
)
EXPLAINED_PREDICTION = 0.15  # prediction error above which even a nearly explained motion is not trusted
IMPROVEMENT = {
    "inertia": "faster motion",
    "coupling": "faster motion of both joints together",
    "armature": "faster motion of joint 2",
    "gravity": "a wider swing",
    "viscous": "higher speeds",
    "coulomb": "more slow reversals",
}


@dataclass(frozen=True)
class SegmentEvidence:
    """Evidence for a verdict, in addition to the estimate."""

    held_out: Array | None
    """RMS error of predictions of held-out segments, relative to the motion's RMS (joints,)."""
    candidates: Sequence[Candidate] = ()
    """Missing terms, most significant first."""
    doubts: tuple[str, ...] = ()
    """Implausible values, as sentences."""
    faulty: bool = False
    """Whether a warning makes the estimate unusable."""
    doubtful: bool = False
    """Whether a warning casts doubt on the estimate."""
    conflicts: tuple[Conflict, ...] = ()
    """Values far from those known beforehand."""
    undetermined: tuple[str, ...] = ()
    """Friction terms near standstill that the motion does not determine, as a sentence; harmless if `explains_well`."""
    spoiled: bool = False
    """Whether the recordings themselves are at fault, so that neither more terms nor other motion would help."""
    notes: tuple[str, ...] = ()
    """Findings that cast no doubt on the values, as sentences."""
    gravity: bool = True
    """Whether gravity acts in the arm's plane."""
    reason: str = ""
    """Why the estimate is unusable, as the end of a sentence."""


def relative_std(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool = True) -> dict[str, float]:
    """Return the relative standard error of each base parameter; see `relative_errors`."""
    torque = np.sqrt(np.mean([np.mean(each.torque**2, axis=1) for each in recordings], axis=0))
    speed = np.sqrt(np.mean([np.mean(_velocity(each) ** 2, axis=1) for each in recordings], axis=0))
    return relative_errors(estimate.model.base_names, estimate.value, estimate.std, torque, speed, gravity)


def _velocity(recording: Recording) -> Array:
    """Return velocities from central differences of neighbouring samples (joints, samples) [rad/s]."""
    return np.asarray(np.gradient(recording.filled(), axis=1)) / recording.interval


def explains_well(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool = True) -> bool:
    """Return whether the motion is nearly explained and determines every base parameter well."""
    well = max(relative_std(recordings, estimate, gravity).values()) <= WELL_KNOWN
    return well and float(estimate.residual_over_noise.max()) <= NEARLY_EXPLAINED


def judge_segments(recordings: Sequence[Recording], estimate: ShootingEstimate, evidence: SegmentEvidence) -> Verdict:
    """Return the verdict on `estimate`, whose standard errors include the effect of omitted terms.

    Every number that rules out "yes" is stated together with its limit.
    """
    relative = relative_std(recordings, estimate, evidence.gravity)
    left, held_out = float(estimate.residual_over_noise.max()), evidence.held_out
    weakest = max(relative, key=lambda name: relative[name])
    explained = left <= EXPLAINED
    against = contradicted(evidence.conflicts, explained)
    unclear = bool(evidence.undetermined) and not explains_well(recordings, estimate, evidence.gravity)
    rules = _rules(left, held_out, weakest, relative[weakest], unclear)
    rules += ("a warning casts doubt on the recording",) if evidence.doubtful else ()
    trust: Trust = "with care" if rules or evidence.doubts or against else "yes"
    trust = lowered("no" if _is_refused(left, held_out, evidence) else trust, against)
    sentences = (
        *((f"Do not use these numbers: {evidence.reason or 'see the warnings'}.",) if evidence.faulty else ()),
        _left(estimate, evidence),
        _predicted(held_out, estimate.segment_length),
        *_refused(left, held_out, evidence),
        *conflict_sentences(evidence.conflicts, explained),
        *evidence.doubts,
        *evidence.undetermined,
        *evidence.notes,
        _weakest(weakest, relative[weakest], evidence.spoiled, _is_at_bound(estimate, weakest)),
        *((f'The verdict is not "yes" because {" and because ".join(rules)}.',) if rules and trust != "no" else ()),
    )
    return Verdict(trust, weakest, sentences)


def _rules(left: float, held_out: Array | None, weakest: str, part: float, unclear: bool) -> tuple[str, ...]:
    """Name each number that exceeds its limit for "yes". part: relative standard error of the parameter `weakest`.
    unclear: whether undetermined friction near standstill may have affected other parameters.
    """
    limit = EXPLAINED if held_out is None else MUCH_LEFT
    rules = {
        f"the residual exceeds {limit:g} times the noise": left > limit,
        f"the error of the prediction exceeds {percent(GOOD_PREDICTION)}": held_out is not None
        and float(held_out.max()) > GOOD_PREDICTION,
        f"{weakest} is not known to within {percent(WEAK)}": part > WEAK,
        "friction near standstill is not determined, which is harmless only if the residual is at most "
        f"{NEARLY_EXPLAINED:g} times the noise and every parameter is known to within {percent(WELL_KNOWN)}": unclear,
    }
    return tuple(rule for rule, applies in rules.items() if applies)


def _is_refused(left: float, held_out: Array | None, evidence: SegmentEvidence) -> bool:
    beyond = left > MUCH_LEFT if held_out is None else not float(held_out.max()) <= _largest_error(left)
    return evidence.faulty or beyond


def _largest_error(left: float) -> float:
    """Return the largest usable prediction error, relative to the motion's RMS. left: residual over noise.

    If the residual hardly exceeds the noise, a larger error is acceptable: the fit to half of a recording with little
    motion is merely less accurate than that to the whole recording.
    """
    return EXPLAINED_PREDICTION if left <= NEARLY_EXPLAINED else USABLE_PREDICTION


def _refused(left: float, held_out: Array | None, evidence: SegmentEvidence) -> tuple[str, ...]:
    """Name the rule that makes the verdict "no", and a remedy unless faults of the recordings are already reported."""
    if evidence.faulty or not _is_refused(left, held_out, evidence):
        return ()
    remedy = "" if evidence.spoiled else f": {_remedy(left)}"
    if held_out is None:
        rule = f"Without that check, a residual above {MUCH_LEFT:g} times the noise"
    else:
        rule = f"An error above {percent(_largest_error(left))}"
    return (f'{rule} makes the verdict "no"{remedy}.',)


def _remedy(left: float) -> str:
    """Say what to do about a large prediction error. left: residual over noise of the fit to the whole recording."""
    if left <= NEARLY_EXPLAINED:
        return "half of this motion does not determine the model. Record longer, with larger or faster motion"
    return "check the columns, their units, and whether anything touched the arm"


def _left(estimate: ShootingEstimate, evidence: SegmentEvidence) -> str:
    left = estimate.residual_over_noise
    joint = int(np.argmax(left))
    if left[joint] <= EXPLAINED:
        return "The model explains the motion down to the noise of the positions."
    said = f"{unexplained_motion(joint, float(left[joint]))}: its residual is {left[joint]:.1f} times the noise"
    if left[joint] <= MUCH_LEFT and evidence.held_out is not None:
        said += f" (up to {MUCH_LEFT:g} times is acceptable if other motion is predicted well)"
    said += "."
    # If the linearised effect exceeds the whole residual, the term is not small, and its effect is unknown.
    seen = [each for each in evidence.candidates if each.evidence > 1.0 and NOTICEABLE < each.explained <= 1.0]
    if seen:
        part = seen[0].part.replace("_", " ")
        article = "an" if part[0] in "aeiou" else "a"
        said += f" Adding {article} {part} term would remove {100.0 * seen[0].explained:.0f} % of the residual."
    return said


def _predicted(held_out: Array | None, length: float) -> str:
    if held_out is None:
        return "The model was not validated on a held-out motion: the recording is too short to hold out part of it."
    return (
        f"When fitted to only half of the {length:g} s segments, the model predicts the other half to within "
        f"{percent(float(held_out.max()))} of the motion's RMS."
    )


def _is_at_bound(estimate: ShootingEstimate, name: str) -> bool:
    """Return whether `name` is an inertia that ended at 0, from which no fit returns since the slope is zero there."""
    values = dict(zip(estimate.names, estimate.value.tolist(), strict=False))
    inertias = [value for each, value in values.items() if kind_of(each) in INERTIAS]
    return kind_of(name) in INERTIAS and values[name] < ZERO_INERTIA * max(inertias)


def _weakest(name: str, part: float, spoiled: bool, is_at_bound: bool) -> str:
    if not part < UNDETERMINED:
        remedy = "" if spoiled else f" To identify it, use {IMPROVEMENT[kind_of(name)]}."
        return f"This motion does not determine {name}{AT_BOUND if is_at_bound else ''}.{remedy}"
    if part <= WELL_KNOWN or spoiled:
        return f"The least certain parameter is {name}, known to within {percent(part)}."
    improvement = IMPROVEMENT[kind_of(name)]
    return f"The least certain parameter is {name}, known to within {percent(part)}. To improve it, use {improvement}."
