"""How the stream kept time, from what every sample says of itself."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def timing(samples: NDArray[np.void], rate: float) -> dict[str, Any]:
    """Rate held, lateness of the writes, round trips, missed ticks and lost replies of a recording."""
    sent = samples[samples["time_after_read"] > samples["time_before_write"]]
    lateness_us = 1e6 * (sent["time_before_write"] - sent["deadline"])
    round_trip_us = 1e6 * (sent["time_after_read"] - sent["time_before_write"])
    span = float(samples["deadline"][-1] - samples["deadline"][0]) + 1 / rate
    return {
        "samples": len(samples),
        "seconds": round(span, 6),
        "rate_held": round(len(sent) / span, 3),
        "lateness_us": _quantiles(lateness_us),
        "round_trip_us": _quantiles(round_trip_us),
        "missed_ticks": int(len(samples) - len(sent)),
        "lost_replies": int(sent["missing"].sum()),
    }


def _quantiles(values: NDArray[np.float64]) -> dict[str, float]:
    p50, p99 = np.quantile(values, [0.5, 0.99])
    return {"p50": round(float(p50), 1), "p99": round(float(p99), 1), "max": round(float(values.max()), 1)}
