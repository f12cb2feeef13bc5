"""The verdict in words: can this model be trusted, why, and what to do if not."""

from hil.report.run_data import RunData
from hil.report.section import Section
from hil.report.words import listed, percent, steps
from hil.result_table import GOOD_RESIDUAL_TICKS
from hil.torque_constants import torque_constants_said

GOOD_PREDICTION, USABLE_PREDICTION = 0.01, 0.05
"""Error of the free prediction, of the motion's RMS, up to which a model is called good, and usable."""


def verdict(data: RunData) -> Section:
    """Always there."""
    tone, title = _judgement(data)
    words = [_residual(data), _prediction(data), _truth(data), _limits(data), _torque_constants(data), _hardware(data)]
    return Section(
        "verdict", title, tone=tone, bullets=tuple(word for word in words if word), words=_advice(data, tone)
    )


def _judgement(data: RunData) -> tuple[str, str]:
    explained = max(data.result["fit"]["residual_rms_ticks"]) <= GOOD_RESIDUAL_TICKS
    predicted = data.result["validation"].get("held_out_rms")
    worst = max(predicted) if predicted else None
    if worst is None:
        return ("good", "The model explains this motion; nothing else checked it") if explained else _UNSURE
    if worst <= GOOD_PREDICTION:
        return "good", "This model can be trusted" if explained else "This model predicts well"
    if worst <= USABLE_PREDICTION:
        return "fair", "Usable, but something moves that the model does not have"
    return "poor", "Do not trust this model yet"


_UNSURE = ("fair", "Something moves that the model does not have, and nothing checked how much it matters")


def _residual(data: RunData) -> str:
    fit = data.result["fit"]
    left = listed([steps(value) for value in fit["residual_rms_ticks"]])
    floor = fit["quantisation_floor_ticks"]
    if max(fit["residual_rms_ticks"]) <= GOOD_RESIDUAL_TICKS:
        return f"It explains the motion down to the encoder's rounding: {left} steps are left, rounding is {floor}."
    return f"It leaves {left} encoder steps of the motion unexplained; the encoder's rounding is {floor} of them."


def _prediction(data: RunData) -> str:
    errors = data.result["validation"].get("held_out_rms")
    if not errors:
        return ""
    return (
        f"It predicts another motion, which it never saw, to within {listed([percent(value) for value in errors])} of "
        f"that motion's RMS ({listed(data.names)})."
    )


def _truth(data: RunData) -> str:
    truth = data.result.get("truth")
    if not truth:
        return ""
    found = data.result["parameters"]
    errors = {name: abs(found[name]["value"] / value - 1) for name, value in truth.items() if value and name in found}
    worst = max(errors, key=lambda name: errors[name])
    return f"The arm is a fake one and knows its truth: the worst parameter is {percent(errors[worst])} off ({worst})."


def _limits(data: RunData) -> str:
    timing = data.result["timing"]
    lost, missed = timing["lost_replies"], timing["missed_ticks"]
    if not lost and not missed:
        return (
            f"No reply was lost and no tick missed in {timing['seconds']:.0f} s at {data.config.experiment.rate:g} Hz."
        )
    return f"{lost} replies were lost and {missed} of {timing['samples']} ticks missed."


def _torque_constants(data: RunData) -> str:
    return torque_constants_said(data.model.joints, data.result["extra"])


def _hardware(data: RunData) -> str:
    return "The servos were a fake bus: nothing here was measured on hardware." if data.config.is_fake else ""


def _advice(data: RunData, tone: str) -> tuple[str, ...]:
    if tone == "good":
        return ()
    richer = {"coulomb": "stribeck", "stribeck": "stribeck_load"}.get(data.config.model.friction)
    friction = f'Try friction = "{richer}" under [model] and hil estimate. ' if richer else ""
    return (f"{friction}Try a larger experiment.peak_torque; look for play, a dragging cable or a loose screw.",)
