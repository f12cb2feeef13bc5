"""Plot the simulated motions over time against the position limits, as PNG or SVG."""

from pathlib import Path
from typing import Any

import numpy as np

from hil.config.schema import Config
from hil.drawing import new_figure
from hil.dry_run.prediction import Prediction
from hil.errors import RunFolderError


def draw(config: Config, prediction: Prediction, path: Path) -> None:
    """Save the plot to `path`. Raises MissingExtra if matplotlib is not installed, RunFolderError if `path` cannot be
    written.
    """
    figure = plot(config, prediction)
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise RunFolderError(f"{path} cannot be written: {error}.") from error


def plot(config: Config, prediction: Prediction) -> Any:
    """Draw the plot as a matplotlib figure. Raises MissingExtra."""
    joints = len(config.joints)
    figure = new_figure(9, 2.6 * joints)
    axes = figure.subplots(joints, 1, sharex=True, squeeze=False)[:, 0]
    time = np.arange(prediction.shown.shape[2]) / prediction.rate
    every = max(1, time.size // 4000)
    for index, (axis, joint) in enumerate(zip(axes, config.joints, strict=True)):
        for arm in prediction.shown[:, index]:
            axis.plot(time[::every], arm[::every], color="tab:blue", linewidth=0.5, alpha=0.25)
        for limit in joint.position_limit:
            axis.axhline(limit, color="tab:red", linewidth=1.2)
        for bound in prediction.quantile[:2, index]:
            axis.axhline(bound, color="tab:orange", linewidth=1, linestyle="--")
        axis.set_ylabel(f"{joint.name} [rad]")
    axes[0].set_title(
        "Simulated arms, limits (red), and bounds that 99 % of the arms stay within (dashed)", fontsize=10, loc="left"
    )
    axes[-1].set_xlabel("time [s]")
    return figure
