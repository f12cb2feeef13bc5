"""Section on the spectra of excitation and response, compared with the noise level."""

from itertools import cycle

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.data.fourier import lines_of, noise_power
from hil.plan.plan import IDENTIFY
from hil.report.chart import BLUE, GREEN, GREY, OF_JOINTS, ORANGE, Chart, Series
from hil.report.run_data import RunData
from hil.report.section import Picture, Section, Table
from hil.report.words import steps
from hil.runs.period_file import PlayedPeriod

_KINDS = {
    "excited": "excited",
    "odd": "odd, not excited (friction, gravity)",
    "even": "even, not excited (offsets, direction)",
    "other": "not excited",
}
_BEYOND = 3.0  # highest frequency shown, relative to the highest excited line


def spectra(data: RunData) -> Section | None:
    """The section; None if the run has no settled period."""
    if data.fitted is None:
        return None
    excited = _excited(data)
    words = (
        "Each joint has its own spectral lines, so that their effects on one another can be told apart. The response "
        "between and above the excited lines comes from the arm's nonlinearity, mainly friction: the model must "
        "explain it too, and it contains information about the parameters. This response should be well above the "
        "noise.",
    )
    pictures = [_excitation(data, data.fitted, excited)]
    pictures += [_response(data.fitted, joint, name, excited) for joint, name in enumerate(data.names)]
    return Section("spectra", "Excitation and response", words, _levels(data), tuple(pictures))


def _levels(data: RunData) -> tuple[Table, ...]:
    """Table of RMS motion and residual per spectral line, by kind of line; empty for older results, which lack these
    values.
    """
    levels = data.result.validation.line_levels_ticks
    if levels is None:
        return ()
    rows = [
        (f"{_KINDS[key]}, {name}", str(group.lines), steps(group.motion[joint]), steps(group.left[joint]))
        for key, group in levels.groups.items()
        for joint, name in enumerate(data.names)
    ]
    rows += [(f"noise, {name}", "", steps(levels.noise[joint]), "") for joint, name in enumerate(data.names)]
    head = ("lines", "number", "motion per line [steps]", "model residual [steps]")
    return (Table(head, tuple(rows), caption="RMS per spectral line, by kind"),)


def _excited(data: RunData) -> list[list[int]]:
    entry = next(entry for entry in data.record.excitation if entry.role == IDENTIFY)
    return [list(lines) for lines in entry.lines]


def _excitation(data: RunData, period: PlayedPeriod, excited: list[list[int]]) -> Picture:
    amplitude = 2 * np.abs(lines_of(period.torque))
    series = [
        _points(f"torque of {name}", amplitude[joint], np.array(excited[joint]), period, colour)
        for joint, (name, colour) in enumerate(zip(data.names, cycle(OF_JOINTS), strict=False))
    ]
    chart = Chart("excitation", "Excitation", "frequency [Hz]", "torque amplitude [N m]", tuple(series))
    peaks = ", ".join(f"{name} {np.abs(period.torque[joint]).max():.3g} N m" for joint, name in enumerate(data.names))
    return Picture(chart, f"Spectral lines of the commanded torque. Peaks in the time domain: {peaks}.")


def _response(period: PlayedPeriod, joint: int, name: str, excited: list[list[int]]) -> Picture:
    filled = np.where(np.isfinite(period.position), period.position, period.predicted)
    lines = lines_of(filled)
    amplitude = 2 * np.abs(lines[joint])
    own = np.array(excited[joint])
    others = np.array([line for other, found in enumerate(excited) if other != joint for line in found], dtype=int)
    shown = np.arange(1, min(len(amplitude), int(_BEYOND * max(map(max, excited)))))
    silent = np.setdiff1d(shown, np.concatenate((own, others)))
    noise = 2 * np.sqrt(noise_power(lines)[joint])
    ends = np.array([0.0, shown[-1] * _fundamental(period)])
    series = [
        _points("not excited", amplitude, silent, period, GREY),
        _points("excited in another joint", amplitude, others, period, GREEN),
        _points("excited in this joint", amplitude, own, period, BLUE),
        Series("noise", ends, np.full(2, noise), ORANGE, "dashed"),
    ]
    kept = tuple(one for one in series if one.x.size)
    chart = Chart(
        f"response_{joint + 1}", f"Response of {name}", "frequency [Hz]", "position amplitude [rad]", kept, log_y=True
    )
    return Picture(
        chart, f"{name}: spectral lines of its motion. The noise level is taken from the upper half of all lines."
    )


def _points(name: str, amplitude: Array, index: Array, period: PlayedPeriod, colour: str) -> Series:
    return Series(name, index * _fundamental(period), amplitude[index], colour, "points")


def _fundamental(period: PlayedPeriod) -> float:
    return period.rate / float(period.position.shape[1])
