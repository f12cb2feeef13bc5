"""Warnings about a recording that do not prevent the estimation, each with the joint and a remedy."""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimation.pilot_limit import torque_limit
from hil.estimation.slips.position_jumps import jump_warnings
from hil.estimator.data.settled_period import SettledPeriod
from hil.runs.recording import Phase
from hil.runs.run_folder import RunFacts

LARGE = 0.5  # of the largest goal; smaller goals say little about clipping
SHORT = 0.85  # ratio of measured to commanded current below which the current was clipped
OFTEN = 0.05  # fraction of the samples with large goals
LEAST_SWING = 30.0  # encoder steps
LOST = 0.005  # fraction of the samples
LATE = 0.25  # of the interval: a write that is later disturbs the motion noticeably
BY_LATENESS = 0.3  # of the lost samples: with at least this share of late ones, the computer is the likely cause


def warnings_of(config: Config, facts: RunFacts, samples: NDArray[np.void], period: SettledPeriod) -> list[str]:
    """One sentence per warning."""
    found = clipping_warnings(config, samples[samples["phase"] == Phase.PERIODIC])
    found += jump_warnings(config, facts, samples)
    for index, joint in enumerate(config.joints):
        swing = float(np.nanmax(period.position[index]) - np.nanmin(period.position[index]))
        steps = swing / facts.position_step[index]
        if steps < LEAST_SWING:
            found.append(
                f"{joint.name} moved by only {steps:.0f} encoder steps: rounding dominates its parameters; "
                f"raise {torque_limit(config, samples, index) or 'its peak_torque'}."
            )
        lost = 1.0 - float(np.mean(period.valid[index]))
        if lost > LOST:
            late = _late_share(config, samples)
            remedy = (
                f"this computer was late for {100 * late:.1f} % of the samples: close other programs, or lower "
                "experiment.rate."
                if late > BY_LATENESS * lost
                else "check cable, baud rate and sampling rate."
            )
            found.append(
                f"{joint.name}: {100 * lost:.1f} % of the samples are missing or far from their neighbours; {remedy}"
            )
    return found


def _late_share(config: Config, samples: NDArray[np.void]) -> float:
    """Fraction of the periodic samples that this computer wrote late, or left out because it was too late."""
    played = samples[samples["phase"] == Phase.PERIODIC]
    left_out = played["time_after_read"] <= played["time_before_write"]
    late = played["time_before_write"] - played["deadline"] > LATE / config.experiment.rate
    return float(np.mean(left_out | late)) if len(played) else 0.0


def clipping_warnings(config: Config, samples: NDArray[np.void]) -> list[str]:
    """Warn about joints that received less current than commanded."""
    return [
        said
        for index, joint in enumerate(config.joints)
        if joint.drive_mode is Mode.CURRENT and not joint.joint.servo.senses_supply
        for said in _clipped(
            joint.name,
            samples["goal_current"][:, index],
            samples["current"][:, index],
            "current_limit" if config.experiment.pilot else "peak_torque",
        )
    ]


def _clipped(name: str, goal: NDArray[np.float64], measured: NDArray[np.float64], lower: str) -> list[str]:
    """Detect a motor that receives less current than commanded, from a sagging supply or its own current limit."""
    # A sample's current is the response to the goal of the sample before it, and a lagging current loop is not clipping
    # either: the smaller of two successive goals is what the motor has had time to follow.
    least = np.minimum(np.abs(goal[1:]), np.abs(goal[:-1])) * (goal[1:] * goal[:-1] > 0.0)
    measured = measured[1:]
    large = (least > LARGE * np.abs(goal).max()) & np.isfinite(measured)
    if not large.any():
        return []
    short = np.abs(measured[large]) < SHORT * least[large]
    part = float(np.mean(short))
    if part <= OFTEN:
        return []
    return [
        f"{name} received less than {100 * SHORT:.0f} % of the commanded current in {100 * part:.0f} % of the "
        "high-torque samples: the servo's own current limit or, at speed, the supply voltage clips it; lower "
        f"{lower} or raise the supply voltage."
    ]
