"""Limits on the time without replies and on the time without commands [s], both below the servos' watchdog timeout."""

from typing import NamedTuple

from hil.config.schema import Config

WATCHDOG_SHARE = 0.8
"""Upper bound on both limits, relative to the watchdog timeout."""

_FEWEST_MISSING = 2
"""Minimum number of missing replies that counts as a fault: however low the rate, one lost packet is not enough."""

_ROUNDING_S = 1e-6


BRIDGED_S = 0.06
"""How long servos may fail to reply while an arm is being lowered [s]. Torque must be off 100 ms after the last reply;
switching it off takes some time.
"""

BRIDGED_ALONE_S = 0.028
"""How long servos may fail to reply while an arm is being lowered and another servo replies [s]. If the silent servo's
ID has changed, only its Bus Watchdog can stop it, and the watchdog's timeout starts anew with every packet on the bus,
even one for another servo.
"""


class Limit(NamedTuple):
    """A time limit [s], and a text that names its source, such as a setting."""

    seconds: float
    said: str


def missing_limit(config: Config) -> Limit:
    """How long a servo may fail to reply."""
    safety = config.safety
    if safety.max_missing is not None:
        chosen = Limit((safety.max_missing + 1) / config.experiment.rate, f"safety.max_missing = {safety.max_missing}")
    else:
        chosen = Limit(safety.missing_time, f"safety.missing_time = {safety.missing_time:g} s")
    return _bounded(chosen, safety.watchdog)


def bridged_limit(config: Config) -> Limit:
    """How long a servo may fail to reply while a spatial arm is being lowered."""
    return _bounded(Limit(BRIDGED_S, "lowering the arm"), config.safety.watchdog)


def bridged_alone_limit(config: Config) -> Limit:
    """How long a servo may fail to reply while a spatial arm is being lowered and another servo replies."""
    return _bounded(Limit(BRIDGED_ALONE_S, "lowering the arm while other servos answer"), config.safety.watchdog)


def late_limit(config: Config) -> Limit:
    """How long the program may go on missing consecutive deadlines."""
    safety = config.safety
    if safety.max_late is not None:
        chosen = Limit((safety.max_late + 0.5) / config.experiment.rate, f"safety.max_late = {safety.max_late}")
    else:
        chosen = Limit(safety.late_time, f"safety.late_time = {safety.late_time:g} s")
    return _bounded(chosen, safety.watchdog)


def is_missing_too_long(count: int, seconds: float, limit: Limit) -> bool:
    """Whether `count` consecutive missing replies exceed the limit. seconds: time since the last reply [s]."""
    return count >= _FEWEST_MISSING and seconds >= limit.seconds - _ROUNDING_S


def _bounded(chosen: Limit, watchdog: float) -> Limit:
    most = WATCHDOG_SHARE * watchdog
    if chosen.seconds <= most:
        return chosen
    return Limit(most, f"{WATCHDOG_SHARE:g} of safety.watchdog = {watchdog:g} s")
