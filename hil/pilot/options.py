"""Options of the pilot identification of planar arms, in one frozen object."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PilotOptions:
    """Options of the search for the largest safe torque and of the full run."""

    arms: int = 96
    """Number of arms in the belief's ensemble."""
    pilot_shares: tuple[float, ...] = (0.45, 0.6, 0.75, 0.9)
    """Fractions of the limits that successive pilot runs may use; the last value applies to all further ones."""
    pilot_share_known: float = 0.75
    """Fraction of the limits that the first pilot run may use if the belief comes from an earlier result."""
    max_steps: int = 12
    """Maximum number of runs between the last pilot run and the full run."""
    max_pilots: int = 40
    """Maximum number of pilot runs; a joint that does not move reaches its current limit in far fewer."""
    certain_share: float = 0.85
    """Fraction of a limit that a typical arm should reach."""
    certain_share_known: float = 0.68
    """Replaces `certain_share` if the belief comes from an earlier result: another run would hardly reduce its
    uncertainty.
    """

    pilot_period_share: float = 0.5
    """Period of a pilot run, relative to experiment.period."""
    max_pilot_settling: int = 1
    """Maximum number of settling periods in a pilot or intermediate run."""

    first_torque_share: float = 0.02
    """Torque of the first pilot run, relative to the torque that the current limits allow, if no torque is safe over
    the whole range of motion.
    """
    breakaway_raise: float = 1.6
    """Ratio of successive peak torques of a joint that has not moved yet."""
    least_raise: float = 1.03
    """Smallest ratio of a joint's torque to one with which it stood still, for which another run is worthwhile."""
    breakaway_room: float = 0.25
    """A joint that has just broken away is stopped after this fraction of the distance to its position limits."""
    min_breakaway_steps: int = 60
    """A joint that has just broken away moves at least this far before it is stopped [encoder steps]."""

    at_limit: float = 0.99
    """Fraction of a torque limit above which the limit counts as reached."""
    torque_after_limit: float = 0.85
    """Cap on the torque of later runs, relative to the torque at which a limit was exceeded."""
    torque_after_unsettled: float = 0.85
    """Cap on the torque after a run that never settled, relative to the torque of that run."""
    torque_over_friction: float = 1.8
    """After a run that never settled, a joint's torque is not lowered if it is at most this multiple of its Coulomb
    friction.
    """
    worthwhile_raise: float = 1.15
    """Minimum ratio of the new torque to that of the last run for which another run is worthwhile, if little of the
    range is unused (see `fair_share`).
    """
    worthwhile_raise_far: float = 1.03
    """Replaces `worthwhile_raise` if much of the range is unused."""
    fair_share: float = 0.7
    """If each joint of a typical arm reaches more than this fraction of a limit, little of the range is considered
    unused.
    """

    wide_range: float = 0.74
    """Other waves are tried if a joint uses less than this fraction of its position range."""
    other_waves: int = 7
    """Maximum number of other waves to try; they differ in the sign of each joint and in the direction of time."""

    falling_raise: float = 1.35
    """Maximum ratio of the torques in successive runs, for an arm that falls over when it is stopped."""
    falling_breakaway_raise: float = 1.2
    """Replaces `breakaway_raise` for an arm that falls over when it is stopped."""
    falling_share: float = 0.85
    """Fraction of the limits that runs may use on an arm that falls over when it is stopped."""
    min_falling_torque: float = 0.05
    """Torque always allowed for an arm that falls over when it is stopped, relative to the torque at the current limit.
    """
    start_inside: float = 0.95
    """An arm that a stopped run left beyond its position limits is assumed to start within this fraction of its range,
    measured from the middle.
    """

    max_full_runs: int = 6
    """Maximum number of full runs if one exceeds a limit or does not settle."""
    max_unlike_runs: int = 3
    """Maximum number of full runs that may end because one period differed from the one before."""
    band_raise: float = 3.0
    """Factor by which the lower limit of experiment.band is raised if friction holds a joint during a full run."""
    max_low: float = 0.35
    """Highest lower limit of experiment.band for a repeated full run, as a fraction of the upper limit."""
    max_settle_within: float = 0.1
    """Largest experiment.settle_within for a repeated full run."""
