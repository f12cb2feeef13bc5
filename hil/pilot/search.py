"""The search from the first careful run to a plan that reaches the limits: run, update the belief, and raise the torque
until the belief is precise.

A run in which nothing moved, a limit was exceeded or the motion never settled is informative too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude, largest_amplitude, most_torque, with_peaks
from hil.dry_run.prediction import GUARDED, predict
from hil.dry_run.waves import designed_plan, roomy_plan, roomy_plans
from hil.errors import ExperimentError, NoSafeTorque
from hil.estimator.arrays import Array, Mask
from hil.estimator.excitation.harmonics import harmonics_within
from hil.estimator.models.parameters import Physics
from hil.pilot.belief import MOVED_STEPS, Belief, earlier_belief, prior_belief
from hil.pilot.breakaway import FrictionWindow, broke_free, narrowed, raised, resting_on_stop
from hil.pilot.gains import falls_over, with_stabiliser
from hil.pilot.options import PilotOptions
from hil.pilot.steps import Played, Player, Step
from hil.plan.plan import Plan, scaled
from hil.plan.supply_speed import lowered, slower
from hil.results.result import Result, SettledResult
from hil.runs.run_folder import RunFolder

DEFAULTS = PilotOptions()

_LINES_FOR_DETECTION = 4
"""If experiment.detection leaves some spectral lines unexcited, the band must contain at least this many lines per
joint.
"""


@dataclass
class Search:
    """Search state: runs so far and the current belief; both are updated after each run."""

    config: Config
    run: RunFolder
    player: Player
    belief: Belief
    steps: list[Step] = field(default_factory=list)
    cap: Array | None = None
    """Torque (joints,) [N m] that must not be exceeded, because an earlier run exceeded a limit."""
    pose: Array | None = None
    """Last rest position of the arm (joints,) [rad]."""
    swing: Array | None = None
    """Largest range of motion of each joint so far (joints,) [rad]."""

    springs: Mask | None = None
    """Which joints had a spring in the last run with a stabiliser (joints,); None before the first such run."""
    options: PilotOptions = DEFAULTS
    from_earlier: bool = False
    """Whether the belief comes from the result of an earlier run, and no run so far has contradicted it."""
    earlier_swing: Array | None = None
    """Range of motion of each joint in the earlier run from which the belief comes (joints,) [rad], if known."""

    fast: Mask = field(init=False)
    """Which joints (joints,), in the last run, exceeded their velocity limit before they had moved by MOVED_STEPS."""
    calm: Array = field(init=False)
    """Cap on the torque (joints,) [N m]: below the torque of every run in which a joint exceeded its velocity limit
    before moving by MOVED_STEPS; infinite if there was no such run.
    """

    window: FrictionWindow = field(init=False)

    def __post_init__(self) -> None:
        joints = len(self.config.joints)
        self.fast = np.zeros(joints, dtype=np.bool_)
        self.calm = np.full(joints, np.inf)
        self.window = FrictionWindow.unknown(joints)

    @classmethod
    def of(
        cls,
        config: Config,
        run: RunFolder,
        player: Player,
        options: PilotOptions = DEFAULTS,
        earlier: Result | None = None,
    ) -> "Search":
        """Start a search from the prior, or from the result of an earlier run on the same arm. Raises ConfigError."""
        if earlier is None:
            return cls(config, run, player, prior_belief(config, options.arms), options=options)
        belief = earlier_belief(config, earlier, options.arms)
        swing = None
        if isinstance(earlier, SettledResult) and earlier.steps:
            low, high = np.array(earlier.steps[-1].seen)[:2]
            swing = high - low
        return cls(config, run, player, belief, options=options, from_earlier=True, earlier_swing=swing)

    @property
    def held(self) -> Config:
        """The configuration, with a stabiliser if the arm is believed to need one."""
        return with_stabiliser(self.config, self.belief, self.springs)

    def first_run(self) -> tuple[Config, Amplitude]:
        """Return the configuration and amplitude of the first run without running it. Raises NoSafeTorque."""
        return self._pilot_amplitude(pilot_config(self.held, self.options), 0)

    def find(self) -> tuple[Config, Amplitude]:
        """Find the configuration and the amplitude of the full run.

        Raises the same errors as a run, and ExperimentError if a joint does not move even at its largest torque.
        """
        self._pilot()
        return self._raise_to_limits()

    def learn(self, config: Config, played: Played) -> None:
        """Update the belief with the outcome of a run of `config`.

        Raises ExperimentError if the run shows that the arm rests against an end stop or something else.
        """
        self.steps.append(played.step)
        if config.stabiliser is not None:
            self.springs = np.array(config.stabiliser.stiffness) > 0.0  # a joint that had one keeps it
        if played.passed_limit and not broke_free(self.config, config, played.step.seen).any():
            self.cap = self.options.torque_after_limit * played.step.peak_torque
        if self.from_earlier and not (played.error is None and played.step.within):
            self.from_earlier, self.earlier_swing = False, None
            self.belief = prior_belief(self.config, self.options.arms)
            self.player.say("The arm does not move as the earlier run predicts: starting from the prior instead.")
        swing = played.step.seen[1] - played.step.seen[0] if played.seen is None else played.seen.swing
        self.swing = swing if self.swing is None else np.fmax(self.swing, swing)
        self.window = self.window.after(self.config, played, swing)
        self._slow_down(played)
        self._stay_within_supply(played)
        if played.seen is None:
            return
        if stop := resting_on_stop(config, played.seen):
            raise ExperimentError(stop)
        self.belief = self.belief.after(config, played.seen)
        self.pose = _within_limits(self.config, played.seen.end, self.options.start_inside)

    def _slow_down(self, played: Played) -> None:
        """Limit the torque of joints that exceeded their velocity limit before moving by MOVED_STEPS."""
        limit = np.array([joint.velocity_limit for joint in self.config.joints])
        self.fast = played.passed_velocity_limit & ~self.moved & (played.step.seen[2] > limit)
        calmer = self.options.torque_after_limit * played.step.peak_torque
        self.calm = np.where(self.fast, np.minimum(calmer, self.calm), self.calm)

    def _stay_within_supply(self, played: Played) -> None:
        """Keep joints below speeds at which their supply cannot drive the commanded current."""
        if played.delivered is None:
            return
        former, self.config = self.config, slower(self.config, played.delivered.tolist())
        for sentence in lowered(former, self.config):
            self.player.say(sentence)

    @property
    def moved(self) -> Mask:
        """Which joints have moved in any run so far (joints,)."""
        step = np.array([joint.joint.servo.position_unit for joint in self.config.joints])
        swing = np.zeros(len(step)) if self.swing is None else self.swing
        return np.asarray(swing > MOVED_STEPS * step)

    def amplitude(self, config: Config, share: float, plan: Plan | None = None) -> Amplitude:
        """The largest amplitude that is safe for all plausible arms. share: fraction of each limit that the motion may
        use.

        If there is no such amplitude, the amplitude of the last run is used, or a smaller one if the real arm has
        exceeded a limit. Raises NoSafeTorque if there is no such amplitude and there has been no run yet.
        """
        ensemble, options = self.belief.ensemble(self._farther), self.options
        cap = self.cap
        if falls_over(config, self.belief):
            share *= options.falling_share
            if self.steps:
                least = options.min_falling_torque * most_torque(config)
                most = np.maximum(options.falling_raise * self.steps[-1].peak_torque, least)
                cap = most if cap is None else np.minimum(cap, most)
        try:
            return largest_amplitude(config, ensemble, share, plan, self.pose, cap)
        except NoSafeTorque:
            if not self.steps:
                raise
        torque = self.steps[-1].peak_torque
        torque = torque if self.cap is None else np.minimum(torque, self.cap)
        return self._with(config, with_peaks(config, torque) if plan is None else plan, torque)

    def _with(self, config: Config, plan: Plan, torque: Array) -> Amplitude:
        """The waves of `plan` with these peak torques (joints,) [N m], whether safe or not."""
        plan = scaled(config, plan, torque)
        return Amplitude(plan, torque, predict(config, plan, self.belief.ensemble(self._farther), pose=self.pose))

    @property
    def _farther(self) -> float:
        allowed = np.ptp(np.array([joint.position_limit for joint in self.config.joints]), axis=1)
        swings = [each for each in (self.swing, self.earlier_swing) if each is not None]
        swing = np.max(swings, axis=0) if swings else np.zeros(len(allowed))
        return float((allowed / np.maximum(swing, 0.02)).max())

    def _pilot(self) -> None:
        """Play small runs until every joint moves, raising the torque from run to run, up to the joints' limits."""
        options = self.options
        while True:
            number = len(self.steps)
            config, found = self._pilot_amplitude(pilot_config(self.held, options), number)
            before = self.calm
            self._play(config, f"pilot-{number + 1}", "Pilot" if number == 0 else f"Pilot {number + 1}", found)
            still = ~self.moved
            if not still.any():
                return
            if (again := self.fast & np.isfinite(before)).any():
                self._refuse_velocity_limit(
                    again, still & (found.peak_torque >= options.at_limit * most_torque(config))
                )
            at_limit = found.peak_torque >= options.at_limit * np.minimum(most_torque(config), before)
            if at_limit[still].all() or len(self.steps) >= options.max_pilots:
                calm = still & np.isfinite(self.calm)
                if calm.any():
                    self._refuse_velocity_limit(calm, still & ~calm)
                self._give_up(config, _names(self.config, still))
            self.player.say(" ".join(self._of_still(still)))

    def _of_still(self, still: Mask) -> Iterator[str]:
        if self.fast.any():
            yield (
                f"{_and(_names(self.config, self.fast))} exceeded the velocity limit before moving by {MOVED_STEPS} "
                "encoder steps: the next run uses less torque."
            )
        held = still & ~self.fast
        if held.any():
            said = f"{_and(_names(self.config, held))} did not move: friction is larger than this torque."
            yield f"{said} Repeating with more torque."

    def _pilot_amplitude(self, config: Config, number: int) -> tuple[Config, Amplitude]:
        """The configuration and the amplitude of a pilot run.

        A joint that has not moved yet gets moderately more torque than before. If that is too much for some plausible
        arms, its position limits are narrowed around its current position (hil.pilot.breakaway).
        """
        options = self.options
        share = options.pilot_shares[min(number, len(options.pilot_shares) - 1)]
        if self.from_earlier:
            share = max(share, options.pilot_share_known)
        most, falls = most_torque(config), falls_over(config, self.belief)
        try:
            found = self.amplitude(config, share)
        except NoSafeTorque:
            if falls:
                raise
            torque = options.first_torque_share * most
            every = np.ones(len(most), dtype=np.bool_)
            return self._narrowed(config, every), self._with(config, with_peaks(config, torque), torque)
        if not self.steps:
            return config, found
        still = ~self.moved
        ratio = options.falling_breakaway_raise if falls else options.breakaway_raise
        former = self.steps[-1].peak_torque
        wanted = raised(found.peak_torque, former, still, ratio, most)
        wanted = np.where(still, np.minimum(wanted, self.calm), wanted)
        held = ~still & self._would_stand(found)
        if held.any():
            wanted = np.where(held, self._above_friction(config, held), wanted)
        if (wanted == found.peak_torque).all():
            return config, found
        risky = wanted > found.peak_torque
        config = config if falls else self._narrowed(config, risky)
        return config, self._with(config, found.plan, wanted)

    def moving(self, plan: Plan) -> tuple[Config, Amplitude]:
        """The configuration and the largest amplitude that is safe for all plausible arms. Joints that stood still with
        it get more torque, with which they have moved in an earlier run or in one that is played now, between narrow
        limits.

        Raises the same errors as a run, and ExperimentError if no torque moves such a joint within its limits.
        """
        for _ in range(self.options.max_steps):
            config = self.held
            found = self.amplitude(config, 1.0, plan)
            held = self._would_stand(found)
            if not held.any():
                break
            found = self._with(config, plan, np.where(held, self._above_friction(config, held), found.peak_torque))
            untried = held & np.isinf(self.window.enough)
            if not untried.any():
                break
            self.player.say(
                f"{_and(_names(self.config, untried))} did not move with the largest torque that is safe for all "
                "plausible arms: trying more torque between narrow limits."
            )
            self._step(config if falls_over(config, self.belief) else self._narrowed(config, untried), found)
        return config, found

    def _step(self, config: Config, found: Amplitude) -> None:
        number, options = len(self.steps) + 1, self.options
        self._play(step_config(config, options), f"step-{number}", f"Step {number}", only_first(found, options))

    def _would_stand(self, found: Amplitude) -> Mask:
        return np.asarray(found.peak_torque <= self.window.still)

    def _above_friction(self, config: Config, held: Mask) -> Array:
        """Torque (joints,) [N m] that may move the joints that friction `held` (joints,). Raises ExperimentError."""
        options = self.options
        ratio = options.falling_breakaway_raise if falls_over(config, self.belief) else options.breakaway_raise
        most = np.minimum(most_torque(config), self.calm)
        torque = self.window.next(ratio, options.torque_after_limit, most)
        closed = held & (torque <= options.least_raise * self.window.still)
        if closed.any():
            raise ExperimentError(self.window.message(self.config, closed))
        return torque

    def _narrowed(self, config: Config, at: Mask) -> Config:
        pose = np.array(config.arm.rest_pose) if self.pose is None else self.pose
        return narrowed(config, pose, at, self.options)

    def _raise_to_limits(self) -> tuple[Config, Amplitude]:
        """Play intermediate runs until the arm is known well enough to go straight to its limits."""
        plan = self.waves(self.held)
        config, found = self.moving(plan)
        options, pilots = self.options, len(self.steps)
        while not self._certain(config, found) and len(self.steps) - pilots < options.max_steps:
            self.player.say(
                "The estimate is still too uncertain to go straight to the limits: adding an intermediate run."
            )
            former = found.peak_torque
            self._step(config, found)
            config, found = self.moving(self.waves(self.held) if config.stabiliser is not None else plan)
            is_fair = self._shares(found).min() > options.fair_share
            worthwhile = options.worthwhile_raise if is_fair else options.worthwhile_raise_far
            if (found.peak_torque <= worthwhile * former).all():
                break  # the updated belief allows hardly any more torque
        return config, self._roomiest(config, found)

    def _roomiest(self, config: Config, found: Amplitude) -> Amplitude:
        """Return `found` or, if it leaves much of the position range unused, the amplitude with other waves whose
        motion covers more of the range.
        """
        options = self.options
        limited = (found.peak_torque >= options.at_limit * most_torque(config)).all() or self.cap is not None
        if limited or config.experiment.design == "optimal" or used_range(found).min() >= options.wide_range:
            return found
        for plan in roomy_plans(config, Physics.of(self.belief.middle), 1 + options.other_waves)[1:]:
            other = self.amplitude(config, 1.0, plan)
            if self._would_stand(other).any():
                continue
            found = max(found, other, key=lambda each: float(used_range(each).min()))
            if used_range(found).min() >= options.wide_range:
                break
        return found

    def _play(self, config: Config, folder: str, name: str, found: Amplitude) -> None:
        played_config = with_torque(config, found.peak_torque)
        # The first period is informative even if unsettled; a ramp out, unlike cutting torque, lets the arm settle.
        calm = Amplitude(replace(found.plan, settle_within=np.inf), found.peak_torque, found.prediction)
        played = self.play(played_config, self.run.below(folder, played_config), name, calm)
        self.learn(played_config, played)

    def play(self, config: Config, folder: RunFolder, name: str, found: Amplitude) -> Played:
        """Play one run from where the last one left the arm, and compare its motion with that of the plausible arms."""
        arms = self.belief.ensemble(self._farther)
        return self.player.play(config if self.pose is None else _from_anywhere(config), folder, name, found, arms)

    def waves(self, config: Config) -> Plan:
        """Design the waves of the full run for the arm as currently estimated."""
        arm = Physics.of(self.belief.middle)
        if config.experiment.design == "optimal":
            return designed_plan(config, arm, [name for name in self.belief.names if _is_base(name)])
        return roomy_plan(config, arm)

    def _certain(self, config: Config, found: Amplitude) -> bool:
        shares, options = self._shares(found), self.options
        full = found.peak_torque >= options.at_limit * most_torque(config)
        capped = np.zeros_like(full) if self.cap is None else found.peak_torque >= options.at_limit * self.cap
        certain = options.certain_share_known if self.from_earlier else options.certain_share
        enough = certain * (options.falling_share if falls_over(config, self.belief) else 1.0)
        return bool(((shares >= enough) | full | capped).all())

    @staticmethod
    def _shares(found: Amplitude) -> Array:
        """Fraction of the limit that a typical arm reaches (joints,)."""
        return np.asarray(np.median(found.prediction.shares, axis=0)[:GUARDED].max(axis=0))

    def _refuse_velocity_limit(self, fast: Mask, held: Mask) -> NoReturn:
        """Raise ExperimentError because the velocity limit is too low. fast: joints that exceeded it. held: joints that
        did not move even at full torque.
        """
        said = "; ".join(
            f"{joint.name}: velocity_limit = {joint.velocity_limit:g} rad/s, {MOVED_STEPS} encoder steps are "
            f"{MOVED_STEPS * joint.joint.servo.position_unit:.2g} rad"
            for joint, is_fast in zip(self.config.joints, fast.tolist(), strict=True)
            if is_fast
        )
        raise ExperimentError(
            f"{_and(_names(self.config, fast))} exceeded the velocity limit while breaking away, before moving far "
            f"enough to be measured ({said}). More torque would only increase the speed: raise velocity_limit."
            + (
                f" {_and(_names(self.config, held))} did not move even at the maximum allowed torque."
                if held.any()
                else ""
            )
        )

    def _give_up(self, config: Config, still: list[str]) -> None:
        tried = "; ".join(
            f"{step.name} {', '.join(f'{torque:.3g}' for torque in step.peak_torque)} N m" for step in self.steps
        )
        most = ", ".join(f"{torque:.3g}" for torque in most_torque(config))
        raise ExperimentError(
            f"{_and(still)} moved by fewer than {MOVED_STEPS} encoder steps. Tried: {tried}; the configured limits "
            f"allow {most} N m. With torque off, move each of these joints by hand. If it moves freely, raise its "
            "current_limit or voltage_limit, check the supply, widen position_limit, lengthen experiment.period, or "
            "use a stronger servo."
        )


