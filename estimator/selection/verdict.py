"""A verdict in words: whether to trust the estimate, its weaknesses, their causes, and how to improve it.

"Yes" means that, as far as can be determined, every inertia, gravity and friction parameter is accurate to 2 % or three
standard errors. This relies on valid standard errors: those of the estimate are widened for effects that the model
omits (`hil.estimator.selection.candidates.considered`) and for the unexplained part of the motion
(`hil.estimator.fit.covariance`). No sentence recommends anything that the tool has already tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.identify import Estimate
from hil.estimator.models.bounds import bound_sentence
from hil.estimator.models.conflicts import Conflict, Trust, conflict_sentences, contradicted
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import OPTIONS, kind_of
from hil.estimator.selection.candidates import Candidate
from hil.estimator.selection.drift import LEAST, Drift, TorqueChange
from hil.estimator.selection.validation import Validation
from hil.estimator.simulation.back_emf import neglected

EXPLAINED = 1.06  # ratio of residual to noise up to which the model explains the motion
GOOD_PREDICTION, USABLE_PREDICTION = 0.01, 0.05  # largest prediction error, relative to the motion's RMS
LEAST_PERCENT = 0.01  # smallest prediction error that is reported; smaller ones are lost in the noise
MUCH_LEFT = 5.0  # ratio of residual to noise above which parameters are doubtful without a held-out check
WELL_KNOWN, WEAK = 0.02, 0.1  # limits on relative standard errors
UNDETERMINED = 10.0  # ratio of standard error to value above which a parameter is not determined at all
LITTLE_EFFECT = 0.02  # standard error of a parameter's torque, relative to the joint's, below which it hardly matters
ALIKE = 0.99  # correlation above which two parameters are hard to separate
NOTICEABLE = 0.005  # fraction of the residual that a term must explain to be mentioned
NOISY = 1.25  # ratio of noise to rounding above which the noise is mentioned
WARM_UP_TIMES, WARM_UP_ROUNDING = 4.0, 30.0  # multiple of the time in which a change was seen; rounded to [s]
MOSTLY = 0.7  # fraction of a standard error above which one effect determines it
IMPROVEMENT = {
    "inertia": "faster motion: raise the upper edge of experiment.band or peak_torque",
    "coupling": "faster motion of both joints together: raise peak_torque",
    "armature": "faster motion of joint 2: raise its peak_torque or the upper edge of experiment.band",
    "gravity": "a wider swing: raise peak_torque, or reduce the lower edge of experiment.band",
    "viscous": "higher speeds: raise peak_torque",
    "coulomb": "more slow reversals: reduce the lower edge of experiment.band, or lengthen the period",
}
AT_ITS_LIMIT = {
    "inertia": "a longer period or faster motion: raise experiment.period or {limit}",
    "coupling": "a longer period or faster motion of both joints together: raise experiment.period or {limit}",
    "armature": "a longer period or faster motion of joint 2: raise experiment.period or {limit}",
    "gravity": "a wider swing: raise {limit}, or reduce the lower edge of experiment.band",
    "viscous": "higher speeds: raise {limit}",
}
"""Advice if a limit kept the torque from being raised. In that case, higher frequencies would make the motion smaller.
"""
ODD_HINT = "Its residual at odd harmonics indicates friction or ripple that the model lacks."
EVEN_HINT = (
    "Its residual at even harmonics indicates an effect that depends on direction, or an offset in torque or angle."
)
NO_ERRORS = (
    "No parameter has a standard error, because the simulated motion is extremely sensitive to some term of the model. "
    'Estimate again with a simpler model, such as [model] friction = "stribeck" with presliding = false.'
)
BEYOND_NOISE = 2.0


@dataclass(frozen=True)
class Verdict:
    """The verdict and its reasons, each a sentence for users."""

    trust: Trust
    weakest: str
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class TorqueLimit:
    """What kept the pilot from raising the torque."""

    said: str
    """The setting, in words; if it cannot be raised, a clause that says what limited the torque."""
    can_be_raised: bool = True


@dataclass(frozen=True)
class Evidence:
    """Evidence for a verdict, in addition to the estimate and its validation."""

    held_out: Array | None = None
    """RMS error of the open-loop prediction of a held-out motion, relative to that motion's RMS (joints,), excluding
    encoder noise.

    If friction has changed since the fitted motion, the prediction uses one friction factor per joint, estimated from
    the held-out motion itself.
    """
    held_out_as_fitted: Array | None = None
    """Like `held_out`, but with friction as it was in the fitted motion (joints,); None if it has not changed."""
    candidates: Sequence[Candidate] = ()
    """Missing terms, most significant first."""
    drift: Drift | None = None
    """Change in friction while the arm moved."""
    torque: TorqueChange | None = None
    """Constant torque in the held-out motion, if it explains that motion better than a change in friction does."""
    disturbances: tuple[str, ...] = field(default=())
    """Faults of the recording itself, as sentences; they explain the residual and any change in friction."""
    doubts: tuple[str, ...] = field(default=())
    """Implausible or contradictory values, as sentences."""
    notes: tuple[str, ...] = field(default=())
    """Other findings that cast no doubt on the values, as sentences."""
    tried_all: bool = False
    """Whether the model was selected from all available terms."""
    torque_limit: TorqueLimit | None = None
    """What limited the torque, for advice; None if the user chose peak_torque."""
    conflicts: tuple[Conflict, ...] = field(default=())
    """Values far from those known beforehand."""
    cause: str = ""
    """A likely cause of any residual, known from how the motion was driven, as a sentence."""
    ended_early: bool = False
    """Whether the held-out motion is missing because the recording ends before that motion settles."""


def judge(estimate: Estimate, validation: Validation, evidence: Evidence) -> Verdict:
    """Return the verdict on `estimate`."""
    explained = float(validation.residual_over_floor.max()) <= EXPLAINED
    trust = _trust(validation, evidence, estimate.at_bound)
    sentences = (
        _noise(validation) if explained else _unexplained(estimate, validation, evidence, trust),
        *(() if explained or evidence.disturbances else _distorted(validation)),
        *evidence.disturbances,
        *(() if evidence.disturbances else _drifted(evidence.drift, validation)),
        *_pushed(evidence.torque),
        *_predicted(evidence),
        *conflict_sentences(evidence.conflicts, explained),
        *((bound_sentence(estimate.at_bound),) if estimate.at_bound else ()),
        *evidence.doubts,
        *evidence.notes,
        *_weak(estimate, validation, evidence.torque_limit),
        *_alike(validation),
        *_outliers(estimate, explained),
    )
    return Verdict(trust, validation.weakest, sentences)


def _trust(validation: Validation, evidence: Evidence, at_bound: Sequence[str]) -> Trust:
    left = float(validation.residual_over_floor.max())
    against = contradicted(evidence.conflicts, left <= EXPLAINED)
    if against == "no" or not _has_errors(validation):
        return "no"
    doubtful = any(_is_weak(validation, name) for name in validation.relative_std)
    doubtful = doubtful or bool(evidence.doubts or evidence.disturbances or evidence.torque or against or at_bound)
    if evidence.held_out is None:
        if left > MUCH_LEFT:
            return "no"
        return "with care" if doubtful or left > EXPLAINED else "yes"
    worst = float(evidence.held_out.max())
    if not worst <= USABLE_PREDICTION:
        return "no"
    return "with care" if doubtful or left > MUCH_LEFT or worst > GOOD_PREDICTION else "yes"


def _has_errors(validation: Validation) -> bool:
    """Return whether any parameter has a finite standard error."""
    return bool(np.isfinite(list(validation.relative_std.values())).any())


def _is_weak(validation: Validation, name: str) -> bool:
    """Return whether a parameter is poorly known although the arm's torque depends on it."""
    return validation.relative_std[name] > WEAK and not validation.torque_std[name] <= LITTLE_EFFECT


