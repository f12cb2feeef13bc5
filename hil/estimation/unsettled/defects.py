"""Sentences about defects of whole recordings: angles with a wrong scale, and changes while the arm moved."""

import math
from collections.abc import Callable, Mapping, Sequence

from hil.estimator.data.recording import Recording
from hil.estimator.defects.hypotheses import Course, Hypothesis
from hil.estimator.defects.search import Defect, probable_defect
from hil.estimator.fit.multiple_shooting import ShootingEstimate

AS_WELL = 1.05  # largest mean square of the residual, relative to that of the chosen model
WELL = 2.0  # mean square of the residual relative to the noise, up to which a defect is certain to be the cause
MOSTLY = 0.8  # a defect is named only if it explains at least this fraction of the residual
GAIN = 1.5  # mean square of the residual without the defect, relative to that with it, below which nothing is gained


def likely_defect(
    recordings: Sequence[Recording], plain: ShootingEstimate, estimate: ShootingEstimate, gravity: bool
) -> Defect | None:
    """A defect that explains the recordings as well as the terms of `estimate` do; None if there is none.

    plain: estimate of a model without terms that could imitate a defect.
    """
    found = probable_defect(recordings, plain, gravity)
    if found is None or found.fit.left > AS_WELL * float((estimate.residual_over_noise**2).mean()):
        return None
    if found.given.left < GAIN * found.fit.left:
        return None
    return found if found.explained > MOSTLY or found.fit.left < WELL else None


def is_certain(defect: Defect) -> bool:
    """Whether the defect explains so much of the residual that no other cause needs to be considered."""
    return defect.fit.left < WELL


def is_other_arm(defect: Defect) -> bool:
    """Whether one of several recordings seems to come from another arm, or from the arm with another load."""
    return defect.hypothesis.course.kind == "recording" and defect.hypothesis.kind in {"arm", "load"}


def defect_said(defect: Defect, names: Sequence[str]) -> str:
    """A sentence about a defect, with the evidence and a remedy."""
    hypothesis = defect.hypothesis
    unknowns = defect.fit.unknowns[-hypothesis.unknowns :].tolist()
    what, remedy = _WORDS[hypothesis.kind](hypothesis, unknowns, _when(hypothesis.course, names))
    left, given = math.sqrt(defect.fit.left), math.sqrt(defect.given.left)
    return (
        f"{what}: if the model allows for this, the residual is {left:.3g} times the noise instead of {given:.3g} "
        f"times. {remedy}"
    )


def _when(course: Course, names: Sequence[str]) -> str:
    which = f" of {names[course.recording]}" if len(names) > 1 and course.kind == "step" else ""
    return {
        "always": "",
        "step": f"at about {course.time:.3g} s{which}",
        "linear": "steadily during the recording",
        "decay": f"with a time constant of about {course.time:.2g} s",
        "recording": f"in {names[course.recording]}" if course.recording < len(names) else "in one recording",
    }[course.kind]


def _joints(hypothesis: Hypothesis) -> str:
    listed = " and ".join(map(str, hypothesis.joints))
    return f"joint{'s' if len(hypothesis.joints) > 1 else ''} {listed}"


def _scale(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    del when
    factors = " and ".join(f"{1.0 + each:.4g}" for each in unknowns)
    several = len(unknowns) > 1
    given, true = ("angles", "ones") if several else ("angle", "one")
    seem = "seem" if several else "seems"
    return (
        f"The {given} of {_joints(hypothesis)} {seem} to be {factors} times the true {true}",
        "Check the unit, the ticks per turn and the belt or gear ratio between encoder and joint.",
    )


def _load(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    heavier = sum(unknowns) > 0.0
    if hypothesis.course.kind == "recording":
        change = f"The load seems to differ {when}"
    else:
        change = f"The load seems to have been {'picked up' if heavier else 'put down or lost'} {when}"
    return change, "Use only the part before or after the change, or put each part in a separate file."


def _friction(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    each = unknowns if len(hypothesis.joints) > 1 else [sum(unknowns) / len(unknowns)]
    whose = _joints(hypothesis)
    percent = " and ".join(f"{100.0 * change:+.2g} %" for change in each)
    match hypothesis.course.kind:
        case "decay":
            said = (
                f"The friction of {whose} seems to differ from its final value by {percent} at first, "
                f"and to settle {when}"
            )
            return said, "Let the arm move for a few minutes before you record, so that it is warm."
        case "linear":
            said = f"The friction of {whose} seems to change {when}, by {percent} of its initial value"
            return said, "Let the arm move for a few minutes before you record, so that it is warm."
        case "recording":
            return f"The friction of {whose} seems to differ by {percent} {when}", "Estimate each recording separately."
        case _:
            said = f"The friction of {whose} seems to have changed by {percent} {when}"
            return said, "Use only the part before or after the change, and check for rubbing parts."


def _torque(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    # For joint 1, whose torque is the reference, the unknown is the decrease of all other values.
    factor = 1.0 / max(1.0 - unknowns[0], 0.1) if hypothesis.joints == (1,) else 1.0 + unknowns[0]
    change, whose = 100.0 * (factor - 1.0), _joints(hypothesis)
    match hypothesis.course.kind:
        case "linear":
            said = f"The motor torque of {whose} seems to change {when}, by {change:+.2g} % of the recorded torque"
            return said, "A motor that heats up loses torque: record for a shorter time, or with less torque."
        case "recording":
            said = f"The motor torque of {whose} seems to be {factor:.4g} times the recorded torque {when}"
            said += ", compared with the other recordings"
            return said, "Check the unit, the gear ratio and the torque constant behind the torque column."
        case _:
            said = f"The motor torque of {whose} seems to have changed by {change:+.2g} % of the recorded torque {when}"
            return said, "Check the supply voltage, the limits and the scale of the torque column."


def _offset(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    del unknowns
    verb = "differ" if hypothesis.course.kind == "recording" else "change"
    return (
        f"The offset torque on {_joints(hypothesis)} seems to {verb} {when}",
        "A pulling cable, a contact or a zero error of the current sensor can have this effect.",
    )


def _arm(hypothesis: Hypothesis, unknowns: Sequence[float], when: str) -> tuple[str, str]:
    del unknowns
    if hypothesis.course.kind == "recording":
        return f"The arm {when} seems to be a different one, or to carry a different load", "Estimate each separately."
    return (
        f"The arm's load, mounting, servo or settings seem to have changed {when}",
        "Use only the part before or after the change, or put each part in a separate file.",
    )


_WORDS: Mapping[str, Callable[[Hypothesis, Sequence[float], str], tuple[str, str]]] = {
    "scale": _scale,
    "load": _load,
    "friction": _friction,
    "torque": _torque,
    "offset": _offset,
    "arm": _arm,
}