def _names(config: Config, chosen: Mask) -> list[str]:
    return [joint.name for joint, is_chosen in zip(config.joints, chosen.tolist(), strict=True) if is_chosen]


def used_range(found: Amplitude) -> Array:
    """Fraction of its position range that each joint of the median arm uses (joints,)."""
    lowest, highest = found.prediction.median[:2]
    low, high = found.prediction.limits[:2]
    used: Array = (highest - lowest) / (high - low)
    return used


def pilot_config(config: Config, options: PilotOptions = DEFAULTS) -> Config:
    """The configuration of a pilot run: half the period if the band allows it, no held-out multisine, no waiting for
    steady state.
    """
    experiment = config.experiment
    update: dict[str, Any] = {"held_out": False, "peak_torque": None, "periods": 1, "warm_up": 0.0}
    update["max_settling_periods"] = min(experiment.max_settling_periods, options.max_pilot_settling)
    if experiment.band is not None:
        samples = round(experiment.samples * options.pilot_period_share)
        period = samples / experiment.rate
        low, high = experiment.band
        each = _LINES_FOR_DETECTION if experiment.detection else 1
        if len(harmonics_within(period, low, high)) >= each * len(config.joints):
            update |= {"period": period, "band": [max(low, 1 / period), high]}
    return config.model_copy(update={"experiment": experiment.model_copy(update=update)})


