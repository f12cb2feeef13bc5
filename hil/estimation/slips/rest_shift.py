"""A joint whose rest angle changed during the run: its horn or encoder may have slipped.

A horn that slips smoothly leaves no jump in the readings. The only trace is that the arm then hangs at a different
angle.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.drivers.servo_prior import servo_prior
from hil.estimator.arrays import Array
from hil.plan.plan import rest_window
from hil.results.result import SettledResult
from hil.runs.recording import Phase

LEAST_RAD = 0.1
"""Smallest shift that is reported [rad]."""

_FRICTION_TIMES = 2.0
"""Friction that can hold a joint away from its hanging position, relative to its servo's typical breakaway friction."""

_STILL_RAD = 0.02
"""Range of positions within which an arm counts as resting [rad]."""


def rest_shift_warnings(config: Config, samples: NDArray[np.void], result: SettledResult) -> list[str]:
    """Return one sentence for each joint whose rest angle changed by more than friction can usually explain.

    Nothing is reported if the verdict is "yes", or if the arm is horizontal or held by a stabiliser.
    """
    trusted = result.verdict is not None and result.verdict.trust == "yes"
    if trusted or config.arm.gravity == 0.0 or config.stabiliser is not None or config.is_chain:
        return []
    before = _resting(config, samples, Phase.REST)
    after = _resting(config, samples, Phase.COMING_TO_REST)
    if before is None or after is None:
        return []
    change = np.abs(_gravity(result, after) - _gravity(result, before))
    found = []
    for joint, more, shift in zip(config.joints, change.tolist(), (after - before).tolist(), strict=True):
        friction = servo_prior(joint.joint.servo)
        held = _FRICTION_TIMES * friction.coulomb.median * (1.0 + friction.stribeck_rise.median)
        if abs(shift) > LEAST_RAD and more > held:
            found.append(
                f"{joint.name} came to rest {shift:+.2f} rad away from where it had rested before the run. The gravity "
                f"torques at the two angles differ by {more:.2g} N m. Unless friction holds it there, either its horn "
                "slipped on the shaft or its encoder moved: tighten the screws, set zero_ticks again, and record again."
            )
    return found


def _gravity(result: SettledResult, pose: Array) -> Array:
    """Torque of gravity at a pose (joints,) [N m]."""
    weight = [result.parameters[f"gravity_{number}"].value for number in range(1, len(pose) + 1)]
    each = weight * np.cos(np.cumsum(pose))
    return np.asarray(np.cumsum(each[::-1])[::-1])  # each joint carries the links beyond it


def _resting(config: Config, samples: NDArray[np.void], phase: Phase) -> Array | None:
    """Median of the last positions of a phase (joints,) [rad]; None if a joint has no positions or is still moving."""
    rows = samples[samples["phase"] == phase][-rest_window(config.experiment.rate) :]
    position = rows["position"]
    if not len(rows) or not np.isfinite(position).any(axis=0).all():
        return None
    if (np.nanmax(position, axis=0) - np.nanmin(position, axis=0) > _STILL_RAD).any():
        return None
    return np.asarray(np.nanmedian(position, axis=0), dtype=np.float64)
