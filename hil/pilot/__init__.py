"""Identification in steps: start small, learn from the motion, and raise the torque to the limits.

belief   arms that could be the real one, updated with the motion of each run
gains    a stabiliser for arms without a stable rest pose
steps    one run: predicted and measured peaks
search   from the first careful run to a run at the limits
rehearsal  the first run and the largest safe torque, simulated for `hil dry-run`
full     the run at the limits and its estimate

For spatial arms: chain_belief, chain_paths, chain_shares and chain_search.
"""

from hil.pilot.full import identify_in_steps
from hil.pilot.steps import Step

__all__ = ["Step", "identify_in_steps"]