def _noise(validation: Validation) -> str:
    # The noise includes the residual's; at a low rate, its estimate may also include fast parts of the motion.
    noise = validation.levels.noise * np.minimum(validation.residual_over_floor, 1.0)
    joint = int(np.argmax(noise))
    if noise[joint] * np.sqrt(12.0) < NOISY:
        return "The model explains the motion down to the encoders' rounding."
    return (
        f"The model explains the motion down to the encoders' noise, {noise[joint]:.2g} steps RMS on joint "
        f"{joint + 1}; rounding alone is 0.29."
    )


def _unexplained(estimate: Estimate, validation: Validation, evidence: Evidence, trust: Trust) -> str:
    left = validation.residual_over_floor
    joint = int(np.argmax(left))
    error = float(validation.levels.model_error.max())
    said = (
        f"{unexplained_motion(joint, float(left[joint]))}: its residual is {left[joint]:.1f} times the noise, a model "
        f"error of {error:.2g} encoder steps RMS."
    )
    if evidence.disturbances:
        return said
    return " ".join((said, _suspicion(estimate, evidence), _spoilt(validation, trust)))


def unexplained_motion(joint: int, left: float) -> str:
    """Return the beginning of a sentence about a joint (from 0) whose residual is `left` times the noise."""
    if left <= MUCH_LEFT:
        return f"The motion of joint {joint + 1} is not fully explained"
    return f"Joint {joint + 1} moves in a way that the model cannot explain"


