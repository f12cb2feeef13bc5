"""Find, by dry runs, the largest torque of each joint at which the risk of exceeding a limit is acceptably low."""

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.ensemble import Ensemble
from hil.dry_run.prediction import GUARDED, UNITS, Prediction, predict
from hil.errors import NoSafeTorque
from hil.estimator.arrays import Array, Mask
from hil.plan.plan import Plan, make_plan, scaled


@dataclass(frozen=True)
class AmplitudeOptions:
    """Options of the search for the largest safe torque."""

    search_arms: int = 32
    """Number of arms simulated during the search; the result is checked on all arms."""
    prior_share: float = 0.9
    """Fraction of the limits that may be used before any identification."""
    max_rounds: int = 12
    """Maximum number of search iterations, and of subsequent torque reductions."""
    max_polishing_rounds: int = 4
    """Maximum number of final torque increases, one joint at a time."""
    close: float = 0.94
    """The search ends when every joint uses at least this fraction of its allowed range, or its largest allowed
    torque.
    """
    over: float = 0.97
    """Fraction of the limits that the next iteration aims for if the last torque exceeded them."""
    under: float = 0.99
    """Fraction of the limits that the next iteration aims for if the last torque did not reach them."""
    max_ratio: float = 2.0
    """Maximum ratio of the torques of two successive iterations."""
    damping: float = 0.85
    """Each iteration scales the torque by a power of the ratio of desired to reached peaks; the exponent is multiplied
    by this factor after each iteration.
    """
    min_exponent: float = 0.4
    least_change: float = 0.005
    """The search stops if the torque would change by less than this fraction."""
    polishing_ratio: float = 1.06
    """Factor by which each of the final increases raises a joint's torque."""
    worst_arms: int = 4
    """After a failed check, the next check starts with the worst arms. Their number is the number of arms that may
    exceed a limit, plus this value.
    """
    back_off: float = 0.93
    """Factor by which the torque is multiplied when the check on all arms has failed."""
    torque_share: float = 0.97
    """Fraction of the current limit that may be used, since clamping would distort the designed wave."""
    initial_share: float = 0.125
    """Initial torque, relative to the torque that the current limits allow."""
    initial_safe_share: float = 0.25
    """Torque, relative to the initial one, that is assumed to be safe until the search finds a larger safe torque."""


DEFAULTS = AmplitudeOptions()

AT_MOST = 0.999  # a torque above this fraction of the largest one counts as having reached it


@dataclass(frozen=True)
class Amplitude:
    """A safe amplitude: the plan, its peak torque (joints,) [N m], and the dry run's prediction for it."""

    plan: Plan
    peak_torque: Array
    prediction: Prediction


def largest_amplitude(
    config: Config,
    ensemble: Ensemble,
    share: float = 1.0,
    plan: Plan | None = None,
    pose: Array | None = None,
    cap: Array | None = None,
    executor: Executor | None = None,
    options: AmplitudeOptions = DEFAULTS,
) -> Amplitude:
    """Find the largest torque at which the arms exceed the fraction `share` of their limits with a probability of at
    most safety.limit_chance.

    Args:
        config: configuration of the arm.
        ensemble: arms to simulate.
        share: fraction of the limits that may be used.
        plan: plan whose waves are scaled; by default multisines with a low crest factor.
        pose: where the arm starts (joints,) [rad].
        cap: largest torque (joints,) [N m], in addition to the current limits.
        executor: a concurrent.futures executor for the simulations.
        options: tolerances and limits of the search.

    Raises:
        NoSafeTorque: not even a small torque is safe.
    """
    if ensemble.source == "prior":
        share *= options.prior_share
    base = with_peaks(config, options.initial_share * most_torque(config, options)) if plan is None else plan
    most = most_torque(config, options)
    most = most if cap is None else np.minimum(most, cap)
    found = _search(config, base, ensemble.first(options.search_arms), share, pose, most, executor, options)
    worst: NDArray[np.intp] = np.arange(0)
    for _ in range(options.max_rounds):
        plan = scaled(config, base, found)
        # The cheapest test of whether this torque is also too high uses the arms that were worst at a higher one.
        if not _too_many(config, plan, ensemble.only(worst), share, pose, ensemble.size):
            prediction = predict(config, plan, ensemble, pose=pose, executor=executor)
            if _chance(prediction, share) <= config.safety.limit_chance:
                return Amplitude(plan, found, prediction)
            used = prediction.shares[:, :GUARDED].max(axis=(1, 2))
            worst = np.argsort(used)[-(int(config.safety.limit_chance * ensemble.size) + options.worst_arms) :]
        found = found * options.back_off
    smallest = scaled(config, base, found / options.back_off)
    raise NoSafeTorque(_no_torque(config, smallest, ensemble, share, pose, executor))


