"""Section on correlated parameters, which the data can barely distinguish."""

import numpy as np

from hil.estimator.arrays import Array
from hil.report.chart import Matrix
from hil.report.run_data import RunData
from hil.report.section import Picture, Section
from hil.results.result import Result

STRONG = 0.9


def correlation(data: RunData) -> Section | None:
    """Return the section; None if the result has no parameters."""
    return correlation_of(data.result)


def correlation_of(result: Result) -> Section | None:
    """Return the section on correlations for any kind of result; None if it has no parameters."""
    names = result.covariance.names
    if not names:
        return None
    values = correlations(result.covariance.array())
    strong = sorted(
        (
            (float(values[row, column]), names[row], names[column])
            for row in range(len(names))
            for column in range(row)
            if abs(values[row, column]) >= STRONG
        ),
        key=lambda pair: -abs(pair[0]),
    )
    pairs = "; ".join(f"{first} and {second} ({value:+.2f})" for value, first, second in strong[:5])
    said = (
        f"Strongly correlated: {pairs}. Only their combination is well determined; a different motion would separate "
        "them."
        if strong
        else f"No two parameters are correlated beyond {STRONG:g}: the motion separates all of them."
    )
    figure = Matrix("correlation", "Parameter correlations", names, values)
    caption = (
        "Red: positive correlation, blue: negative. Strongly correlated parameters can change together with little "
        "effect on the fit."
    )
    return Section("correlation", "Identifiability", (said,), pictures=(Picture(figure, caption),))


def correlations(covariance: Array) -> Array:
    """Correlation matrix; NaN where a variance is zero or not finite."""
    std = np.sqrt(np.diag(covariance))
    std = np.where(np.isfinite(std) & (std > 0), std, np.nan)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.clip(covariance / np.outer(std, std), -1.0, 1.0))