def _suspicion(estimate: Estimate, evidence: Evidence) -> str:
    """Return the most likely cause of the residual, with the evidence."""
    cause = f"{evidence.cause} " if evidence.cause else ""
    seen = [each for each in evidence.candidates if each.evidence > 1.0 and each.explained > NOTICEABLE]
    if seen:
        what = _in_words(seen[0].part)
        advice = "" if evidence.tried_all else ' With [model] friction = "auto", that term is tried.'
        explained = f"would explain {100.0 * seen[0].explained:.0f} % of it"
        return f"{cause}The residual looks most like {what}, which {explained}.{advice}"
    if not evidence.tried_all and estimate.model.friction != "stribeck_load":
        return f'{cause}No single term explains the residual; [model] friction = "auto" tries several together.'
    return (
        f"No available term explains the residual. {cause}{'Other possible' if cause else 'Possible'} causes: cogging "
        "or torque ripple, backlash, an elastic belt or link, a loose screw, a sagging supply or a dragging cable."
    )


def _in_words(part: str) -> str:
    laws = {"stribeck": "friction that rises at low speed", "stribeck_load": "load-dependent friction"}
    return laws.get(part) or next(words for option, words in OPTIONS.items() if option == part)


def _spoilt(validation: Validation, trust: Trust) -> str:
    """Return a sentence about parameters that the model error may bias, selected by their inflated standard errors."""
    if not _has_errors(validation):
        return "This error may bias all parameters."
    worst = {name: part for name, part in validation.relative_std.items() if part > WELL_KNOWN}
    if not worst and trust == "no":
        return "This error may bias all parameters, regardless of their standard errors."
    if not worst:
        return "This error does not affect the parameters significantly: even with it, each is known to 2 % or better."
    named = sorted(worst, key=lambda name: -worst[name])
    known = {name: percent(part) if part < UNDETERMINED else "not determined" for name, part in worst.items()}
    listed = ", ".join(f"{name} ({known[name]})" for name in named[:4])
    more = f" and {len(named) - 4} others" if len(named) > 4 else ""
    if trust == "no":
        return f"This error may bias all parameters, most of all {listed}{more}."
    if trust == "yes":
        return f"The standard errors include this: {listed}{more}; the other parameters are known to 2 % or better."
    return (
        f"This error may bias all parameters. The standard errors include it ({listed}{more}; the others at most 2 %), "
        "but while its cause is unknown, errors of several standard errors are possible."
    )


