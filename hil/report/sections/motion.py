"""Animation of the arm during the fitted period with the torque that moved it, then the suggested next commands."""

import numpy as np

from hil.report.chart import GREEN, Chart, Series
from hil.report.run_data import RunData
from hil.report.section import Motion, Picture, Section, Table
from hil.runs.period_file import PlayedPeriod

MOST_FRAMES = 600


def motion(data: RunData) -> Section | None:
    """Present if the run has its settled period; drawn for planar arms only."""
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
    moving = None if data.config.is_chain else _moving(data, period)
    return Section("motion", "The experiment", pictures=pictures, motion=moving)


def next_commands(data: RunData) -> Section:
    """Commands to copy; always present."""
    run = data.run.path
    rows = (
        ("the arm for MuJoCo, or as URDF", f"hil export {run} --format mjcf --format urdf"),
        ("a hundred arms drawn from the error bars", f"hil export {run} --format mjcf --samples 100 --out arms"),
        ("estimate again, after a change of [model] in its config.toml", f"hil estimate {run}"),
        ("what changed since another run", f"hil diff OTHER_RUN {run}"),
        ("other methods on the same recording", f"hil compare {run}"),
    )
    return Section("next", "What next", tables=(Table(("", ""), rows, 2),))


def _moving(data: RunData, period: PlayedPeriod) -> Motion:
    filled = np.where(np.isfinite(period.position), period.position, period.predicted)
    step = max(1, -(-filled.shape[1] // MOST_FRAMES))
    lengths = data.config.arm.link_lengths or (1.0,) * len(filled)
    return Motion(
        step / period.rate,
        tuple(tuple(round(float(angle), 4) for angle in row) for row in filled[:, ::step]),
        tuple(float(length) for length in lengths),
        bool(data.config.arm.gravity),
    )
