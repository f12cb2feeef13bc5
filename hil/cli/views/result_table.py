"""Print a result in the terminal: parameter, unit, value, standard error and, for a fake arm, the true value."""

import math
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.config.schema import Config
from hil.estimation.physical import physical_lines
from hil.estimation.torque_constants import by_voltage_said, torque_constants_said
from hil.estimation.truth import Truth, truth_of
from hil.next_step import command, next_step
from hil.printing import print_fitting, say
from hil.results.parts import Quantity
from hil.results.result import Result, SettledResult, ShootingResult

_NOTHING = 0.01
"""A true value below this fraction of a standard error is practically 0, and a relative error would be meaningless."""

_MOST_NAMED = 3
"""If more models than this were tried, the output gives their number instead of their names."""

_ALIKE = 0.05
"""Two errors count as equal if their relative difference is smaller than this."""


def print_result(result: SettledResult, config: Config, run: Path, console: Console) -> None:
    """Print the parameter table, the quality of the fit, the verdict and the next commands."""
    truth = truth_of(result, config)
    print_fitting(console, _parameters(result, truth))
    physical = [] if result.physical is None else physical_lines(result.physical)
    told = (*_fit(result), *_choice(result), *_stabiliser(result, config), *_verdict(result))
    told = (*told, *([truth.note] if truth.note else []), *_torque_constants(result, config), *physical)
    for line in (*told, *_next(result, run)):
        say(console, line)


def print_shooting_result(result: ShootingResult, run: Path | None) -> None:
    """Print a multiple-shooting result. run: folder of the result."""
    print(f"{result.joints}-joint arm, {result.config}")
    for name, entry in result.quantities.items():
        value, std = _shown(entry)
        print(f"{name:22s} {entry.unit:10s} {value:>12s} {std:>9s}")
    rms = ", ".join(f"{1000 * value:.3g}" for value in result.fit.residual_rms_rad)
    for found in result.zeros or ():
        shown = ", ".join(f"{zero:.4f} +- {std:.1g}" for zero, std in zip(found.zero, found.std, strict=True))
        print(f"Encoder zeros of {found.recording or result.config}: {shown} rad.")
    print(f"{result.method}.")
    steps = ", ".join(f"{value:.3g}" for value in result.fit.residual_rms_ticks)
    counted = f", {steps} encoder steps" if steps else ""
    if all(map(math.isfinite, result.fit.residual_rms_rad)):
        print(f"Residual {rms} mrad RMS{counted} over {result.fit.segments} segments.")
    else:
        print("Regression on the measured torque: no motion was simulated, so there is no position residual.")
    if result.model_choice is not None:
        choice = result.model_choice
        compared = (
            ", the simplest model"
            if choice.chosen == choice.plainest
            else f". Compared with the simplest model, its error is {_times(_inverse(choice.error_divided_by))}"
        )
        print(f"Chosen on held-out segments: {choice.chosen}{compared}.")
    if result.physical is not None:
        print("\n".join(physical_lines(result.physical)))
    for note in result.notes:
        print(f"Note: {note}")
    for warning in result.warnings:
        print(f"Warning: {warning}")
    if result.verdict is not None:
        print(f"Trust this model: {result.verdict.trust}. " + " ".join(result.verdict.sentences))
    if run is not None:
        print(f"Run folder: {run}, report: {run / 'report.html'}")
        if result.arm is not None:
            print(what_next(result, run))


