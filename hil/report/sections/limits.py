"""Section on how close the run came to each limit."""

import numpy as np
from numpy.typing import NDArray

from hil.report.run_data import RunData
from hil.report.section import Section, Table
from hil.report.words import number, percent


def limits(data: RunData) -> Section:
    rows: list[tuple[str, ...]] = []
    for index, joint in enumerate(data.config.joints):
        position, velocity = data.samples["position"][:, index], data.samples["velocity"][:, index]
        low, high = joint.position_limit
        used = f"{number(np.nanmin(position), 3)} to {number(np.nanmax(position), 3)}"
        middle, half = (low + high) / 2, (high - low) / 2
        share = float(np.nanmax(np.abs(position - middle))) / half
        rows.append((f"{joint.name}: position [rad]", used, f"{number(low, 3)} to {number(high, 3)}", percent(share)))
        unit = data.model.joints[index].goal_unit
        used_most = [
            ("velocity [rad/s]", velocity, joint.velocity_limit),
            (f"goal [{unit}]", data.samples["goal_current"][:, index], joint.goal_limit),
        ]
        if unit == "A":
            used_most.append(("current, measured [A]", data.samples["current"][:, index], joint.goal_limit))
        for name, values, limit in used_most:
            most = _most(values)
            rows.append((f"{joint.name}: {name}", number(most, 3), number(limit, 3), percent(most / limit)))
        rows += _supply(data.samples, index, joint.name)
    table = Table(("joint and quantity", "most used", "limit", "share"), tuple(rows))
    words = (
        "Extremes over the whole run, ramps included, compared with the limits in the TOML file. For a position "
        "range, 100 % is reached at either end.",
    )
    return Section("limits", "Limits used", words, (table,))


def _supply(samples: NDArray[np.void], index: int, name: str) -> list[tuple[str, ...]]:
    """Temperature and supply voltage, if read during the run; their limits are stored in the servo."""
    temperature, voltage = samples["temperature"][:, index], samples["supply_voltage"][:, index]
    rows: list[tuple[str, ...]] = []
    if np.isfinite(temperature).any():
        rows.append((f"{name}: temperature [°C]", number(np.nanmax(temperature), 3), "the servo's", ""))
    if np.isfinite(voltage).any():
        used = f"{number(np.nanmin(voltage), 3)} to {number(np.nanmax(voltage), 3)}"
        rows.append((f"{name}: supply [V]", used, "the servo's", ""))
    return rows


def _most(values: NDArray[np.float64]) -> float:
    return float(np.nanmax(np.abs(values)))
