"""Section on the timing of the stream."""

import numpy as np

from hil.estimator.arrays import Array
from hil.report.chart import BLUE, GREEN, Chart, Series
from hil.report.run_data import RunData
from hil.report.section import Picture, Section, Table
from hil.report.words import number
from hil.results.parts import Quantiles

_BINS = 60


def timing(data: RunData) -> Section:
    samples = data.samples
    deadline: Array = samples["deadline"]
    written: Array = samples["time_before_write"]
    read: Array = samples["time_after_read"]
    sent = read > written
    lateness = 1e6 * (written - deadline)[sent]
    round_trip = 1e6 * (read - written)[sent]
    kept = data.result.timing
    rows = [
        ("requested rate", f"{data.config.experiment.rate:g} Hz"),
        ("rate held", f"{kept.rate_held:g} Hz"),
        ("ticks missed", f"{kept.missed_ticks} of {kept.samples}"),
        ("replies lost", f"{kept.lost_replies}"),
        ("lateness p50, p99, max", _quantiles(kept.lateness_us)),
        ("round trip p50, p99, max", _quantiles(kept.round_trip_us)),
        ("estimation took", f"{kept.estimation_seconds:.2f} s"),
    ]
    virtual = ("On the fake bus, times are virtual: they describe the simulated wire and adapter, not this computer.",)
    return Section(
        "timing",
        "Timing",
        virtual if data.config.is_fake else (),
        (Table(("", ""), tuple(rows)),),
        tuple(
            _histogram(name, title, values, colour)
            for name, title, values, colour in (
                ("lateness", "From the deadline to the write", lateness, BLUE),
                ("round_trip", "From the write to the last reply", round_trip, GREEN),
            )
            if np.ptp(values) > 0.0  # in virtual time, no write is late
        ),
    )


def _quantiles(values: Quantiles) -> str:
    return ", ".join(number(value, 4) for value in (values.p50, values.p99, values.max)) + " µs"


def _histogram(name: str, title: str, values: Array, colour: str) -> Picture:
    # Without the largest 0.1 %: a single stall would compress all other values into one bar.
    most = float(np.quantile(values, 0.999))
    low = float(values.min())
    high = most if most > low else low + 1.0
    counts, edges = np.histogram(values[values <= high], bins=_BINS, range=(low, high))
    series = Series("", edges, counts.astype(np.float64), colour, "steps")
    beyond = int((values > high).sum())
    more = f" {beyond} of {len(values)} values lie beyond the plotted range." if beyond else ""
    return Picture(Chart(name, title, "time [µs]", "samples", (series,)), f"{title}.{more}")
