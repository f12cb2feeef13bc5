"""Noise of the current readings, measured while the arm rests, and its effect on the check of the current.

The thresholds of `following` assume no more noise than usual. If a sensor is noisier, its thresholds are widened, so
that a healthy motor is not mistaken for a faulty one.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any

import numpy as np

from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.drivers.state import State
from hil.experiment.checks import following

__all__ = ["CurrentNoise", "NoiseAllowance", "Noisy"]

FEWEST_READINGS, MOST_READINGS = 8, 256
"""Number of readings from which noise is first measured, and number of latest readings that are kept."""

_UNCERTAIN = 1.9
"""Largest amount by which n readings may underestimate the noise, as a multiple of the true noise divided by
sqrt(n).
"""

_MAD_TO_SIGMA = 1.4826
"""Ratio of the standard deviation to the median absolute deviation for a normal distribution."""

MOST_NOISE = 0.25
"""Largest accepted noise, relative to the joint's goal limit."""


class CurrentNoise:
    """Standard deviation of the joints' current readings, measured while their goals hardly change.

    Every reading is compared with its goal. The median absolute deviation ignores single wrong replies.
    """

    def __init__(self, joints: Sequence[JointConfig]) -> None:
        self._ticks = np.abs([joint.joint.drive_unit(12.0) for joint in joints])
        self._errors = deque[Any](maxlen=MOST_READINGS)
        self._former: Any = None

    def add(self, state: State) -> bool:
        """Process an exchange; return whether enough readings have been added since the last measurement."""
        goal, former = np.array(state.goal_current), self._former
        self._former = goal
        if (
            former is None
            or True in state.missing
            or (np.abs(goal - former) > following.SIGMA_TICKS * self._ticks).any()
        ):
            return False
        self._errors.append(state.current - goal)
        count = len(self._errors)
        # Measure only once the number of readings has doubled, since this takes time between two samples.
        return FEWEST_READINGS <= count < MOST_READINGS and count & (count - 1) == 0

    def measured(self) -> tuple[list[float], list[float]]:
        """Return each joint's noise and its upper bound [A or V]; both are 0 if there are too few readings."""
        if len(self._errors) < FEWEST_READINGS:
            return [0.0] * len(self._ticks), [0.0] * len(self._ticks)
        errors = np.array(self._errors)
        spread = np.median(np.abs(errors - np.median(errors, axis=0)), axis=0)
        noise = _MAD_TO_SIGMA * spread
        # Rounding may have reduced the spread by half a tick; noise that it hides entirely is below two ticks.
        most = _MAD_TO_SIGMA * (spread + 0.5 * self._ticks) / (1.0 - _UNCERTAIN / len(errors) ** 0.5)
        hidden = np.minimum(most, following.SIGMA_TICKS * self._ticks)
        return noise.tolist(), np.where(spread > 0.25 * self._ticks, most, hidden).tolist()


@dataclass(frozen=True)
class Noisy:
    """A joint whose current reading is noisier than usual.

    said: the noise and its consequence, as text. refused: why the joint cannot be monitored, and what to do; "" if it
    can.
    """

    index: int
    said: str
    refused: str


class NoiseAllowance:
    """Adapts the joints' thresholds to the noise of their current readings.

    records: the joints' records (`joint_checks.JOINT`), whose thresholds are set whenever the noise becomes better
    known. planned: largest goal of each joint [A, or V in PWM mode]. interval: time between two exchanges [s].
    noise: noise of each joint's readings [A or V]; None if not known.
    """

    def __init__(
        self,
        records: Any,
        config: Config,
        planned: Sequence[float],
        interval: float,
        noise: Sequence[float] | None,
    ) -> None:
        self._records, self._joints, self._planned, self._interval = records, config.joints, planned, interval
        self._share = config.safety.follow_share
        self._measured = CurrentNoise(config.joints)
        self.noise = [0.0] * len(config.joints) if noise is None else noise
        """Noise of each joint's current readings, or its upper bound [A or V]; 0 if not known."""
        if noise is not None:
            self._allow(noise)

    def begin(self) -> None:
        """Accept any reading until the noise has been measured."""
        self._records["following"]["allowed"] = inf

    def add(self, state: State) -> None:
        """Process an exchange of an arm at rest."""
        if self._measured.add(state):
            self._allow(self._measured.measured()[1])

    def end(self) -> list[Noisy]:
        """End the measurement; return the joints that are noisier than usual."""
        noise, self.noise = self._measured.measured()
        self._allow(self.noise)
        return [
            Noisy(index, self._how_noisy(index, noise[index]), _refused(joint, noise[index]))
            for index, joint in enumerate(self._joints)
            if self._records[index]["is_followed"]
            and self.noise[index] > following.usual_sigma(joint, self._planned[index])
        ]

    def _allow(self, noise: Sequence[float]) -> None:
        for record, joint, planned, sigma in zip(self._records, self._joints, self._planned, noise, strict=True):
            following.allow_noise(record["following"], record["goals"], joint, planned, self._share, sigma)

    def _how_noisy(self, index: int, noise: float) -> str:
        seen = following.seen_above(self._records[index]["following"], self._interval)
        unit = self._joints[index].drive_mode.goal_unit
        return (
            f"its current reading is noisy: {noise:.2g} {unit} RMS at a constant goal; lost torque cannot be "
            f"detected within 0.1 s at goals below {seen:.2g} {unit}"
        )


def _refused(joint: JointConfig, noise: float) -> str:
    name, limit = joint.goal_limit_name, joint.goal_limit
    if noise <= MOST_NOISE * limit:
        return ""
    return (
        f"At most {MOST_NOISE * limit:.2g} {joint.drive_mode.goal_unit} RMS is accepted, which is "
        f"{100 * MOST_NOISE:.0f} % of {name} ({limit:g}). Check its supply and its cable, or raise {name} if the joint "
        "tolerates more; replace the servo if this happens again."
    )
