"""Chooses the number of exchanges per sample and per status read; both are limited by the time on the wire."""

import math
from collections.abc import Sequence

from hil.drivers.control_table import ControlTable
from hil.drivers.exchange import HOST_S
from hil.drivers.joint import Joint
from hil.drivers.port import Port
from hil.drivers.state import Spans, status_span
from hil.drivers.sync_read import one_each

CHECK_S = 0.01
"""Longest time between two exchanges [s], if the bus allows it: faults must not go unnoticed at low sample rates."""

STATUS_S = 0.035
"""Time between two status reads [s]."""

_SHARE, _MOST_SHARE = 0.6, 0.9
"""Fraction of a control cycle that a status read may take on the wire. The second value applies if a servo reports its
supply current, which reveals a loss of torque only after some time.
"""


def exchange_interval(sample: float) -> float:
    """Return the time between two exchanges on a fast bus [s]: `sample` [s], divided so that it is at most CHECK_S."""
    return sample / max(1, math.ceil(sample / CHECK_S - 1e-6))


def cadence(
    sample: float, port: Port, drives: Sequence[Joint], tables: Sequence[ControlTable], return_delay: float
) -> tuple[int, Spans | None, int]:
    """Return the number of exchanges per sample, the status registers, and the number of exchanges per status read.

    The registers are None if there is no time to read the status. sample: time between two samples [s], 0 if unknown.
    drives: one entry per servo. return_delay: the servos' longest Return Delay Time [s].
    """
    if not sample:
        return 1, None, 0
    modes, count = [drive.mode for drive in drives], len(drives)
    # If the current is not sensed in the motor, a loss of torque shows first in Torque Enable; reading that register is
    # worth a late sample.
    share = _MOST_SHARE if any(drive.servo.senses_supply for drive in drives) else _SHARE
    goals = 14 * len(set(modes)) + 3 * count
    fitting: list[tuple[float, int, Spans]] = []
    for whole in (True, False):
        span = status_span(modes, tables, whole=whole)
        taken = port.wire_time(goals + 14 + count + count * (11 + one_each(span, count)[0].size))
        taken += return_delay * count
        least = max(exchange_interval(sample), taken / share + HOST_S)
        every = max(1, math.floor(sample / least + 1e-6))
        if taken < share * sample / every:
            fitting.append((sample / every, every, span))
    if not fitting:
        return 1, None, 0
    # Frequent exchanges come first; if both spans allow them, the one that includes Torque Enable is read.
    interval, every, span = min(fitting, key=lambda each: max(each[0], CHECK_S * (1 + 1e-6)))
    return every, span, max(1, round(STATUS_S / interval))
