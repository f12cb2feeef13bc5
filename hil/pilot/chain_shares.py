"""The largest fraction of the designed paths' amplitude that is safe for every spatial arm of the current belief.

`hil identify` and `hil dry-run` both use this search, on the same arms, so that they agree.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hil.config.schema import Config, PriorConfig
from hil.dry_run.chain_prediction import ChainPrediction, predict_chain, simulated_seconds
from hil.dry_run.chain_stop import foreseen_stops
from hil.dry_run.chain_summary import nearest_limit, unsafe
from hil.dry_run.prediction import GUARDED, QUANTITIES, Prediction
from hil.errors import NoSafeTorque
from hil.estimator.arrays import Array, Mask
from hil.estimator.progress import Tell
from hil.pilot.chain_belief import ChainBelief
from hil.pilot.chain_paths import Paths
from hil.plan.chain_model import limit_names
from hil.plan.chain_plan import NoHeadroom
from hil.plan.plan import Plan
from hil.setup.session.servo_session import Say

SEARCH_ARMS, ARMS = 24, 72
"""Numbers of arms simulated to find a safe fraction of the amplitude, and to confirm it."""

PILOT_SHARES = (0.3, 0.2, 0.12, 0.06)
SHARES = (1.0, 0.88, 0.76, 0.64, 0.52, 0.4, 0.28, 0.18)
SMALL = 0.5
"""If the safe amplitude is below this fraction of the desired one, other paths with more reserve are designed."""

REDESIGNS = 2

OTHER_SEEDS = 2
"""Maximum number of paths designed from other seeds if a path is not safe at any amplitude."""

_NEXT_SEED = 100

MOST_SIMULATED_S = 60_000.0
"""A search tries no further paths after it has simulated this much motion [s], summed over all arms: this takes about a
minute of processor time with six joints.
"""

STOPPED_SHARE = 0.5
"""Computing time for simulating a stop, relative to the time for simulating one arm on a path with its transitions."""

RAISED_RATE = 1.6
"""First rate tried when searching for a higher one to recommend, relative to the configured rate."""

ROOM = 1.2
"""Recommended extension of a limit, relative to the amount by which the simulated arms exceed the limit."""

SATURATED = 0.98
LEAST_SPREAD_SHARE = 0.1
"""A smaller spread in [arm.prior] is recommended only if it is at least this fraction of the configured one."""


@dataclass(frozen=True)
class Found:
    """A safe fraction of the amplitude, with its plan and the predicted motion."""

    share: float
    plan: Plan
    foreseen: ChainPrediction


@dataclass
class SafeShares:
    """The current belief about the arm, and the paths designed for it.

    last: amplitude of the previous run. cap: largest allowed amplitude after a run that exceeded a limit. Both are
    fractions of the amplitude of `paths`, and are converted when these paths are replaced. tell: called with the
    progress of each simulation of the arms. designing: called with the progress of each path's design. trying: called
    with a description of each path and amplitude before it is simulated. simulated: motion simulated so far [s].
    passed: on which sides of its rest angle each joint has been in a run, as in `resting_stops`.
    """

    given: Config
    belief: ChainBelief
    paths: Paths
    say: Say
    cap: float = 1.0
    last: float = np.inf
    tell: Tell | None = None
    designing: Tell | None = None
    trying: Callable[[str], None] | None = None
    simulated: float = 0.0
    passed: Mask | None = None
    _path: int = 0

    @property
    def is_exhausted(self) -> bool:
        """Whether the search has simulated so much motion that it should try no further paths."""
        return self.simulated > MOST_SIMULATED_S

    @property
    def config(self) -> Config:
        """The configuration with a stabiliser suited to the current ensemble."""
        return self.belief.with_stabiliser(self.given)

    def safe(self, config: Config, shares: tuple[float, ...], most: float = np.inf) -> Found:
        """Find the first of `shares`, fractions of the designed path's amplitude, that is safe for all simulated arms.

        most: largest allowed fraction; if `shares` begins with a larger one, all of them are scaled down in proportion.
        On other paths, the fraction that gives the same amplitude is used instead.

        If the safe fraction is small, other paths with more reserve are designed; the most informative safe one is
        kept. If none is safe, paths from other seeds are tried. Raises NoSafeTorque if no path is safe at any
        amplitude.
        """
        self._path = 0
        found, why = self._safe_of_these(config, shares, most)
        first = self.given, self.paths, self.cap, self.last
        for number in range(OTHER_SEEDS):
            if found is not None:
                return found
            if self.is_exhausted:
                break
            times = self._other_seed()
            if times is None:
                break
            self.say(
                f"No amplitude of the designed path is safe for all arms: {why}. Trying another path ({number + 1} of "
                f"{OTHER_SEEDS})."
            )
            most = most / times
            found, other_why = self._safe_of_these(config, shares, most)
            why = other_why if found is not None else why
        if found is None:
            self.given, self.paths, self.cap, self.last = first
            raise NoSafeTorque(
                f"{config.path}: no motion is safe for all arms consistent with what is known, not even "
                f"the designed path at {100 * shares[-1]:.0f} % of its amplitude: {why}."
                f"{self._ended_early()}{self._helped_by_rate(config, shares)}"
            )
        return found

    def _ended_early(self) -> str:
        if not self.is_exhausted:
            return ""
        return (
            f" The search ended early, after {self.simulated / 3600.0:.0f} h of simulated motion: try a different "
            "experiment.seed, which gives other paths."
        )

    def _helped_by_rate(self, config: Config, shares: tuple[float, ...]) -> str:
        """Name a higher rate at which a path would be safe because the spring would be stiffer; "" if there is none."""
        if self.given.stabiliser is not None:
            return ""
        experiment = self.given.experiment
        gains = self.belief.gains(self.given)
        for wanted in sorted({min(RAISED_RATE * experiment.rate, gains.sufficient_rate), gains.sufficient_rate}):
            if wanted <= experiment.rate:
                continue
            rate = _round_rate(wanted, experiment.period)
            faster = _at_rate(config, rate).model_copy(update={"stabiliser": gains.at(rate)})
            try:
                paths = Paths.of(_at_rate(self.given, rate), self.belief.torque, tell=self.designing)
            except NoSafeTorque:
                continue
            if replace(self, given=faster, paths=paths)._largest(faster, shares)[0] is not None:
                return (
                    f" In a simulation at experiment.rate = {rate:g}, a motion is safe. At {experiment.rate:g} Hz, "
                    "delay makes a stiff stabiliser oscillate, and a softer one is too weak for these arms."
                )
        return ""

    def _other_seed(self) -> float | None:
        """Design paths from another seed; return the ratio of new to old amplitude, None if no path is safe."""
        experiment = self.given.experiment
        other = experiment.model_copy(update={"seed": experiment.seed + _NEXT_SEED})
        given, former = self.given.model_copy(update={"experiment": other}), self.paths
        try:
            self.paths = Paths.of(given, self.belief.torque, tell=self.designing)
        except NoSafeTorque:
            return None
        self.given = given
        return self._rescaled(former)

    def _rescaled(self, former: Paths) -> float:
        """Convert the fractions from the old paths to the new ones; return the ratio of their amplitudes."""
        times = self.paths.amplitude_over(former)
        self.last = self.last / times
        self.cap = min(self.cap / times, 1.0) if self.cap < 1.0 else 1.0
        return times

    def _safe_of_these(self, config: Config, shares: tuple[float, ...], most: float) -> tuple[Found | None, str]:
        most = min(most, self.cap) if self.cap < 1.0 else most
        found, why, shortage = self._largest(config, _up_to(most, shares))
        reserve = self.paths.reserve
        for _ in range(REDESIGNS):
            if self.is_exhausted or (found is not None and found.share >= SMALL * min(most, shares[0])):
                break
            former, reserve = self.paths, reserve.larger(shortage)
            try:
                self.paths = Paths.of(self.given, self.belief.torque, reserve, self.designing)
            except NoSafeTorque:
                break
            times = self.paths.amplitude_over(former)
            other, other_why, shortage = self._largest(config, _up_to(most / times, shares))
            if other is None or (found is not None and self._worth(former, found) <= self._worth(self.paths, other)):
                self.paths = former
            else:
                found, most = other, most / self._rescaled(former)
                self.say("Designed another path, which stays farther from the limits.")
            why = why if other is not None else other_why
        return found, why

    def _largest(self, config: Config, shares: tuple[float, ...]) -> tuple[Found | None, str, float]:
        """Return the first safe fraction of the amplitude, why the next larger one is unsafe, and how much clearance
        that one lacks [m].

        If neither the first nor the last fraction is safe when tried on a few arms, those in between are not tried.
        """
        self._path += 1
        found, why, shortage = self._found(config, shares[0], f"amplitude 1 of at most {len(shares)}")
        if found is not None or len(shares) == 1:
            return found, why, shortage
        last_why, last_shortage = self._unsafe(config, shares[-1], SEARCH_ARMS, "the smallest amplitude")[1:]
        if last_why:
            return None, last_why, max(shortage, last_shortage)
        for number, share in enumerate(shares[1:], 2):
            if self.is_exhausted and share != shares[-1]:
                continue
            found, not_safe, lacking = self._found(config, share, f"amplitude {number} of at most {len(shares)}")
            shortage = max(shortage, lacking)
            if found is not None:
                break
            why = not_safe
        return found, why, shortage

    def _found(self, config: Config, share: float, which: str) -> tuple[Found | None, str, float]:
        """Return this fraction if it is safe; otherwise, why it is not, and by how much the clearance is too
        small [m].
        """
        shortage = 0.0
        for count in (SEARCH_ARMS, ARMS):
            found, why, lacking = self._unsafe(config, share, count, which)
            shortage = max(shortage, lacking)
            if why:
                return None, why, shortage
        assert found is not None  # otherwise there is a reason
        why = self._unsafe_stop(config, found.plan)
        return (None if why else found), why, shortage

    def _unsafe(self, config: Config, share: float, count: int, which: str) -> tuple[Found | None, str, float]:
        """Simulate a fraction of the amplitude on some arms. Return the prediction, why this fraction is unsafe, and by
        how much its clearance is too small [m].
        """
        if self.trying is not None:
            most = (1 + OTHER_SEEDS) * (1 + REDESIGNS)
            self.trying(f"path {self._path} of at most {most}, {which}")
        try:
            plan = self.paths.plan(config, self.belief.torque, share)
        except NoHeadroom as error:  # the arm is heavier than the paths were designed for
            return None, f"{error} {_better_known(config)}", 0.0
        foreseen = predict_chain(config, plan, self.belief.arms.first(count), self.tell, passed=self.passed)
        self.simulated += count * simulated_seconds(plan)
        not_safe = unsafe(config, foreseen)
        why = f"{not_safe}. {_remedy(config, foreseen, self.belief.stiffness_share(self.given))}" if not_safe else ""
        return Found(share, plan, foreseen), why, -float(foreseen.rooms.min())

    def _worth(self, paths: Paths, found: Found) -> float:
        """Worst relative standard error of the base parameters at the amplitude found for a path."""
        return paths.designer.worth(paths.designer.scaled(paths.identify, found.share))[0]

    def _unsafe_stop(self, config: Config, plan: Plan) -> str:
        if config.safety.stop == "cut":
            return ""
        self.simulated += STOPPED_SHARE * ARMS * simulated_seconds(plan)
        return foreseen_stops(config, plan, self.belief.arms.first(ARMS), self.tell, self.passed).unsafe


def _round_rate(rate: float, period: float) -> float:
    """Return the next multiple of 10 Hz if it gives a whole number of samples per period, otherwise the next rate [Hz]
    that does.
    """
    tens = 10.0 * np.ceil(rate / 10.0)
    return float(tens if (tens * period).is_integer() else np.ceil(rate * period) / period)


def _at_rate(config: Config, rate: float) -> Config:
    return config.model_copy(update={"experiment": config.experiment.model_copy(update={"rate": rate})})


def _up_to(most: float, shares: tuple[float, ...]) -> tuple[float, ...]:
    """Return the fractions, scaled so that the first is at most `most`."""
    return tuple(min(1.0, most / shares[0]) * share for share in shares)


def _remedy(config: Config, foreseen: ChainPrediction, stiffness: Array) -> str:
    if not foreseen.is_clear:
        helps = "A rest_pose farther from obstacles, or less restrictive [clearance] settings (floor, boxes, margin)"
        return f"{helps}, if the arm allows it, can help. {_better_known(config)}"
    return limit_remedy(config, foreseen.peaks, stiffness)


def limit_remedy(config: Config, peaks: Prediction, stiffness: Array) -> str:
    """Suggest what to change, and by how much, if a joint exceeds a limit on some of the simulated arms.

    stiffness: each joint's stabiliser stiffness at this rate, relative to that at a high rate (joints,).
    """
    row, at = nearest_limit(peaks)
    joint, limit, rate = config.joints[at], float(peaks.limits[row, at]), config.experiment.rate
    typical, reached = float(peaks.median[row, at]), float(peaks.exceeding(config.safety.limit_chance)[row, at])
    share = (limit - typical) / (reached - typical) if reached != typical else 0.0
    has_room = LEAST_SPREAD_SHARE < share < 1.0
    helps = []
    if stiffness[at] < 1.0:
        wanted = min(1.0 / stiffness[at], ROOM * _too_soft(peaks))
        helps.append(
            f"a rate of about {float(f'{wanted * rate:.2g}'):g} Hz instead of {rate:g} (at {rate:g} Hz the stabiliser "
            f"of {joint.name!r} has {100 * stiffness[at]:.0f} % of its stiffness at a high rate)"
        )
    wanted = limit + ROOM * (reached - limit)
    if QUANTITIES[row] == "velocity":
        helps.append(f"a velocity_limit of at least {wanted:.2g} rad/s for {joint.name!r}, if the arm allows it")
    else:
        side = "lower" if QUANTITIES[row] == "lowest position" else "upper"
        helps.append(
            f"a position_limit for {joint.name!r} with its {side} end at {wanted:.2f} rad, if the arm allows it, or a "
            f"rest_pose {abs(wanted - limit):.2f} rad farther from that end"
        )
    torque = QUANTITIES.index("torque")
    if peaks.quantile[torque, at] > SATURATED * peaks.limits[torque, at]:
        helps.append(f"a larger {joint.goal_limit_name} for {joint.name!r}, since some simulated arms reach it")
    if has_room:
        spread = _spread(config)
        helps.append(
            f"more accurate masses in the URDF ([arm.prior] spread = {share * spread:.2g} instead of {spread:g})"
        )
    return f"These changes help, alone or together: {'; '.join(helps)}"


def _too_soft(peaks: Prediction) -> float:
    """Factor by which the stabiliser must be stiffened to keep all joints within their limits; infinite if no
    factor suffices.
    """
    middle, reached = (peaks.median[:GUARDED], peaks.quantile[:GUARDED])
    room, way = (np.abs(each - middle) for each in (peaks.limits[:GUARDED], reached))
    is_typical = (peaks.limits[:GUARDED] - middle) * (reached - middle) < 0.0
    with np.errstate(divide="ignore"):
        return float(np.where(is_typical & (way > 0.0), np.inf, way / room).max())


def _better_known(config: Config) -> str:
    return (
        f"More accurate masses in the URDF ([arm.prior] spread below {_spread(config):g}) help too, as does a larger "
        f"{limit_names(config)}"
    )


def _spread(config: Config) -> float:
    return (config.arm.prior or PriorConfig()).spread


def step_config(config: Config) -> Config:
    """The configuration of a step: one path, run for two periods whether or not it settles."""
    update: dict[str, Any] = {"held_out": False, "max_settling_periods": 1, "periods": 1, "settle_within": 0.99}
    return config.model_copy(update={"experiment": config.experiment.model_copy(update=update)})
