"""Pilot, then full: start small, learn from the measured motion, dry-run again, and raise the torque to the limits.

belief   arms that could be the real one, moved towards what each run shows
gains    a stabiliser for arms that have no stable rest
steps    one run on the way: what was foreseen, what was seen
search   from the first careful run to one at the limits
full     the run at the limits and its estimate

Of an arm in space: chain_belief, chain_paths and chain_search.
"""

from hil.pilot.full import identify_in_steps
from hil.pilot.steps import Step

__all__ = ["Step", "identify_in_steps"]
