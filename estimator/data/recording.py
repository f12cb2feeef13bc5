"""A recording of arbitrary motion: torque and position at the actual sampling times."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.errors import RecordingError, ShapeError, StandstillError

Between = Literal["held", "linear"]

FEWEST_SAMPLES = 32
LEAST_VALID = 0.5  # minimum fraction of a joint's samples that must be valid
LEAST_MOTION = 4.0  # minimum range of motion in encoder steps
MOST_GAP = 0.2  # s between samples; longer intervals would not resolve the motion
MOST_INTERVALS, SHORTEST_GAP = 8.0, 0.04  # gaps exceed both this many typical intervals and this many seconds
LONGEST_GAP = 10.0  # s; longest gap within one recording
LEAST_NOISE = 1e-5  # rad: lower bound for any arm's encoder
MOST_ANGLE = 200.0  # rad; larger values must be in degrees or encoder steps
MOST_SPEED = 500.0  # rad/s between samples, likewise
MOST_TORQUE = 1e4  # N m


@dataclass(frozen=True)
class Recording:
    """Torque and position of an arm in arbitrary motion: ramps, swing-ups, or recordings from other tools.

    Missing positions are NaN. Raises ShapeError for incompatible arrays; RecordingError for times that do not increase,
    non-finite values, gaps, and values that are implausible in SI units; StandstillError for a joint that moved by only
    a few encoder steps.
    """

    time: Array
    """Sampling times of the positions (samples,) [s]; the intervals need not be equal."""
    torque: Array
    """Motor torque (joints, samples) [N m]."""
    position: Array
    """Joint angles (joints, samples) [rad]."""
    position_step: Array
    """Quantisation of each joint's angle (joints,) [rad]."""
    between: Between = "linear"
    """Torque between its samples: `held` for a command, `linear` for a measurement."""
    command_to_sample: float = 0.0
    """Time from the instant of torque value k to that of position k [s]."""

    def __post_init__(self) -> None:
        _check_shapes(self)
        _check_times(self)
        _check_values(self)
        _check_motion(self)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self.position.shape[0])

    @property
    def interval(self) -> float:
        """Median time between samples [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def longest_interval(self) -> float:
        """Longest interval between samples that does not count as a gap [s]."""
        return max(MOST_INTERVALS * self.interval, SHORTEST_GAP)

    @cached_property
    def noise(self) -> Array:
        """Standard deviation of one position sample's error (joints,) [rad]: the larger of measured white noise and
        rounding noise.
        """
        rounding = self.position_step / np.sqrt(12.0)
        white = np.array([_white_noise(self.time, row) for row in self.position])
        return np.asarray(np.maximum(rounding, white))

    def filled(self) -> Array:
        """Return the positions (joints, samples) [rad], with missing ones interpolated between their neighbours."""
        position = self.position.copy()
        for row in position:
            valid = np.isfinite(row)
            if not valid.all():
                row[~valid] = np.interp(self.time[~valid], self.time[valid], row[valid])
        return position

    def mean_torque(self, edges: Array, delay: float | Array) -> Array:
        """Return the mean torque between neighbouring `edges` (n,) [s], with a delay of `delay` [s].

        Returns (joints, n - 1) [N m]. delay: one value or one per joint.
        """
        at = self.time - self.command_to_sample
        delays = np.broadcast_to(delay, self.joints)
        rise = np.diff(at)
        means = np.empty((self.joints, len(edges) - 1))
        for joint, torque in enumerate(self.torque):
            wanted = edges - delays[joint]
            if self.between == "held":
                total = np.concatenate(([0.0], np.cumsum(torque[:-1] * rise)))
                k = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, at.size - 1)
                integral = total[k] + torque[k] * (wanted - at[k])
            else:
                total = np.concatenate(([0.0], np.cumsum(0.5 * (torque[:-1] + torque[1:]) * rise)))
                k = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, at.size - 2)
                late = wanted - at[k]
                slope = (torque[k + 1] - torque[k]) / rise[k] * ((wanted >= at[0]) & (wanted <= at[-1]))
                # Beyond either end, the end value is held.
                start = np.where(wanted > at[-1], total[-1] - torque[-1] * rise[-1], total[k])
                level = np.where(wanted > at[-1], torque[-1], torque[k])
                integral = start + late * (level + 0.5 * slope * late)
            means[joint] = np.diff(integral) / np.diff(edges)
        return means


def _white_noise(time: Array, row: Array) -> float:
    """Return the standard deviation of white noise [rad], estimated from fourth-order differences of neighbouring
    samples.

    The median over the recording is used, since motion too fast for a cubic makes up only a small part of it.
    """
    valid = np.isfinite(row)
    time, row = time[valid], row[valid]
    count = time.size - 4
    if count < FEWEST_SAMPLES:
        return LEAST_NOISE
    near = np.arange(count)[:, None] + np.arange(5)
    t, y = time[near] - time[near[:, 2:3]], row[near]
    weight = np.ones((count, 5))
    for i in range(5):
        for j in range(5):
            if i != j:
                weight[:, i] /= t[:, i] - t[:, j]
    # Divided differences of fourth order, which vanish for a cubic.
    left = np.sum(weight * y, axis=1) / np.sqrt(np.sum(weight**2, axis=1))
    return max(LEAST_NOISE, float(np.median(np.abs(left))) / 0.6745)


def _check_shapes(recording: Recording) -> None:
    position, torque, time = recording.position, recording.torque, recording.time
    if position.ndim != 2 or torque.shape != position.shape or time.shape != position.shape[1:]:
        raise ShapeError(
            f"time has shape {time.shape}, torque {torque.shape} and position {position.shape}; they must be "
            "(samples,), (joints, samples) and (joints, samples)"
        )
    if recording.position_step.shape != position.shape[:1]:
        raise ShapeError(f"position_step has shape {recording.position_step.shape}; it must be {position.shape[:1]}")
    if time.size < FEWEST_SAMPLES:
        count = f"{time.size} sample{'' if time.size == 1 else 's'}"
        raise RecordingError(f"the recording has {count}; at least {FEWEST_SAMPLES} are needed")


def _check_times(recording: Recording) -> None:
    time = recording.time
    bad = np.nonzero(~np.isfinite(time))[0]
    if bad.size:
        raise RecordingError(f"time of sample {bad[0] + 1} is not finite: remove the samples without a time")
    step = np.diff(time)
    if np.any(step <= 0.0):
        k = int(np.argmax(step <= 0.0))
        raise RecordingError(
            f"time goes from {time[k]:g} to {time[k + 1]:g} s at sample {k + 2}: it must increase; sort the samples "
            "and remove duplicates"
        )
    if float(np.median(step)) > MOST_GAP:
        raise RecordingError(
            f"samples are {float(np.median(step)):.3g} s apart; at most {MOST_GAP:g} s is allowed. Is time in seconds? "
            "If not, set columns.time_unit"
        )
    if step.max() > LONGEST_GAP:
        k = int(np.argmax(step))
        raise RecordingError(
            f"{step[k]:.3g} s are missing after sample {k + 1} at {time[k]:g} s: split the recording there"
        )


def _check_values(recording: Recording) -> None:
    if not (np.all(recording.position_step > 0.0) and np.isfinite(recording.command_to_sample)):
        raise RecordingError(
            f"position_step {recording.position_step} rad must be positive, and command_to_sample must be finite"
        )
    if not recording.torque.any():
        raise RecordingError("all torques are 0: without torque the scale of the parameters cannot be determined")
    for joint in range(recording.joints):
        torque, position = recording.torque[joint], recording.position[joint]
        bad = np.nonzero(~np.isfinite(torque))[0]
        if bad.size:
            raise RecordingError(
                f"joint {joint + 1}: {bad.size} torques are not finite, the first at sample {bad[0] + 1}, "
                f"{recording.time[bad[0]]:g} s: cut the recording there or fill in the commanded values"
            )
        valid = np.isfinite(position)
        if float(np.mean(valid)) < LEAST_VALID:
            raise RecordingError(
                f"joint {joint + 1}: {100 * float(np.mean(valid)):.0f} % of {position.size} positions are numbers; at "
                f"least {100 * LEAST_VALID:.0f} % are needed"
            )
        most = float(np.abs(torque).max())
        if most > MOST_TORQUE:
            raise RecordingError(
                f"joint {joint + 1}: torque reaches {most:.3g} N m, which exceeds {MOST_TORQUE:g} N m: check its unit"
            )


def _check_motion(recording: Recording) -> None:
    filled = recording.filled()
    for joint, row in enumerate(filled):
        swing = float(row.max() - row.min())
        least = LEAST_MOTION * float(recording.position_step[joint])
        step = np.abs(np.diff(row))
        speed = step / np.diff(recording.time)
        k = int(np.argmax(speed))
        is_turn = abs(step[k] - 2.0 * np.pi) < 0.5  # the angle wraps, even if it then wraps back
        # In the wrong unit, any small movement may look like an outlier.
        if speed[k] > MOST_SPEED and not is_turn and (step[k] > MOST_ANGLE or swing <= MOST_ANGLE):
            for at in {k, k + 1} - {0, row.size - 1}:
                if abs(row[at + 1] - row[at - 1]) < 0.2 * min(step[at - 1], step[at]):
                    raise RecordingError(
                        f"joint {joint + 1}: sample {at + 1} at {recording.time[at]:g} s is {step[k]:.3g} rad away "
                        "from both its neighbours: it is an outlier. Leave such positions empty (NaN)"
                    )
        if not swing:
            raise StandstillError(f"the position of joint {joint + 1} is always {row[0]:.4g} rad: check the column")
        if swing <= least:
            raise StandstillError(
                f"joint {joint + 1} moved by {swing:.2g} rad; at least {least:.2g} rad are needed: check the column "
                "and its unit, or drive the joint harder"
            )
        if swing > MOST_ANGLE:
            raise RecordingError(
                f"joint {joint + 1} moves through {swing:.4g} rad, which exceeds {MOST_ANGLE:g} rad: are these degrees "
                "or encoder steps? Set the column's unit"
            )
        if speed[k] > MOST_SPEED:
            raise RecordingError(
                f"joint {joint + 1} jumps by {step[k]:.3g} rad ({speed[k]:.3g} rad/s) after sample {k + 1} at "
                f"{recording.time[k]:g} s: unwrap the angle, or check its unit"
            )