def _no_torque(
    config: Config, plan: Plan, ensemble: Ensemble, share: float, pose: Array | None, executor: Executor | None
) -> str:
    """Report the limit that the largest number of arms exceed at the smallest torque that was tried."""
    prediction = predict(config, plan, ensemble, pose=pose, executor=executor)
    exceeding = (prediction.shares[:, :GUARDED] >= share).sum(axis=0)
    quantity, at = np.unravel_index(int(np.argmax(exceeding)), exceeding.shape)
    joint = config.joints[at]
    limit = ("lower position_limit", "upper position_limit", "velocity_limit")[quantity]
    unit = UNITS[quantity]
    torque = ", ".join(
        f"{each.name!r} {peak:.2g} N m" for each, peak in zip(config.joints, plan.segments[0].peak_torque, strict=True)
    )
    part = f"{100 * share:.0f} % of the distance to " if share < 1.0 else ""
    pilot = "omit [stabiliser] so that the pilot proposes one, "
    return (
        f"{config.path}: no torque was found that keeps the arm within its limits. Even with peak torques of {torque}, "
        f"{exceeding[quantity, at]} of {ensemble.size} simulated arms exceed {part}the {limit} of joint "
        f"{joint.name!r} ({prediction.limits[quantity, at]:.3g} {unit}). The probability of exceeding {part}any limit "
        f"is {100 * _chance(prediction, share):.2g} %; safety.limit_chance allows "
        f"{100 * config.safety.limit_chance:.2g} %. Widen that limit, "
        f"{pilot if config.experiment.pilot and config.stabiliser is not None else ''}add values to [arm.prior] so "
        "that the simulated arms differ less, or raise safety.limit_chance."
    )


def with_peaks(config: Config, peak_torque: Array) -> Plan:
    """Plan the configured experiment with these peak torques (joints,) [N m]."""
    experiment = config.experiment.model_copy(update={"peak_torque": peak_torque.tolist()})
    return make_plan(config.model_copy(update={"experiment": experiment}))


def _search(
    config: Config,
    base: Plan,
    ensemble: Ensemble,
    share: float,
    pose: Array | None,
    most: Array,
    executor: Executor | None,
    options: AmplitudeOptions,
) -> Array:
    """Approach the limits iteratively, since the joints are coupled. Return the peak torques (joints,) [N m]."""
    torque = base.segments[0].peak_torque
    first = base.first_segment() if ensemble.source == "prior" else base

    def reached_with(tried: Array) -> Array:
        prediction = predict(config, scaled(config, first, tried), ensemble, pose=pose, briefly=True, executor=executor)
        return _reached(config, prediction, share)

    best, there, used = options.initial_safe_share * torque, None, 0.0
    torque = np.minimum(torque, most)
    exponent = 1.0
    for _ in range(options.max_rounds):
        reached = reached_with(torque)
        if reached.max() <= 1.0 and reached.min() > used:
            best, there, used = torque, reached, float(reached.min())
        if reached.max() <= 1.0 and ((reached >= options.close) | (torque >= AT_MOST * most)).all():
            break
        wanted = np.where(reached > 1.0, options.over, options.under) / np.clip(reached, 1e-3, 1e3)
        former = torque
        torque = np.minimum(torque * np.clip(wanted**exponent, 1 / options.max_ratio, options.max_ratio), most)
        if (np.abs(torque - former) <= options.least_change * former).all():
            break
        exponent = max(options.min_exponent, options.damping * exponent)
    return _polished(reached_with, best, reached_with(best) if there is None else there, most, options)


def _polished(
    reached_with: Callable[[Array], Array], torque: Array, reached: Array, most: Array, options: AmplitudeOptions
) -> Array:
    """In small steps, raise the torque of the joint that uses the least of its range, as long as all joints stay within
    their limits.

    reached: fraction of the allowed range that each joint uses with `torque`.
    """
    blocked = np.zeros(torque.size, dtype=bool)
    for _ in range(options.max_polishing_rounds):
        blocked |= (reached >= options.close) | (torque >= AT_MOST * most)
        if blocked.all():
            break
        joint = int(np.argmin(np.where(blocked, np.inf, reached)))
        tried = torque.copy()
        tried[joint] = min(options.polishing_ratio * tried[joint], most[joint])
        there = reached_with(tried)
        if there.max() <= 1.0:
            torque, reached = tried, there
        else:
            blocked[joint] = True
    return torque


def _reached(config: Config, prediction: Prediction, share: float) -> Array:
    """Fraction of its allowed range that each joint uses (joints,): that of the worst arm or the predicted one,
    whichever is larger.
    """
    return np.asarray(prediction.shares_with(config.safety.limit_chance)[:GUARDED].max(axis=0) / share)


def _too_many(config: Config, plan: Plan, few: Ensemble, share: float, pose: Array | None, count: int) -> bool:
    """Whether the number of arms in `few` that exceed `share` of a limit is larger than the number allowed among
    `count` arms.
    """
    if not few.size:
        return False
    passed = _passed(predict(config, plan, few, pose=pose), share)
    return bool(passed.sum() > config.safety.limit_chance * count)


def _passed(prediction: Prediction, share: float) -> Mask:
    """Whether each arm exceeds `share` of a limit (arms,)."""
    return np.asarray((prediction.shares[:, :GUARDED] >= share).any(axis=(1, 2)))


def _chance(prediction: Prediction, share: float) -> float:
    """Probability that an arm exceeds `share` of a limit: the larger of the observed fraction and the tail estimate."""
    return max(float(np.mean(_passed(prediction, share))), prediction.stop_chance)


def most_torque(config: Config, options: AmplitudeOptions = DEFAULTS) -> Array:
    """Largest torque that the current limits allow (joints,) [N m]."""
    limits = np.array([joint.goal_limit * joint.torque_per_goal for joint in config.joints])
    return np.asarray(options.torque_share * limits)
