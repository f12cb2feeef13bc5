"""The verdict on an estimate from arbitrary motion, as in `hil.estimator.selection.verdict` but based on segments."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.models.conflicts import Conflict, Trust, conflict_sentences, contradicted, lowered
from hil.estimator.models.terms import joint_of, kind_of
from hil.estimator.selection.candidates import Candidate
from hil.estimator.selection.verdict import (
    EXPLAINED,
    GOOD_PREDICTION,
    MUCH_LEFT,
    NOTICEABLE,
    USABLE_PREDICTION,
    WEAK,
    WELL_KNOWN,
    Verdict,
    percent,
)

NEARLY_EXPLAINED = 1.5  # ratio of residual to noise up to which undetermined friction near standstill does no harm
UNDETERMINED = 10.0  # standard error over value above which a parameter is not determined at all
LITTLE_TORQUE = 0.1  # fraction of the RMS torque; gravity torques below this are negligible
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
    spoiled: bool = False
    """Whether the recordings themselves are at fault, so that neither more terms nor other motion would help."""
    notes: tuple[str, ...] = ()
    """Findings that cast no doubt on the values, as sentences."""
    gravity: bool = True
    """Whether gravity acts in the arm's plane."""
    reason: str = ""
    """Why the estimate is unusable, as the end of a sentence."""


def relative_std(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool = True) -> dict[str, float]:
    """Return the relative standard error of each base parameter except offsets and, without gravity, gravity torques.

    If gravity is negligible, errors of gravity torques are relative to the fraction LITTLE_TORQUE of the RMS torque.
    """
    torque = LITTLE_TORQUE * np.sqrt(np.mean([np.mean(each.torque**2, axis=1) for each in recordings], axis=0))
    relative = {}
    for name, value, std in zip(estimate.model.base_names, estimate.value, estimate.std, strict=False):
        if kind_of(name) != "offset" and (gravity or kind_of(name) != "gravity"):
            least = float(torque[(joint_of(name) or 1) - 1]) if kind_of(name) == "gravity" else 0.0
            size = max(abs(float(value)), least)
            relative[name] = float(std) / size if size else np.inf
    return relative


def explains_well(recordings: Sequence[Recording], estimate: ShootingEstimate, gravity: bool = True) -> bool:
    """Return whether the motion is nearly explained and determines every base parameter well."""
    well = max(relative_std(recordings, estimate, gravity).values()) <= WELL_KNOWN
    return well and float(estimate.residual_over_noise.max()) <= NEARLY_EXPLAINED


def judge_segments(recordings: Sequence[Recording], estimate: ShootingEstimate, evidence: SegmentEvidence) -> Verdict:
    """Return the verdict on `estimate`, whose standard errors include the effect of omitted terms."""
    relative = relative_std(recordings, estimate, evidence.gravity)
    left, held_out = float(estimate.residual_over_noise.max()), evidence.held_out
    weakest = max(relative, key=lambda name: relative[name])
    explained = left <= EXPLAINED
    trust = _trust(left, held_out, relative[weakest], evidence)
    trust = lowered(trust, contradicted(evidence.conflicts, explained))
    sentences = (
        *((f"Do not use these numbers: {evidence.reason or 'see the warnings'}.",) if evidence.faulty else ()),
        _left(estimate, evidence, trust),
        _predicted(held_out, estimate.segment_length),
        *_refused(left, held_out, evidence),
        *conflict_sentences(evidence.conflicts, explained),
        *evidence.doubts,
        *evidence.notes,
        _weakest(weakest, relative[weakest], evidence.spoiled),
    )
    return Verdict(trust, weakest, sentences)


def _trust(left: float, held_out: Array | None, weakest: float, evidence: SegmentEvidence) -> Trust:
    worst = np.inf if held_out is None else float(held_out.max())
    if evidence.faulty or (held_out is not None and not worst <= USABLE_PREDICTION):
        return "no"
    if held_out is None and left > MUCH_LEFT:
        return "no"
    doubtful = weakest > WEAK or evidence.doubtful or bool(evidence.doubts)
    limit = EXPLAINED if held_out is None else MUCH_LEFT
    return "with care" if doubtful or left > limit or (held_out is not None and worst > GOOD_PREDICTION) else "yes"


def _refused(left: float, held_out: Array | None, evidence: SegmentEvidence) -> tuple[str, ...]:
    """Name the rule that makes the verdict "no", and a remedy unless the recordings are already said to be at fault."""
    if evidence.faulty:
        return ()
    remedy = "" if evidence.spoiled else ": check the columns, their units, and whether anything touched the arm"
    if held_out is None:
        rule = f'Without that check, a residual above {MUCH_LEFT:g} times the noise makes the verdict "no"'
        return (f"{rule}{remedy}.",) if left > MUCH_LEFT else ()
    wrong = not float(held_out.max()) <= USABLE_PREDICTION
    return (f'An error above {percent(USABLE_PREDICTION)} makes the verdict "no"{remedy}.',) if wrong else ()


def _left(estimate: ShootingEstimate, evidence: SegmentEvidence, trust: Trust) -> str:
    left = estimate.residual_over_noise
    joint = int(np.argmax(left))
    if left[joint] <= EXPLAINED:
        return "The model explains the motion down to the noise of the positions."
    moves = (
        f"The motion of joint {joint + 1} is not fully explained"
        if trust == "yes"
        else f"Joint {joint + 1} moves in a way that the model cannot explain"
    )
    said = f"{moves}: its residual is {left[joint]:.1f} times the noise."
    seen = [each for each in evidence.candidates if each.evidence > 1.0 and each.explained > NOTICEABLE]
    if seen:
        part = seen[0].part.replace("_", " ")
        article = "an" if part[0] in "aeiou" else "a"
        said += f" Adding {article} {part} term would remove {100.0 * seen[0].explained:.0f} % of the residual."
    return said


def _predicted(held_out: Array | None, length: float) -> str:
    if held_out is None:
        return "The model was not validated on a held-out motion: the recording is too short to hold out part of it."
    return (
        f"Fitted to every other segment of {length:g} s, the model predicts the remaining ones to within "
        f"{percent(float(held_out.max()))} of the motion's RMS."
    )


def _weakest(name: str, part: float, spoiled: bool) -> str:
    if not part < UNDETERMINED:
        remedy = "" if spoiled else f" To identify it, use {IMPROVEMENT[kind_of(name)]}."
        return f"This motion does not determine {name}.{remedy}"
    if part <= WELL_KNOWN or spoiled:
        return f"The least certain parameter is {name}, known to within {percent(part)}."
    improvement = IMPROVEMENT[kind_of(name)]
    return f"The least certain parameter is {name}, known to within {percent(part)}. To improve it, use {improvement}."
