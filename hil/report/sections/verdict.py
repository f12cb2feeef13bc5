"""Section with the verdict stored in the result: whether the model can be trusted, why or why not, and what to do."""

from hil.estimation.torque_constants import by_voltage_said, torque_constants_said
from hil.estimation.truth import truth_of
from hil.report.run_data import RunData
from hil.report.section import Section
from hil.report.words import listed, percent, steps

TITLES = {
    "yes": ("good", "This model can be trusted"),
    "with care": ("fair", "This model can be used with care"),
    "no": ("poor", "Do not trust this model yet"),
}


def verdict(data: RunData) -> Section:
    judged = data.result.verdict
    tone, title = TITLES[judged.trust]
    warnings = [f"Warning: {warning}" for warning in data.result.warnings]
    words = [
        *(_residual(data), _truth(data), _limits(data)),
        *(_torque_constants(data), by_voltage_said(data.config.joints), _hardware(data)),
    ]
    bullets = (*judged.sentences, *warnings, *(word for word in words if word))
    return Section("verdict", title, tone=tone, bullets=bullets)


def _residual(data: RunData) -> str:
    fit = data.result.fit
    left = listed([steps(value) for value in fit.residual_rms_ticks])
    floor = fit.quantisation_floor_ticks
    return f"{left} encoder steps RMS of the motion remain unexplained; rounding alone gives {floor}."


def _truth(data: RunData) -> str:
    truth, found = truth_of(data.result, data.config), data.result.parameters
    told = []
    counted = {name: truth.standard_errors(name, entry) for name, entry in found.items()}
    if sigmas := {name: abs(error) for name, error in counted.items() if error is not None}:
        worst = max(sigmas, key=lambda name: sigmas[name])
        told.append(f"{sigmas[worst]:.1f} standard errors ({worst})")
    known = {name: truth.values[name] for name, entry in found.items() if truth.is_determined(name, entry)}
    if shares := {name: abs(found[name].value / value - 1) for name, value in known.items()}:
        worst = max(shares, key=lambda name: shares[name])
        told.append(f"{percent(shares[worst])} among the well-determined values ({worst})")
    if not told:
        return ""
    said = f"This is a fake arm with known true parameters: the largest error is {', and '.join(told)}."
    return f"{said} {truth.note}".rstrip()


def _limits(data: RunData) -> str:
    timing = data.result.timing
    lost, missed = timing.lost_replies, timing.missed_ticks
    if not lost and not missed:
        return f"No reply was lost and no tick missed in {timing.seconds:.0f} s at {data.config.experiment.rate:g} Hz."
    return f"{lost} replies were lost and {missed} of {timing.samples} ticks missed."


def _torque_constants(data: RunData) -> str:
    return torque_constants_said(data.model.joints, data.result.extra)


def _hardware(data: RunData) -> str:
    return "The servos were simulated (fake bus): nothing here was measured on hardware." if data.config.is_fake else ""
