"""Warnings about a recording that can still be used for an estimate; each names the joint and a remedy."""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.estimation.pilot_limit import torque_limit
from hil.estimation.slips.position_jumps import jump_warnings
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.selection.verdict import TorqueLimit
from hil.runs.recording import Phase
from hil.runs.run_folder import RunFacts

LEAST_SWING = 30.0  # encoder steps
LOST = 0.005  # fraction of unusable samples above which a warning is given
LATE = 0.25  # fraction of the interval; a write that is later than this disturbs the motion noticeably
BY_LATENESS = 0.3  # ratio of late to lost samples above which the computer is the likely cause


def warnings_of(config: Config, facts: RunFacts, samples: NDArray[np.void], period: SettledPeriod) -> list[str]:
    """One sentence per warning; those about currents come from `settled_current_findings`."""
    found = [*jump_warnings(config, facts, samples)]
    if facts.monitoring:
        found.append(facts.monitoring)
    for index, joint in enumerate(config.joints):
        swing = float(np.nanmax(period.position[index]) - np.nanmin(period.position[index]))
        steps = swing / facts.position_step[index]
        if steps < LEAST_SWING:
            found.append(
                f"{joint.name} moved by only {steps:.0f} encoder steps, so rounding errors dominate its parameters; "
                f"{_more_motion(torque_limit(config, samples, index))}."
            )
        lost = 1.0 - float(np.mean(period.valid[index]))
        if lost > LOST:
            late = _late_share(config, samples)
            remedy = (
                f"this computer was late for {100 * late:.1f} % of the samples: close other programs, or lower "
                "experiment.rate."
                if late > BY_LATENESS * lost
                else "check the cable, the baud rate and the sampling rate."
            )
            found.append(
                f"{joint.name}: {100 * lost:.1f} % of the samples are missing or far from their neighbours; {remedy}"
            )
    return found


def _more_motion(limit: TorqueLimit | None) -> str:
    if limit is None:
        return "raise its peak_torque"
    if limit.can_be_raised:
        return f"raise {limit.said}"
    return f"reduce the lower edge of experiment.band ({limit.said})"


def _late_share(config: Config, samples: NDArray[np.void]) -> float:
    """Fraction of the periodic samples that this computer wrote late, or skipped because it was running late."""
    played = samples[samples["phase"] == Phase.PERIODIC]
    left_out = played["time_after_read"] <= played["time_before_write"]
    late = played["time_before_write"] - played["deadline"] > LATE / config.experiment.rate
    return float(np.mean(left_out | late)) if len(played) else 0.0
