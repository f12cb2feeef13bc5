"""`hil dry-run` for a spatial arm: simulate the path of the first run on an ensemble of possible arms."""

from hil.clearance.space import Space
from hil.config.schema import Config
from hil.dry_run.chain_prediction import Tell, predict_chain
from hil.dry_run.chain_prior import prior_arms
from hil.dry_run.chain_stop import foreseen_stops
from hil.dry_run.chain_summary import ChainDryRun, unsafe
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config
from hil.pilot.chain_search import PILOT_SHARES, SEARCH_ARMS, step_config
from hil.plan.chain_model import known_chain
from hil.plan.chain_plan import check_rest_pose, make_chain_plan
from hil.plan.plan import Plan
from hil.setup.idle_bus import quiet_stream

SHOWN = 30


def rehearse(config: Config, arms: int, servos: bool = False, tell: Tell | None = None) -> ChainDryRun:
    """Simulate the configured path, or the pilot's first step. Raises ConfigError, NoSafeTorque; with `servos`,
    DriverError."""
    check_rest_pose(config)
    said = quiet_stream(config) if servos else ()
    played, plan, share = _what_is_played(config)
    drawn = prior_arms(played, known_chain(played), arms)
    foreseen = predict_chain(played, plan, drawn, tell, SHOWN)
    space = Space.of(played)
    stops = foreseen_stops(played, plan, drawn)
    return ChainDryRun(played, "prior", arms, share, foreseen, stops, space.shapes.guessed, space.as_built, said)


def _what_is_played(config: Config) -> tuple[Config, Plan, float]:
    if not config.experiment.pilot:
        return config, make_chain_plan(config), 1.0
    config = chain_config(config)
    belief = ChainBelief.prior(config)
    paths = Paths.of(config, belief.torque)
    held = step_config(belief.with_stabiliser(config))
    for share in PILOT_SHARES:
        plan = paths.plan(held, belief.torque, share)
        if not unsafe(held, predict_chain(held, plan, belief.arms.first(SEARCH_ARMS))):
            break
    return held, plan, share