def _parameters(result: SettledResult, truth: Truth) -> Table:
    # Narrow enough for 80 columns, so that no number is truncated.
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.title, table.title_justify, table.title_style = (
        f"{result.joints}-joint arm, {escape(str(result.config))}",
        "left",
        "",
    )
    table.add_column("parameter", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for heading in ("value", "std", *(("truth", "error %", "in std.") if truth.values else ())):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, entry in result.parameters.items():
        table.add_row(escape(name), escape(entry.unit), *_numbers(name, entry, truth))
    table.add_row()
    for name, entry in result.extra.items():
        table.add_row(escape(name), escape(entry.unit), *_shown(entry))
    table.add_row()
    return table


def _shown(entry: Quantity) -> list[str]:
    """Return the value and its standard error; "undetermined" and "-" if the motion does not determine the value."""
    return [f"{entry.value:.5g}", f"{entry.std:.1e}"] if entry.std < math.inf else ["undetermined", "-"]


def _numbers(name: str, entry: Quantity, truth: Truth) -> list[str]:
    value, std = entry.value, entry.std
    cells = _shown(entry)
    if name not in truth.values:
        return [*cells, "", "", ""] if truth.values else cells
    true = truth.values[name]
    percent = "-" if abs(true) <= _NOTHING * std else f"{100 * (value - true) / abs(true):+.3f}"
    counted = truth.standard_errors(name, entry)
    return [*cells, f"{true:.5g}", percent, "-" if counted is None else f"{counted:+.1f}"]


def _fit(result: SettledResult) -> list[str]:
    fit = result.fit
    residual = ", ".join(f"{value:.3f}" for value in fit.residual_rms_ticks)
    lines = [
        f"Residual {residual} encoder steps RMS; encoder rounding alone gives {fit.quantisation_floor_ticks}.",
    ]
    held_out = result.validation.held_out_rms
    if held_out:
        errors = ", ".join(f"{100 * value:.2f} %" for value in held_out)
        what = "path" if result.chain is not None else "multisine"
        how = "Closed-loop" if result.stabiliser is not None or result.chain is not None else "Open-loop"
        lines.append(
            f"{how} prediction of a held-out {what}: error {errors} of the motion's RMS, encoder noise included."
        )
    return lines


def _choice(result: SettledResult) -> list[str]:
    choice = result.model_choice
    if not choice:
        return []
    tried = list(dict.fromkeys(trial.model for trial in choice.tried))
    if len(tried) == 1:
        return [f"Model chosen: {choice.chosen}. The data do not support any additional term."]
    among = ", ".join(tried) if len(tried) <= _MOST_NAMED else f"{len(tried)} candidates"
    cost = choice.standard_errors_times
    if choice.chosen == choice.plainest:
        return [f"Model chosen from {among}: {choice.chosen}, the one with the fewest parameters."]
    if choice.error_divided_by <= 1.0 + _ALIKE:
        return [
            f"Model chosen from {among}: {choice.chosen}. It predicts about as well as {choice.plainest}, but its "
            "additional terms are significant in the fitted motion."
        ]
    smaller = f"its prediction error is {_times(_inverse(choice.error_divided_by))}"
    wider = "" if cost is None else f" and its standard errors are {_times(cost)}"
    return [f"Model chosen from {among}: {choice.chosen}. Compared with {choice.plainest}, {smaller}{wider}."]


def _inverse(ratio: float) -> float | None:
    return 1.0 / ratio if 0.0 < ratio < math.inf else None


def _times(ratio: float | None) -> str:
    if ratio is None or not 0.0 < ratio < math.inf:
        return "not comparable"
    if abs(ratio - 1.0) < _ALIKE:
        return "about the same"
    return f"larger by a factor of {ratio:.3g}" if ratio > 1.0 else f"smaller by a factor of {1.0 / ratio:.3g}"


def _verdict(result: SettledResult) -> list[str]:
    verdict = result.verdict
    said = [*verdict.sentences, *(f"Warning: {warning}" for warning in result.warnings)]
    return [f"Trust this model: {verdict.trust}. " + " ".join(said)]


def _stabiliser(result: SettledResult, config: Config) -> list[str]:
    if result.stabiliser is None:
        return []
    return [result.stabiliser.said([joint.name for joint in config.joints])]


def _torque_constants(result: SettledResult, config: Config) -> list[str]:
    said = [by_voltage_said(config.joints), torque_constants_said(config.joints, result.extra)]
    return [each for each in said if each]


def _next(result: SettledResult, run: Path) -> list[str]:
    return [
        f"Run folder: {run}, report: {run / 'report.html'}",
        *([] if _is_useless(result) else [f"To estimate again from the recording: {command('estimate', run)}"]),
        *what_next(result, run).splitlines(),
    ]


def what_next(result: Result, run: Path) -> str:
    """Return the line that names the next command. It is `hil export`, unless the verdict is "no" or asks for something
    to be corrected first; then it is `hil check` or, for recordings made with other tools, `hil estimate`. A correction
    is stated on a line of its own before the command.
    """
    first = None if result.verdict is None else result.verdict.first
    if first is not None:
        return f"First {first}.\n{_next_command(result, run)}"
    return _next_command(result, run)


def _next_command(result: Result, run: Path) -> str:
    has_doubts = result.verdict is not None and result.verdict.first is not None
    if not _is_useless(result) and not has_doubts:
        return next_step("export", run, "--format", _usual_format(result))
    return next_step("estimate", run) if _is_of_recordings(result) else next_step("check", result.config)


def _is_of_recordings(result: Result) -> bool:
    return isinstance(result, ShootingResult) and bool(result.recordings)


def _is_useless(result: Result) -> bool:
    return result.verdict is not None and result.verdict.trust == "no"


def _usual_format(result: Result) -> str:
    """Return a format that suits this arm: MJCF needs the length of link 1, which only gravity reveals."""
    flat = result.chain is None and result.arm is not None and not result.arm.gravity
    return "toml" if flat else "mjcf"
