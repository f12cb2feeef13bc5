"""`hil dry-run` for a spatial arm: simulate the path of the first run on an ensemble of possible arms."""

from hil.clearance.space import Space
from hil.config.schema import Config
from hil.dry_run.chain_prediction import predict_chain
from hil.dry_run.chain_prior import prior_arms
from hil.dry_run.chain_stop import foreseen_stops
from hil.dry_run.chain_summary import ChainDryRun
from hil.dry_run.resting_stops import resting_stops, said_of_stops
from hil.errors import NoSafeTorque
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.estimator.progress import Tell
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths, chain_config
from hil.pilot.chain_shares import ARMS, PILOT_SHARES, SafeShares, step_config
from hil.plan.chain_model import known_chain
from hil.plan.chain_plan import NoHeadroom, check_rest_pose, make_chain_plan
from hil.plan.plan import Plan
from hil.plan.supply_speed import lowered, within_supply
from hil.setup.idle_bus import quiet_stream

SHOWN = 30


def rehearse(
    config: Config, arms: int, servos: bool = False, tell: Tell | None = None, designing: Tell | None = None
) -> ChainDryRun:
    """Simulate the configured path, or the pilot's first step as `hil identify` would choose it.

    Arms beyond those that `SafeShares` simulates do not affect the choice, only the peaks that are shown. tell,
    designing: called with the progress of each simulation and of each path's design. Raises ConfigError, NoSafeTorque;
    with `servos`, DriverError.
    """
    check_rest_pose(config)
    said = quiet_stream(config) if servos else ()
    given, config = config, within_supply(config)
    said += lowered(given, config)
    if not config.experiment.pilot:
        plan = make_chain_plan(config)
        drawn = prior_arms(config, known_chain(config), arms)
        return _simulated(config, plan, drawn, 1.0, None, tell, said)
    given = chain_config(config)
    belief = ChainBelief.prior(given)
    paths = Paths.of(given, belief.torque, tell=designing)
    search = SafeShares(given, belief, paths, lambda _: None, tell=tell, designing=designing)
    played, refused = step_config(search.config), ""
    try:
        found = search.safe(played, PILOT_SHARES)
    except NoSafeTorque as error:
        share, refused = PILOT_SHARES[-1], str(error)
        try:
            plan = search.paths.plan(played, belief.torque, share)
        except NoHeadroom:  # there is nothing to show
            raise error from None
    else:
        share, plan = found.share, found.plan
    return _simulated(played, plan, belief.at_least(max(arms, ARMS)), share, refused, tell, said)


def _simulated(
    config: Config,
    plan: Plan,
    arms: ChainArms,
    share: float,
    refused: str | None,
    tell: Tell | None,
    servos: tuple[str, ...],
) -> ChainDryRun:
    foreseen = predict_chain(config, plan, arms, tell, SHOWN)
    stops, space = foreseen_stops(config, plan, arms, tell), Space.of(config)
    guessed, built = space.shapes.guessed, space.as_built
    on_stops = said_of_stops(config, resting_stops(config, arms))
    return ChainDryRun(config, "prior", arms.size, share, foreseen, stops, guessed, built, servos, refused, on_stops)