def _from_anywhere(config: Config) -> Config:
    """The configuration for an arm that friction may be holding away from its rest pose after an earlier run."""
    return config.model_copy(update={"arm": config.arm.model_copy(update={"rest_tolerance": 2 * np.pi})})


def _within_limits(config: Config, pose: Array, inside: float) -> Array:
    """Clip the pose of an arm that a stopped run may have left beyond its position limits: the next run will move it
    inwards.
    """
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return np.asarray(np.clip(pose, middle - inside * half, middle + inside * half))


def only_first(found: Amplitude, options: PilotOptions = DEFAULTS) -> Amplitude:
    """The amplitude `found`, with its plan reduced to one period of the first multisine."""
    plan = replace(
        found.plan.first_segment(), max_settling_periods=options.max_pilot_settling, periods=1, warm_up_periods=0
    )
    return Amplitude(plan, found.peak_torque, found.prediction)


def with_torque(config: Config, peak_torque: Array) -> Config:
    """The configuration with this peak torque (joints,) [N m]."""
    experiment = config.experiment.model_copy(update={"peak_torque": peak_torque.tolist()})
    return config.model_copy(update={"experiment": experiment})


def step_config(config: Config, options: PilotOptions = DEFAULTS) -> Config:
    """The configuration without the second multisine and without waiting for a steady motion."""
    settling = min(config.experiment.max_settling_periods, options.max_pilot_settling)
    update = {"held_out": False, "max_settling_periods": settling, "periods": 1, "warm_up": 0.0}
    return config.model_copy(update={"experiment": config.experiment.model_copy(update=update)})


def _is_base(name: str) -> bool:
    return name.startswith(
        ("inertia", "coupling", "armature", "gravity", "viscous", "coulomb_1", "coulomb_2", "offset")
    )


def _and(names: list[str]) -> str:
    return " and ".join(names).capitalize()
