"""Extraction of the settled periods of one multisine from a recording."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.errors import RecordingCutShort
from hil.estimation.drive.supply import supply_sag, torque_factor
from hil.estimation.lateness import acting_torque, lateness, velocity_of
from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.periodicity import settling_difference
from hil.estimator.data.repeated_noise import coloured_noise, repeated_noise
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.simulation.closed_loop import Stabilised
from hil.plan.stabiliser import feedback_of, feedback_torque
from hil.runs.recording import Phase
from hil.runs.run_folder import RunFacts

_AROUND_S, _FEWEST_AROUND = 0.04, 4
"""A sample's velocity is determined from the readings within this time [s] on each side of it, or from this many
readings on each side if fewer lie within that time.
"""


def settled_period(config: Config, facts: RunFacts, samples: NDArray[np.void], role: str) -> SettledPeriod:
    """Extract the settled periods of the multisine with this `role`. Raises RecordingCutShort."""
    experiment = config.experiment
    count = experiment.samples
    chosen = (samples["phase"] == Phase.PERIODIC) & (samples["segment"] == facts.segments.index(role))
    rows = samples[chosen]
    whole = len(rows) // count
    periods = rows[: whole * count].reshape(whole, count)
    position = np.moveaxis(periods["position"], 2, 1)
    position = np.where(np.isfinite(position), position, np.nan)
    for index, joint in enumerate(config.joints):
        if whole and not np.isfinite(position[:, index]).any():
            raise RecordingCutShort(f"{joint.name} returned no position during {role!r}: check its cable and ID.")
    first = _first_settled(position, experiment.settle_within)
    if first is None and whole > max(experiment.max_settling_periods, experiment.periods):
        first = _drifting(position, experiment.drift_within, experiment.periods)
    if first is None or whole - first < experiment.periods:
        wanted = experiment.periods + 1
        raise RecordingCutShort(
            f"The recording holds {len(rows)} samples of the multisine for {role!r}, {whole} whole "
            + ("period" if whole == 1 else "periods")
            + (
                f": it ended too early. {wanted} periods ({wanted * count} samples) are needed. Record again."
                if whole < wanted
                else f", in which the motion did not become periodic to within experiment.settle_within = "
                f"{experiment.settle_within:g} for {experiment.periods} periods. Record again, for longer."
            )
        )
    begin, end = first * count, (first + experiment.periods) * count
    # Includes the row before, whose goal is in effect until the first write.
    goals = rows["goal_current"][begin - 1 : end].T * _torque_constants(config)[:, None]
    goals = goals * torque_factor(config, supply_sag(config, samples), rows[begin - 1 : end]).T
    late = lateness(rows[begin:end])
    torque = acting_torque(goals, late, experiment.rate)
    angle = position[first : first + experiment.periods]
    period = SettledPeriod(
        rate=experiment.rate,
        torque=_by_period(torque, count).mean(axis=0),
        position=_mean_of_periods(angle),
        command_to_sample=facts.command_to_sample,
        position_step=np.array(facts.position_step),
        periods=experiment.periods,
        stabiliser=None if config.stabiliser is None else _stabilised(config, rows, torque, begin),
        before=_state_at(samples, int(np.flatnonzero(chosen)[begin - count]), experiment.rate),
    )
    on_time = angle - velocity_of(period) * _by_period(late[None], count)
    passes = _passes(position, first, on_time)
    return replace(
        period,
        position=_mean_of_periods(on_time),
        position_std=scatter(on_time),
        repeated_noise=repeated_noise(passes, period.position_step, experiment.periods),
        coloured_noise=coloured_noise(passes, period.position_step, experiment.periods),
    )


def _passes(position: Array, first: int, on_time: Array) -> tuple[Array, ...]:
    """Second halves of the settled periods `on_time` (periods, joints, samples) and of the period before them. The
    first half of that earlier period may still contain a transient.
    """
    half = on_time.shape[2] // 2
    return position[first - 1, :, half:], *on_time[:, :, half:]


def _mean_of_periods(position: Array) -> Array:
    """Mean of (periods, joints, samples) over the periods, ignoring missing values; NaN if all are missing."""
    count = np.isfinite(position).sum(axis=0)
    mean: Array = np.where(count > 0, np.nansum(position, axis=0) / np.maximum(count, 1), np.nan)
    return mean


def _state_at(samples: NDArray[np.void], row: int, rate: float) -> Array | None:
    """Angles and velocities (2, joints) [rad, rad/s] at `row`, from a cubic fitted to nearby readings; None if too many
    are missing.
    """
    half = max(_FEWEST_AROUND, round(_AROUND_S * rate))
    near = slice(max(0, row - half), row + half + 1)
    seconds = samples["deadline"][near] - samples["deadline"][row]
    state = []
    for position in samples["position"][near].T:
        known = np.isfinite(position)
        if known.sum() < 2 * _FEWEST_AROUND:
            return None
        state.append(linalg.polyfit(seconds[known], position[known], 3)[:2])
    return np.ascontiguousarray(np.transpose(state))


def _by_period(values: Array, count: int) -> Array:
    """Split (joints, samples) into periods of `count` samples: (periods, joints, count)."""
    return np.moveaxis(values.reshape(len(values), -1, count), 1, 0)


def _torque_constants(config: Config) -> Array:
    return np.array([joint.torque_per_goal for joint in config.joints])


def _stabilised(config: Config, rows: NDArray[np.void], torque: Array, first: int) -> Stabilised:
    """Separate the stabiliser's contribution from `torque` (joints, samples) [N m], which starts at row `first`."""
    with_former = rows[first - 1 : first + torque.shape[1]]
    given = np.nan_to_num(feedback_torque(config, with_former)).T
    excitation = _by_period(torque - given, config.experiment.samples).mean(axis=0)
    position: Array = with_former["position"][0]
    velocity: Array = with_former["velocity"][0]
    former = np.nan_to_num(np.stack((position, velocity)))
    commanded = with_former["goal_current"][0] * _torque_constants(config)
    return Stabilised(feedback_of(config), np.ascontiguousarray(excitation), former, commanded)


def scatter(position: Array) -> Array | None:
    """Standard deviation of the mean over periods for each joint (joints,) [rad], from (periods, joints, samples); None
    for a single period.
    """
    count = len(position)
    if count < 2:
        return None
    seen = np.isfinite(position).sum(axis=0)
    mean = np.nansum(position, axis=0) / np.maximum(seen, 1)
    squares = np.nansum((position - mean) ** 2, axis=0)
    # Samples received in only one period, or in none, reveal nothing about the scatter.
    several = seen > 1
    variance = np.where(several, squares / np.maximum(seen - 1, 1), 0.0).sum(axis=1)
    std: Array = np.sqrt(variance / np.maximum(several.sum(axis=1), 1) / count)
    return std


def _first_settled(position: Array, within: float) -> int | None:
    """Index of the first period that matches the one before it, by the criterion used while streaming; None if there is
    none.
    """
    for period in range(1, len(position)):
        if settling_difference(position[period - 1], position[period]) <= within:
            return period
    return None


def _drifting(position: Array, within: float, wanted: int) -> int | None:
    """Index at which the last `wanted` periods begin if only slow drift remains; otherwise None."""
    return len(position) - wanted if settling_difference(position[-2], position[-1]) <= within else None
