"""One intermediate run: its execution, the comparison with its prediction, and the report."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.prediction import GUARDED, QUANTITIES, UNITS, peaks_of
from hil.errors import Cause, DidNotMove, ExperimentError, NotSettled, SafetyStop, symptom_of
from hil.estimator.arrays import Array, Mask
from hil.experiment.run import run_experiment
from hil.experiment.stream import Watch
from hil.pilot.belief import MOVED_STEPS
from hil.pilot.punctual import punctual
from hil.pilot.seen import Seen, seen_of
from hil.pilot.supply import delivered_speed
from hil.results.parts import PlayedStep
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from hil.setup.session.servo_session import Say

_AT_A_LIMIT = (Cause.POSITION, Cause.VELOCITY, Cause.OUT_OF_VOLTAGE)


_BESIDE = 2
"""Largest number of joints for which the table shows predicted and measured peaks side by side."""


@dataclass(frozen=True)
class Step:
    """One intermediate run.

    name: name shown to the user. peak_torque: peak torques (joints,) [N m]. median, quantile, seen:
    predicted peaks (median and 99 % quantile of the simulated arms) and measured peaks, each (quantities, joints) in
    the order of hil.dry_run.prediction.QUANTITIES. ended: why the run ended early; empty if it did not.
    """

    name: str
    peak_torque: Array
    median: Array
    quantile: Array
    seen: Array
    ended: str = ""

    @property
    def within(self) -> bool:
        """Whether no measured peak of a limited quantity exceeded the peak predicted for 99 % of the arms."""
        low, high, velocity = self.seen[:GUARDED]
        bounds = self.quantile
        return bool((low >= bounds[0]).all() and (high <= bounds[1]).all() and (velocity <= bounds[2]).all())

    def __str__(self) -> str:
        torque = ", ".join(f"{value:.3g}" for value in self.peak_torque)
        rows = [("", "predicted", "99 % within", "measured")] + [
            (
                f"{QUANTITIES[row]} [{UNITS[row]}]",
                *(_list(each[row]) for each in (self.median, self.quantile, self.seen)),
            )
            for row in range(GUARDED)
        ]
        lines = _beside(rows) if len(self.peak_torque) <= _BESIDE else _below(rows)
        return "\n  ".join((f"{self.name}, peak torque {torque} N m:", *lines))

    def played(self) -> PlayedStep:
        """The step in the form stored in a result."""
        median, quantile, seen = (tuple(map(tuple, rows.tolist())) for rows in (self.median, self.quantile, self.seen))
        torque = tuple(self.peak_torque.tolist())
        return PlayedStep(self.name, torque, median, quantile, seen, self.within, self.ended or None)


@dataclass(frozen=True)
class Played:
    """The outcome of a run.

    step: comparison with the prediction. seen: commands and motion; None if too few samples were recorded. torque:
    sentence about the final torque state. error: error that ended the run early, or None; only errors that are
    informative about the arm, not those of the servos, the bus or the user.
    """

    step: Step
    seen: Seen | None
    torque: str
    error: ExperimentError | None
    delivered: Array | None = None

    @property
    def passed_limit(self) -> bool:
        """Whether the guard stopped the run at a motion limit."""
        return isinstance(self.error, SafetyStop) and self.error.cause in _AT_A_LIMIT

    @property
    def passed_velocity_limit(self) -> bool:
        """Whether the guard stopped the run because a joint was too fast."""
        return isinstance(self.error, SafetyStop) and self.error.cause is Cause.VELOCITY

    def stood_still(self, swing: Array) -> Mask:
        """Which joints (joints,) stood still in a run that was stopped for this reason.

        swing: range of motion (joints,) [encoder steps].
        """
        unexpected = isinstance(self.error, SafetyStop) and self.error.cause is Cause.UNEXPECTED
        stood = (swing <= MOVED_STEPS) & (unexpected or isinstance(self.error, DidNotMove))
        if isinstance(self.error, DidNotMove) and self.error.joint is not None:
            stood[self.error.joint] = True  # it may have moved before
        return np.asarray(stood)

    @property
    def unlike_before(self) -> bool:
        """Whether the run was stopped because its motion did not repeat."""
        return isinstance(self.error, SafetyStop) and self.error.cause is Cause.UNLIKE_BEFORE


@dataclass(frozen=True)
class Player:
    """Plays runs and reports them.

    shown_path: path of the configuration file, for messages. watch: observer of the sample stream. say: shows a
    message.
    """

    shown_path: Path
    watch: Watch
    say: Say

    def play(self, config: Config, folder: RunFolder, name: str, found: Amplitude, arms: Ensemble) -> Played:
        """Play one run on an arm that could be any of `arms`, compare it with the prediction, and report.

        A run that is stopped because of missed deadlines is repeated. Raises the same errors as a run, except those
        that are informative about the arm (`tells_of_the_arm`).
        """
        torque, error = "", None
        try:
            torque = punctual(
                lambda: run_experiment(config, folder, self.shown_path, self.watch, found.plan, arms),
                config,
                folder,
                name,
                self.say,
            )
        except ExperimentError as stopped:
            if not (tells_of_the_arm(stopped) or _stood_still(config, folder, stopped)):
                raise
            torque, error = " ".join(getattr(stopped, "__notes__", [])), stopped
        samples = load_samples(folder.samples_path, len(config.joints))
        peaks = peaks_of(config, samples["position"].T, samples["velocity"].T, samples["goal_current"].T)
        prediction = found.prediction
        step = Step(name, found.peak_torque, prediction.median, prediction.quantile, peaks, str(error or ""))
        self.say(str(step))
        if error is not None:
            self.say(ended_early(name, error))
        if not step.within:
            self.say(
                f"{name}: measured peaks exceed those of 99 % of the simulated arms; the arm differs from the "
                "assumptions."
            )
        limited = isinstance(error, SafetyStop) and error.cause is Cause.OUT_OF_VOLTAGE
        delivered = delivered_speed(config, samples) if limited else None
        return Played(step, seen_of(config, samples), torque, error, delivered)


def ended_early(name: str, error: ExperimentError) -> str:
    """Say why a run ended early.

    If a joint did not move, or the motion did not settle, what to do about it is the pilot's task, and is not said.
    """
    return f"{name} ended early: {error if isinstance(error, SafetyStop) else f'{symptom_of(error)}.'}"


def tells_of_the_arm(error: ExperimentError) -> bool:
    """Whether the error is informative about the arm, so that another run may follow: limit exceeded, no motion, no
    steady motion, or a period that differs from the one before.

    Errors caused by another program, or by goals that were altered in transit, are not informative.
    """
    if isinstance(error, SafetyStop):
        return not error.overruled and (error.cause in _AT_A_LIMIT or error.cause is Cause.UNLIKE_BEFORE)
    return isinstance(error, NotSettled | DidNotMove)


def _stood_still(config: Config, folder: RunFolder, error: ExperimentError) -> bool:
    """Whether the only deviation from the prediction was that a joint did not move at all, because friction is larger
    than assumed.
    """
    if not isinstance(error, SafetyStop) or error.cause is not Cause.UNEXPECTED or error.overruled:
        return False
    position = load_samples(folder.samples_path, len(config.joints))["position"]
    step = np.array([joint.joint.servo.position_unit for joint in config.joints])
    return bool((np.nanmax(position, axis=0) - np.nanmin(position, axis=0) <= MOVED_STEPS * step).any())


def _beside(rows: list[tuple[str, ...]]) -> list[str]:
    """A table with one line per quantity."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["   ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _below(rows: list[tuple[str, ...]]) -> list[str]:
    """A table that fits a terminal of 80 columns: one line per quantity and joint."""
    head, *others = rows
    width = max(map(len, head))
    return [
        line
        for name, *cells in others
        for line in (name, *(f"  {what.ljust(width)}  {cell}" for what, cell in zip(head[1:], cells, strict=True)))
    ]


def _list(values: Array) -> str:
    return ", ".join(f"{value:.2f}" for value in values)
