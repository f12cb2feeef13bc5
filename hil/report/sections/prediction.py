"""Section on measured and predicted position, and the residual in encoder steps."""

import numpy as np

from hil.report.chart import BLUE, GREEN, ORANGE, Chart, Series
from hil.report.run_data import RunData
from hil.report.section import Picture, Section
from hil.report.words import percent, steps
from hil.runs.period_file import PlayedPeriod


def prediction(data: RunData) -> Section | None:
    """The section; None if the run has no settled periods."""
    if data.fitted is None:
        return None
    pictures = []
    for joint, name in enumerate(data.names):
        pictures.append(_position(data.fitted, joint, name, "fitted", "the model was fitted to this motion"))
        pictures.append(_residual(data, joint, name))
    if data.held_out is not None:
        for joint, name in enumerate(data.names):
            error = percent(float(data.held_out.relative_error[joint]))
            said = f"held-out motion; prediction error is {error} of the motion's RMS, encoder noise included"
            pictures.append(_position(data.held_out, joint, name, "held out", said))
    words = (
        "The first figures show the settled period that the model was fitted to. A residual that looks like noise "
        "of one step is encoder rounding; a smooth residual comes from an effect that the model lacks.",
    )
    return Section("prediction", "Measured and predicted motion", words, pictures=tuple(pictures))


def _position(period: PlayedPeriod, joint: int, name: str, role: str, said: str) -> Picture:
    time = np.arange(period.position.shape[1]) / period.rate
    measured = Series("measured", time, period.position[joint], BLUE, "broad")
    predicted = Series("predicted", time, period.predicted[joint], ORANGE)
    key = f"position_{joint + 1}_{role.replace(' ', '_')}"
    chart = Chart(
        key, f"Position of {name}, {role} motion", "time in the period [s]", "position [rad]", (measured, predicted)
    )
    return Picture(chart, f"{name}, {role}: {said}.")


def _residual(data: RunData, joint: int, name: str) -> Picture:
    assert data.fitted is not None  # checked by the caller
    left = data.fitted.error[joint] / abs(float(data.record.position_step[joint]))
    time = np.arange(len(left)) / data.fitted.rate
    series = [Series("measured minus predicted", time, left, BLUE, "dots")]
    for level in (-0.5, 0.5):
        ends = np.array([0.0, len(left) / data.fitted.rate])
        series.append(Series("rounding alone" if level > 0 else "", ends, np.full(2, level), GREEN, "dashed"))
    chart = Chart(
        f"residual_{joint + 1}", f"Residual of {name}", "time in the period [s]", "encoder steps", tuple(series)
    )
    rms = steps(data.result.fit.residual_rms_ticks[joint])
    return Picture(chart, f"{name}: {rms} steps RMS remain; rounding alone stays within half a step.")
