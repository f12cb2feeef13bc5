"""The dry-run page, a single HTML file with the verdict, the predicted peaks and an animation of one simulated arm."""

from datetime import datetime
from pathlib import Path

import numpy as np

from hil.config.schema import Config
from hil.dry_run.chain_summary import ChainDryRun, chain_dry_run_lines
from hil.dry_run.prediction import Prediction, quantities_of
from hil.dry_run.summary import DryRun, dry_run_lines
from hil.report.page import render
from hil.report.scene import planar_motion, spatial_motion
from hil.report.section import Motion, Section, SpatialMotion, Table
from hil.whole_file import write_whole


def write_dry_run_page(config: Config, found: DryRun | ChainDryRun, path: Path) -> None:
    """Write the page. Raises RunFolderError, ConfigError, ArmFileError."""
    shown = found.prediction if isinstance(found, ChainDryRun) else found.shown
    is_safe = found.is_safe(config)
    lines = chain_dry_run_lines(found) if isinstance(found, ChainDryRun) else dry_run_lines(config, shown, found)
    title = "The experiment looks safe" if is_safe else "The experiment is not safe"
    moving = _in_space(found) if isinstance(found, ChainDryRun) else _in_plane(config, shown)
    sections = (
        Section("verdict", title, tone="good" if is_safe else "poor", bullets=tuple(lines)),
        Section("motion", "The motion", motion=moving),
        Section("peaks", "Predicted peaks", tables=(_peaks(config, shown),)),
    )
    page = render(config.path.stem, datetime.now().isoformat(), sections, f"Dry run on {found.arms} simulated arms")
    write_whole(path, page)


def _in_space(found: ChainDryRun) -> SpatialMotion | None:
    """Animation of the simulated arm with the least clearance; None if no motion was kept."""
    motions = found.prediction.shown
    if not len(motions):
        return None
    closest = int(np.argmin(found.foreseen.rooms[: len(motions)]))
    said = (
        f"The simulated arm with the least clearance, out of {len(motions)}. It moves from the rest pose to the path, "
        "follows it twice, and returns."
    )
    ways = found.foreseen.ways
    return spatial_motion(found.config, np.nan_to_num(motions[closest]), found.prediction.rate, said, (ways, ways))


def _in_plane(config: Config, shown: Prediction) -> Motion | None:
    if not len(shown.shown):
        return None
    return planar_motion(config, shown.shown[0], shown.rate, "One of the simulated arms")


def _peaks(config: Config, shown: Prediction) -> Table:
    rows = [
        (
            f"{joint.name}: {name} [{unit}]",
            *(f"{values[row, index]:.3g}" for values in (shown.median, shown.quantile, shown.limits)),
        )
        for index, joint in enumerate(config.joints)
        for row, (name, unit) in enumerate(quantities_of(joint))
    ]
    return Table(("joint and quantity", "median", "99 %", "limit"), tuple(rows))
