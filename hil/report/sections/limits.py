"""How much of each limit the run used."""

import numpy as np
from numpy.typing import NDArray

from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number, percent


def limits(data: RunData) -> Section:
    """Always there."""
    rows = []
    for index, joint in enumerate(data.config.joints):
        position, velocity = data.samples["position"][:, index], data.samples["velocity"][:, index]
        low, high = joint.position_limit
        used = f"{number(np.nanmin(position), 3)} to {number(np.nanmax(position), 3)}"
        middle, half = (low + high) / 2, (high - low) / 2
        share = float(np.nanmax(np.abs(position - middle))) / half
        rows.append((f"{joint.name}: position [rad]", used, f"{number(low, 3)} to {number(high, 3)}", percent(share)))
        for name, values, limit in (
            ("velocity [rad/s]", velocity, joint.velocity_limit),
            ("current, commanded [A]", data.samples["goal_current"][:, index], joint.current_limit),
            ("current, measured [A]", data.samples["current"][:, index], joint.current_limit),
        ):
            most = _most(values)
            rows.append((f"{joint.name}: {name}", number(most, 3), number(limit, 3), percent(most / limit)))
    table = Table(("joint and quantity", "most used", "limit", "share"), tuple(rows))
    words = (
        "What the arm did in the whole run, ramps included, against the limits of its TOML file. Of a position range, "
        "100 % is one of its ends.",
    )
    return Section("limits", "Limits used", words, (table,))


def _most(values: NDArray[np.float64]) -> float:
    return float(np.nanmax(np.abs(values)))
