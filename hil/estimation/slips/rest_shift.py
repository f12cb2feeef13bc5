"""A joint that came to rest elsewhere than where it had rested before the run: its horn or encoder may have slipped.

A horn that slips smoothly leaves no jump in the readings. What remains is that the arm hangs at another angle.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_prior import servo_prior
from hil.results.result import SettledResult
from hil.runs.recording import Phase

LEAST_RAD = 0.1
"""Smallest shift that is reported [rad]."""

_FRICTION_TIMES = 2.0
"""Multiple of the servo's typical friction, with breakaway, that may hold a joint away from where it would hang."""

_LAST = 20  # samples that are averaged


def rest_shift_warnings(config: Config, samples: NDArray[np.void], result: SettledResult) -> list[str]:
    """One sentence per joint that rests farther from where it had rested than friction usually holds it.

    Nothing is reported of a trusted model, of a flat arm, or of one that a stabiliser held.
    """
    trusted = result.verdict is not None and result.verdict.trust == "yes"
    if trusted or config.arm.gravity == 0.0 or config.stabiliser is not None or config.is_chain:
        return []
    before = _resting(samples, Phase.REST)
    after = _resting(samples, Phase.COMING_TO_REST)
    if before is None or after is None:
        return []
    found = []
    for number, (joint, shift) in enumerate(zip(config.joints, (after - before).tolist(), strict=True), 1):
        weight = abs(result.parameters[f"gravity_{number}"].value)
        friction = servo_prior(joint.joint.servo)
        held = _FRICTION_TIMES * friction.coulomb.median * (1.0 + friction.stribeck_rise.median)
        if abs(shift) > LEAST_RAD and held < weight * abs(shift):
            found.append(
                f"{joint.name}: it came to rest {shift:+.2f} rad from where it had rested before the run. If friction "
                "does not hold it there, its horn slipped on the shaft, or its encoder moved: tighten the screws, set "
                "zero_ticks again, and record again."
            )
    return found


def _resting(samples: NDArray[np.void], phase: Phase) -> NDArray[np.float64] | None:
    """Median of the last positions of a phase (joints,) [rad]; None if a joint has none."""
    position = samples["position"][samples["phase"] == phase][-_LAST:]
    if not len(position) or not np.isfinite(position).any(axis=0).all():
        return None
    return np.asarray(np.nanmedian(position, axis=0), dtype=np.float64)
