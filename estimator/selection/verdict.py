"""A verdict in words: trust the estimate or not, which parameter is weak, what experiment would mend it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.identify import Estimate
from hil.estimator.selection.validation import Validation

EXPLAINED = 1.04  # residual over floor up to which the model has explained the motion
GOOD_PREDICTION, USABLE_PREDICTION = 0.01, 0.05  # of the motion's RMS
MUCH_LEFT = 5.0  # residual over floor from which parameters are doubtful without a held-out check
WELL_KNOWN = 0.01  # relative standard error
ALIKE = 0.99  # correlation
MEND = {
    "inertia": "faster motion: raise the upper edge of experiment.band or peak_torque",
    "coupling": "faster motion of both joints together: raise peak_torque",
    "armature": "faster motion of joint 2: raise its peak_torque or the upper edge of experiment.band",
    "gravity": "a wider swing: raise peak_torque, or lower the lower edge of experiment.band",
    "viscous": "higher speeds: raise peak_torque",
    "coulomb": "more slow reversals: lower the lower edge of experiment.band, or lengthen the period",
}

ODD_MEND = "What it leaves on odd lines asks for richer friction or ripple."
EVEN_MEND = "What it leaves on even lines asks for model.asymmetry or model.zeros."
BEYOND_NOISE = 2.0

Trust = Literal["yes", "with care", "no"]


@dataclass(frozen=True)
class Verdict:
    """The judgement and its reasons, each a sentence for a person."""

    trust: Trust
    weakest: str
    sentences: tuple[str, ...]


def judge(estimate: Estimate, validation: Validation, held_out: Array | None) -> Verdict:
    """`held_out`: RMS error of the free prediction of a motion not fitted, over that motion's RMS (joints,)."""
    sentences = (
        _explained(estimate, validation),
        *_distorted(validation),
        *_predicted(held_out),
        *_weak(validation),
        *_alike(validation),
        *_outliers(estimate, validation),
    )
    return Verdict(_trust(validation, held_out), validation.weakest, sentences)


def _trust(validation: Validation, held_out: Array | None) -> Trust:
    left = float(validation.residual_over_floor.max())
    weak = max(validation.relative_std.values()) > 10 * WELL_KNOWN
    if held_out is None:
        if left > MUCH_LEFT:
            return "no"
        return "yes" if left <= EXPLAINED and not weak else "with care"
    worst = float(held_out.max())
    if not worst <= USABLE_PREDICTION:
        return "no"
    return "yes" if worst <= GOOD_PREDICTION and left <= MUCH_LEFT and not weak else "with care"


def _explained(estimate: Estimate, validation: Validation) -> str:
    left = float(validation.residual_over_floor.max())
    if left <= EXPLAINED:
        return "The model explains the motion down to the encoder's rounding and the scatter between periods."
    joint = int(np.argmax(validation.residual_over_floor)) + 1
    error = float(validation.levels.model_error.max())
    model = estimate.model
    ratio = "set torque_scale = true there, " if model.joints == 2 and "torque_scale" not in model.options else ""
    return (
        f"Joint {joint} moves in a way that the model does not have: {left:.1f} times the noise is left, a model error "
        f'of {error:.2g} encoder steps RMS. Let [model] friction = "auto" choose, {ratio}and look for play, a '
        "dragging cable or a loose screw."
    )


def _distorted(validation: Validation) -> tuple[str, ...]:
    """Where the excitation left lines out: what answers there, and what of it the model does not have."""
    levels = validation.levels.lines
    if levels.odd is None or levels.even is None:
        if validation.residual_over_floor.max() <= EXPLAINED:
            return ()
        return ("Whether that is odd (friction) or even (offsets, direction), experiment.detection = true would tell.",)
    driven = levels.excited.motion
    joint = int(np.argmax(np.maximum(levels.odd.motion, levels.even.motion) / driven))

    def share(level: Array) -> str:
        return f"{100.0 * float(level[joint] / driven[joint]):.2g} %"

    found = (
        f"On lines that nothing drove, joint {joint + 1} answers with {share(levels.odd.motion)} of a driven line's "
        f"motion on odd ones (friction, gravity) and {share(levels.even.motion)} on even ones (offsets, what differs "
        f"with direction); noise is {share(levels.noise)}. The model leaves {share(levels.odd.left)} and "
        f"{share(levels.even.left)}."
    )
    beyond = [
        mend
        for group, mend in ((levels.odd, ODD_MEND), (levels.even, EVEN_MEND))
        if np.any(group.left > BEYOND_NOISE * levels.noise)
    ]
    return (" ".join((found, *beyond)),)


def _predicted(held_out: Array | None) -> tuple[str, ...]:
    if held_out is None:
        return ("No other motion checked it: set experiment.held_out = true.",)
    worst = 100.0 * float(held_out.max())
    return (f"It predicts a motion that it never saw to within {worst:.2g} % of that motion's RMS.",)


def _weak(validation: Validation) -> tuple[str, ...]:
    name = validation.weakest
    part = validation.relative_std[name]
    if part <= WELL_KNOWN:
        return (f"Known least well is {name}, to {100 * part:.2g} %.",)
    mend = MEND[name.split("_")[0]]
    return (f"Weak: {name} is known to {100 * part:.2g} % only. What would mend it is {mend}.",)


def _alike(validation: Validation) -> tuple[str, ...]:
    first, second, correlation = validation.confounded
    if abs(correlation) < ALIKE:
        return ()
    return (
        f"{first} and {second} are hard to tell apart (correlation {correlation:.3f}): excite more lines, or with "
        "more torque.",
    )


def _outliers(estimate: Estimate, validation: Validation) -> tuple[str, ...]:
    # Where the model lacks something, what is far from it is no fault of the reading.
    if not estimate.outliers or validation.residual_over_floor.max() > EXPLAINED:
        return ()
    return (f"{estimate.outliers} readings were far off and downweighted; if that goes on, look at cables and baud.",)
