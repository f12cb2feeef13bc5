"""Summary figures of a study: rates with confidence intervals, and quantiles of every numeric column."""

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

_NORMAL_95 = 1.959964
_MOST_CATEGORIES = 12
_NO_FIGURE = ("status", "message", "where", "task", "seed", "config_sha256", "worker", "recording", "arm_type")
"""Columns that identify a run; no rates or quantiles are computed for them."""

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


@dataclass(frozen=True)
class Rate:
    """A count out of a total, with the 95 % confidence interval of the fraction (Wilson's method)."""

    count: int
    of: int

    @property
    def share(self) -> float:
        return self.count / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the fraction, after E. B. Wilson, Journal of the American Statistical Association
        22 (1927) 209.
        """
        if not self.of:
            return 0.0, 1.0
        z2, n, p = _NORMAL_95**2, self.of, self.share
        middle = (p + z2 / (2 * n)) / (1 + z2 / n)
        half = _NORMAL_95 / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
        return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Spread:
    """Quantiles of one column (hil.study.figures.QUANTILES), over the `of` runs that have a value."""

    name: str
    of: int
    quantiles: tuple[float, ...]


@dataclass(frozen=True)
class Figures:
    """Figures of a complete study.

    done: rate of successful runs. categories: for each text column, the rate of each value. failures: count of each
    message.
    spreads: quantiles of each numeric column.
    """

    done: Rate
    categories: dict[str, dict[str, Rate]]
    failures: dict[str, int]
    spreads: tuple[Spread, ...]


def figures(table: pa.Table) -> Figures:
    """Compute the figures of a dataset's rows (hil.study.dataset.Dataset.table)."""
    runs = table.num_rows
    columns = {name: table.column(name).to_pylist() for name in table.column_names if name != "run"}
    status = columns.get("status", [])
    categories, spreads = {}, []
    for name, values in columns.items():
        known = [value for value in values if value is not None]
        if name in _NO_FIGURE or name.endswith(".message") or not known:
            continue
        if all(isinstance(value, str | bool) for value in known):
            counted = Counter(map(str, known))
            if len(counted) <= _MOST_CATEGORIES:
                categories[name] = {value: Rate(count, len(known)) for value, count in counted.most_common()}
        else:
            finite = np.array([float(value) for value in known if math.isfinite(float(value))])
            if finite.size:
                quantiles = tuple(float(each) for each in np.quantile(finite, QUANTILES))
                spreads.append(Spread(name, int(finite.size), quantiles))
    failed = [message for message, state in zip(columns.get("message", []), status, strict=False) if state != "done"]
    return Figures(
        Rate(sum(state == "done" for state in status), runs),
        categories,
        dict(Counter(_without_numbers(message or "") for message in failed).most_common()),
        tuple(spreads),
    )


def _without_numbers(message: str) -> str:
    """Replace numbers in a message, so that similar failures are counted together."""
    words = message.split()
    return " ".join("…" if any(sign.isdigit() for sign in word) else word for word in words)[:160]
