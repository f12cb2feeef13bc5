"""Timing of the stream, computed from the samples' timestamps."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.estimator.arrays import Array
from hil.results.parts import Quantiles, StreamTiming

SERVO_CLOCK_WRAP_S = 32.768
"""Period after which the servos' Realtime Tick wraps [s]: it counts milliseconds from 0 to 32767."""

LOST_SHARE = 0.005
"""The summary of a run names a joint if more than this fraction of its samples were lost."""

_FEWEST_READINGS = 5
_EDGES_US = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1e3, 2e3, 5e3, 1e4, 1e5, 1e6)


def timing(samples: NDArray[np.void], rate: float) -> StreamTiming:
    """Achieved rate, lateness, round trips, missed ticks, lost replies and clock drifts of a recording."""
    sent = _sent(samples)
    lateness_us = _lateness_us(sent)
    round_trip_us = 1e6 * _round_trip(sent)
    span = float(samples["deadline"][-1] - samples["deadline"][0]) + 1 / rate
    tenth = max(1, len(sent) // 10)
    return StreamTiming(
        samples=len(samples),
        seconds=round(span, 6),
        rate_held=round(len(sent) / span, 3),
        lateness_us=_quantiles(lateness_us),
        round_trip_us=_quantiles(round_trip_us),
        missed_ticks=int(len(samples) - len(sent)),
        lost_replies=int(sent["missing"].sum()),
        drift_us=round(float(np.median(lateness_us[-tenth:]) - np.median(lateness_us[:tenth])), 1),
        servo_clock_ppm=tuple(_servo_clock_ppm(sent)),
    )


def lateness_histogram(samples: NDArray[np.void]) -> dict[str, list[float]]:
    """Histogram of lateness: `counts[i]` is the number of writes between `edges_us[i]` and `edges_us[i + 1]`. The last
    bin has no upper edge.
    """
    counts, _ = np.histogram(_lateness_us(_sent(samples)), [*_EDGES_US, np.inf])
    return {"edges_us": list(_EDGES_US), "counts": counts.tolist()}


def lost_samples(samples: NDArray[np.void], names: Sequence[str]) -> str:
    """One sentence about the fraction of samples without a reply, by joint; "" if none exceeds LOST_SHARE."""
    if not len(samples):
        return ""
    sent = _round_trip(samples) > 0.0
    shares = np.mean(samples["missing"] | ~sent[:, None], axis=0)
    if float(shares.max()) <= LOST_SHARE:
        return ""
    left_out = float(np.mean(~sent))
    listed = ", ".join(f"{100 * share:.1f} % of {name}" for name, share in zip(names, shares.tolist(), strict=True))
    late = (
        f" Of all samples, {100 * left_out:.1f} % were not taken because this computer was late: close other "
        "programs, or lower experiment.rate."
        if left_out > LOST_SHARE
        else ""
    )
    cable = (
        ""
        if left_out > 0.5 * shares.max()
        else " Check the cable, its connectors and the baud rate, and whether other programs keep this computer busy, "
        "since replies that arrive too late are lost as well."
    )
    return f"Samples lost: {listed}.{late}{cable}"


def _sent(samples: NDArray[np.void]) -> NDArray[np.void]:
    sent: NDArray[np.void] = samples[_round_trip(samples) > 0.0]
    return sent


def _round_trip(samples: NDArray[np.void]) -> Array:
    """Time from write to reply [s], with the shape of `samples`; 0 where nothing was written."""
    before: Array = samples["time_before_write"]
    after: Array = samples["time_after_read"]
    return after - before


def _lateness_us(sent: NDArray[np.void]) -> Array:
    # A virtual clock does not advance during computation, so rounding errors may have either sign.
    written: Array = sent["time_before_write"]
    deadline: Array = sent["deadline"]
    return np.maximum(0.0, 1e6 * (written - deadline))


def _quantiles(values: Array) -> Quantiles:
    numbers = (*np.quantile(values, [0.5, 0.99, 0.999]), values.max())
    return Quantiles(*(round(float(value), 1) for value in numbers))


def _servo_clock_ppm(sent: NDArray[np.void]) -> list[float | None]:
    drifts: list[float | None] = []
    for joint in range(sent["servo_clock"].shape[1]):
        read = np.isfinite(sent["servo_clock"][:, joint])
        computer, servo = sent["time_before_write"][read], sent["servo_clock"][read, joint].astype(np.float64)
        if len(servo) < _FEWEST_READINGS:
            drifts.append(None)
            continue
        ahead = np.unwrap(servo - np.mod(computer, SERVO_CLOCK_WRAP_S), period=SERVO_CLOCK_WRAP_S)
        slope = np.polyfit(computer - computer[0], ahead, 1)[0]
        drifts.append(round(float(slope) * 1e6, 1) + 0.0)
    return drifts
