"""Sections with the arm's animation during the fitted period, the torque that moved it, and suggested next commands."""

import numpy as np
from numpy.typing import NDArray

from hil.report.chart import GREEN, Chart, Series
from hil.report.run_data import RunData
from hil.report.scene import planar_motion, spatial_motion
from hil.report.section import Picture, Section, Table
from hil.runs.period_file import PlayedPeriod

_SHOWN = "The arm in the fitted period, as measured"


def motion(data: RunData) -> Section | None:
    """Return the section; None if the run has no settled period. Raises ConfigError, ArmFileError."""
    if data.fitted is None:
        return None
    period = data.fitted
    time = np.arange(period.torque.shape[1]) / period.rate
    pictures = tuple(
        Picture(
            Chart(
                f"torque_{joint + 1}",
                f"Torque of {name}",
                "time in the period [s]",
                "torque [N m]",
                (Series("commanded", time, period.torque[joint], GREEN),),
            ),
            f"{name}: commanded torque over the fitted period.",
        )
        for joint, name in enumerate(data.names)
    )
    shown = data.config, _filled(period), period.rate
    moving = (
        spatial_motion(*shown, f"{_SHOWN}, with its parts enclosed in capsules.")
        if data.config.is_chain
        else planar_motion(*shown, _SHOWN)
    )
    return Section("motion", "The experiment", pictures=pictures, motion=moving)


def next_commands(data: RunData) -> Section:
    """Return the section with commands to copy."""
    run, length = data.run.path, ""
    if not data.config.is_chain and not data.config.arm.gravity and len(data.config.joints) > 1:
        # If gravity does not act on the arm, the motion reveals nothing about the length of link 1.
        known = data.config.arm.link_lengths
        length = f" --link-length {f'{known[0]:g}' if known else 'METRES'}"
    rows = (
        ("the arm for MuJoCo, or as URDF", f"hil export {run} --format mjcf --format urdf{length}"),
        (
            "a hundred arms drawn from the posterior",
            f"hil export {run} --format mjcf --samples 100 --out arms{length}",
        ),
        ("estimate again after changing [model] in its config.toml", f"hil estimate {run}"),
        ("what changed compared with another run", f"hil diff OTHER_RUN {run}"),
        ("other methods on the same recording", f"hil compare {run}"),
    )
    return Section("next", "What next", tables=(Table(("", ""), rows, 2),))


def _filled(period: PlayedPeriod) -> NDArray[np.float64]:
    """Measured positions; predicted ones where a measurement is missing."""
    return np.where(np.isfinite(period.position), period.position, period.predicted)