def _distorted(validation: Validation) -> tuple[str, ...]:
    """Return sentences about the response at unexcited harmonics and the part of it that the model does not explain."""
    levels = validation.levels.lines
    if levels.odd is None or levels.even is None:
        return (
            "experiment.detection = true would separate odd distortion (friction) from even distortion (offsets, "
            "direction).",
        )
    driven = levels.excited.motion
    joint = int(np.argmax(np.maximum(levels.odd.motion, levels.even.motion) / driven))

    def share(level: Array) -> str:
        return percent(float(level[joint] / driven[joint]))

    found = (
        f"Joint {joint + 1} also moves at harmonics that were not excited. Relative to its motion at an excited one: "
        f"{share(levels.odd.motion)} at odd harmonics (friction, gravity), {share(levels.even.motion)} at even ones "
        f"(offsets, direction-dependent effects), and {share(levels.noise)} noise. The model leaves "
        f"{share(levels.odd.left)} (odd) and {share(levels.even.left)} (even) unexplained."
    )
    beyond = [
        hint
        for group, hint in ((levels.odd, ODD_HINT), (levels.even, EVEN_HINT))
        if np.any(group.left > BEYOND_NOISE * levels.noise)
    ]
    return (" ".join((found, *beyond)),)


def _drifted(drift: Drift | None, validation: Validation) -> tuple[str, ...]:
    """Return a sentence on each joint whose friction has changed. If much of the motion is unexplained, an effect that
    the model lacks may merely look like such a change.
    """
    if drift is None:
        return ()
    changed = [
        (f"joint {joint + 1}", change)
        for joint, (change, std) in enumerate(zip(drift.change.tolist(), drift.std.tolist(), strict=True))
        if abs(change) > max(LEAST, 3.0 * std)
    ]
    if changed and float(validation.residual_over_floor.max()) > MUCH_LEFT:
        return (
            f"Friction seems to have changed within {drift.seconds:.0f} s "
            f"({', '.join(f'{joint} by {100.0 * change:+.2g} %' for joint, change in changed)}), but as long as the "
            "motion is not explained, an effect that the model lacks may be the cause.",
        )
    return tuple(
        f"Friction of {joint} {'fell' if change < 0.0 else 'rose'} by {percent(abs(change))} within "
        f"{drift.seconds:.0f} s{_reason(change, drift.seconds)}"
        for joint, change in changed
    )


def _pushed(torque: TorqueChange | None) -> tuple[str, ...]:
    if torque is None:
        return ()
    found = " and ".join(
        f"{-change:+.2g} N m on joint {joint + 1}"  # the motor has to balance it
        for joint, (change, seen) in enumerate(zip(torque.change.tolist(), torque.is_seen.tolist(), strict=True))
        if seen
    )
    return (
        f"Compared with the fitted motion, an additional constant torque of {found} acts in the held-out one. It "
        "explains the difference better than a change in friction does. In one of the two motions, something pushed or "
        "pulled the arm, a cable tightened, the arm carried something, or its base tilted. Remove the cause and record "
        "again.",
    )


def _reason(change: float, seconds: float) -> str:
    """Return the possible cause of a change in friction, as the end of a sentence. Friction falls as a servo warms up;
    a rise always indicates a fault.
    """
    holds = "the identified values hold for the fitted periods"
    if change < 0.0:
        warm = f"To obtain values for the warm arm, set experiment.warm_up = {_warm_up(seconds)}."
        return f", as is typical while grease warms up: {holds}. {warm}"
    return (
        f", which warming up does not explain: {holds}. Look for a cable or part that has started to "
        "rub, a loose screw, or a horn that has slipped. A hot motor or a falling supply voltage also reduces the "
        "torque. Then record again."
    )


def _warm_up(seconds: float) -> int:
    """Return a warm-up time [s] that should suffice if friction still changed between motions `seconds` apart."""
    return int(WARM_UP_ROUNDING * np.ceil(WARM_UP_TIMES * seconds / WARM_UP_ROUNDING))


def _predicted(evidence: Evidence) -> tuple[str, ...]:
    held_out, as_fitted = evidence.held_out, evidence.held_out_as_fitted
    if held_out is None and evidence.ended_early:
        return ("The model was not validated on a held-out motion, because the recording ends too early.",)
    if held_out is None:
        return ("The model was not validated on a held-out motion: set experiment.held_out = true.",)
    worst = _percent(held_out)
    said = f"The model predicts a held-out motion to within {worst} of that motion's RMS, excluding encoder noise"
    if as_fitted is None or _percent(as_fitted) == worst:
        return (f"{said}.",)
    return (
        f"{said}, if friction is rescaled to its level at that time (one factor per joint, taken from that motion). "
        f"With friction as in the fitted motion, it predicts that motion to within {_percent(as_fitted)}.",
    )


