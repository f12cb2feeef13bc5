"""Units as written in column headers, and their values in SI."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hil.config.csv_columns import CURRENT_UNITS, POSITION_UNITS, PWM_UNITS, TIME_UNITS, TORQUE_UNITS, VOLTAGE_UNITS

UNITS = {
    "time": TIME_UNITS,
    "position": POSITION_UNITS,
    "torque": TORQUE_UNITS,
    "current": CURRENT_UNITS,
    "voltage": VOLTAGE_UNITS,
    "pwm": PWM_UNITS,
}
"""SI value of each unit, by kind of quantity (the size of an encoder tick is given by [columns])."""

_SPELLINGS = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millisecond milliseconds",
    "us": "us µs μs usec microsecond microseconds",
    "ns": "ns nsec nanosecond nanoseconds",
    "rad": "rad rads radian radians",
    "mrad": "mrad",
    "deg": "deg degs degree degrees °",
    "turns": "turn turns rev revs revolution revolutions",
    "ticks": "tick ticks count counts step steps lsb pulse pulses",
    "N m": "nm n·m n.m n*m newtonmetre newtonmeter newtonmetres newtonmeters",
    "mN m": "mnm mn·m mn.m mn*m",
    "N cm": "ncm n·cm n.cm n*cm",
    "kgf cm": "kgcm kg·cm kg.cm kg*cm kgfcm kgf·cm kgf.cm kgf*cm",
    "ozf in": "ozin oz·in oz.in oz*in oz-in ozfin ozf·in ozf.in ozf*in ozf-in",
    "lbf in": "lbin lb·in lb.in lb*in lb-in lbfin lbf·in lbf.in lbf*in lbf-in inlb in·lb in.lb in-lb",
    "A": "a amp amps ampere amperes",
    "mA": "ma milliamp milliamps milliampere",
    "V": "v volt volts",
    "mV": "mv millivolt millivolts",
    "%": "% pct percent",
    "1": "1 - duty fraction",
}
_KNOWN = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings.split()}
_BRACKETS = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$")
_SLASH = re.compile(r"^(.*?)\s*/\s*(\S+)$")
# Only units that cannot be the name of a joint: `q_a` is not a current.
_NAMES_OF_JOINTS = {"step", "pulse", "turn", "second", "fraction", "count"}
_AS_SUFFIX = sorted(each for each in _KNOWN if len(each) > 1 and each.isalnum() and each not in _NAMES_OF_JOINTS)
_SUFFIX = re.compile(rf"^(.+)_({'|'.join(_AS_SUFFIX)})$", re.IGNORECASE)


def unit_of(text: str) -> str | None:
    """The unit denoted by `text`; None if it is unknown."""
    return _KNOWN.get(text.strip().lower().replace(" ", ""))


def split_head(head: str) -> tuple[str, str | None]:
    """Split a column header into name and unit, as written; the unit is None if there is none."""
    bracketed = _BRACKETS.match(head)
    if bracketed and bracketed[1]:
        return bracketed[1].strip(), bracketed[2].strip()
    for pattern in (_SLASH, _SUFFIX):
        found = pattern.match(head)
        if found and unit_of(found[2]) is not None:
            return found[1].strip(), found[2]
    return head.strip(), None


def wrapped(values: NDArray[np.float64], sizes: Sequence[int]) -> int | None:
    """The size [bits] of a signed register that was read as an unsigned number; None if nothing indicates this.

    After such a misreading, negative values appear in the uppermost quarter of the range, and the two middle quarters
    are empty.
    """
    known = values[np.isfinite(values)]
    if not known.size or known.min() < 0.0 or (known != np.round(known)).any():
        return None
    for bits in sizes:
        quarter = 2.0 ** (bits - 2)
        high = known >= 3.0 * quarter
        if known.max() < 4.0 * quarter and high.any() and (high | (known < quarter)).all():
            return bits
    return None