def _percent(error: Array) -> str:
    """Return the largest relative error in percent, never in exponential notation."""
    return percent(max(float(error.max()), 0.01 * LEAST_PERCENT))


def percent(part: float) -> str:
    """Return a fraction in percent; large values are not in exponential notation."""
    return f"{100.0 * part:.{'2g' if part < 0.995 else '0f'}} %"


def improvement_of(name: str, limit: TorqueLimit | None = None) -> str:
    """Return advice on improving the estimate of the parameter `name`; limit: as in `Evidence`."""
    kind = kind_of(name)
    if limit is None or kind not in AT_ITS_LIMIT:
        return IMPROVEMENT[kind]
    if limit.can_be_raised:
        return AT_ITS_LIMIT[kind].format(limit=limit.said)
    return f"a longer period: raise experiment.period ({limit.said})"


def _late_back_emf(estimate: Estimate, name: str) -> bool:
    """Whether the unknown delay between voltage and back-EMF causes most of a parameter's standard error."""
    floor = neglected(Physics.of(estimate.parameters)).get(name, 0.0)
    place = estimate.names.index(name)
    return floor > MOSTLY * float(np.sqrt(estimate.covariance[place, place]))


def _weak(estimate: Estimate, validation: Validation, limit: TorqueLimit | None) -> tuple[str, ...]:
    if not _has_errors(validation):
        return (NO_ERRORS,)
    name = validation.weakest
    part = validation.relative_std[name]
    if part <= WELL_KNOWN:
        return (f"The least certain parameter is {name}, known to within {percent(part)}.",)
    if np.isfinite(part) and _late_back_emf(estimate, name):
        return (
            f"The least certain parameter is {name}, known to within {percent(part)}. Most of this is due to the "
            "unknown delay between the voltage and the motor's back-EMF (about 0.5 ms). Neither another motion nor a "
            "longer recording reveals this delay. Current control, if the servo supports it, avoids the problem.",
        )
    improvement = improvement_of(name, limit)
    if not np.isfinite(part):
        return (f"This motion provides no information about {name}. To identify it, use {improvement}.",)
    if part > WEAK and not _is_weak(validation, name):
        share = 100 * validation.torque_std[name]
        if part > 1.0:
            return (
                f"{name} cannot be distinguished from zero. It hardly affects this arm: its standard error "
                f"amounts to {share:.2g} % of the fitted motion's torque.",
            )
        return (
            f"The least certain parameter is {name}, known to within {percent(part)}. It hardly affects this arm: "
            f"its standard error amounts to {share:.2g} % of the fitted motion's torque. To improve it, use "
            f"{improvement}.",
        )
    if part >= UNDETERMINED:
        return (f"This motion does not determine {name}. To identify it, use {improvement}.",)
    return (
        f"The least certain parameter is {name}, known to within {percent(part)}. To improve it, use {improvement}.",
    )


def _alike(validation: Validation) -> tuple[str, ...]:
    first, second, correlation = validation.confounded
    both = max(validation.relative_std.get(name, 0.0) for name in (first, second))
    if first == second or abs(correlation) < ALIKE or both <= WELL_KNOWN:
        return ()
    return (
        f"{first} and {second} are hard to separate (correlation {correlation:.3f}): excite more "
        "frequencies or use more torque.",
    )


def _outliers(estimate: Estimate, explained: bool) -> tuple[str, ...]:
    # If the model is incomplete, a reading far from its prediction is not necessarily wrong.
    if not estimate.outliers or not explained:
        return ()
    one = estimate.outliers == 1
    counted = "1 sample is an outlier and was" if one else f"{estimate.outliers} samples are outliers and were"
    return (
        f"{counted} downweighted. Possible causes: a jolt, backlash, or late or damaged readings. The residuals in the "
        "report show where they occur.",
    )
