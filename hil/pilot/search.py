"""From the first careful run to a plan at the limits: run, update the belief, and raise the torque until it is certain.

A run that moved nothing, exceeded a limit or never settled is informative too.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.amplitude import Amplitude, largest_amplitude, most_torque, with_peaks
from hil.dry_run.prediction import GUARDED, predict
from hil.dry_run.waves import designed_plan, roomy_plan, roomy_plans
from hil.errors import ExperimentError, NoSafeTorque
from hil.estimator.models.parameters import Physics
from hil.pilot.belief import MOVED_STEPS, Belief, prior_belief
from hil.pilot.gains import falls_over, with_stabiliser
from hil.pilot.steps import Played, Player, Step
from hil.plan.plan import Plan, scaled
from hil.runs.run_folder import RunFolder

Array = NDArray[np.float64]

ARMS = 96
PILOT_SHARES = (0.45, 0.6, 0.75, 0.9)
"""Fraction of the limits that successive pilots may use; the last one applies to all further pilots."""

MOST_STEPS, MOST_PILOTS = 12, 10
"""Largest number of runs before the full one, and of those in which not all joints have moved yet."""

CERTAIN = 0.85
"""Fraction of a limit that a typical arm should reach; below it, uncertainty wastes too much of the range."""

_PILOT_PERIOD_SHARE = 0.5
_PILOT_SETTLING = 1
_AFTER_LIMIT = 0.85
"""Cap on further torque, relative to the torque at which a limit was exceeded."""
_MUCH_ROOM = 0.74
"""Share of the position range used, of the joint that uses least, below which other waves are tried."""
_OTHER_WAVES = 7
"""How many at most: a wave with either sign of each joint, and all of these reversed in time."""
_FALLING_RAISE = 1.35
"""Largest ratio of torques of two runs of an arm that falls over when it is stopped."""
_FALLING_SHARE = 0.85
"""Share of the limits for an arm that falls over when it is stopped."""
_LEAST_TORQUE = 0.05
"""Torque that such an arm may get whatever it got before, as a share of what the current limit allows."""
_INSIDE = 0.95
"""Share of the limits within which an arm is assumed to start that a stopped run left beyond them."""
_MOST_RAISE = 1.6
_AT_LIMIT = 0.99
_MORE, _LITTLE_MORE, _FAIR = 1.15, 1.03, 0.7
"""Smallest torque increase that justifies another run, and the fraction of the limit from which the larger one applies.
"""


@dataclass
class Search:
    """Search state: runs so far and the current belief; both are updated from run to run."""

    config: Config
    run: RunFolder
    player: Player
    belief: Belief
    steps: list[Step] = field(default_factory=list)
    cap: Array | None = None
    """Torque (joints,) [N m] that must not be exceeded, because a limit was."""
    pose: Array | None = None
    """Last rest position of the arm (joints,) [rad]."""
    swing: Array | None = None
    """Largest range of motion of each joint so far (joints,) [rad]."""

    springs: NDArray[np.bool_] | None = None
    """Joints that a stabiliser held (joints,)."""

    @classmethod
    def of(cls, config: Config, run: RunFolder, player: Player) -> "Search":
        """Start a search from the prior. Raises ConfigError."""
        return cls(config, run, player, prior_belief(config, ARMS))

    @property
    def held(self) -> Config:
        """The configuration, with a stabiliser if the arm is believed to need one."""
        return with_stabiliser(self.config, self.belief, self.springs)

    def find(self) -> tuple[Config, Amplitude]:
        """Find the configuration and the amplitude of the full run.

        Raises what a run raises, and ExperimentError if a joint does not move at its current limit.
        """
        self._pilot()
        return self._raise_to_limits()

    def learn(self, config: Config, played: Played) -> None:
        """Update the belief with the outcome of a run of `config`."""
        self.steps.append(played.step)
        if config.stabiliser is not None:
            self.springs = np.array(config.stabiliser.stiffness) > 0.0  # a joint that had one keeps it
        if played.passed_limit:
            self.cap = _AFTER_LIMIT * played.step.peak_torque
        if played.seen is None:
            return
        self.belief = self.belief.after(config, played.seen)
        self.pose = _within_limits(self.config, played.seen.end)
        swing = played.seen.swing
        self.swing = swing if self.swing is None else np.maximum(self.swing, swing)

    @property
    def moved(self) -> NDArray[np.bool_]:
        """Which joints have moved in any run so far (joints,)."""
        step = np.array([joint.joint.servo.position_unit for joint in self.config.joints])
        swing = np.zeros(len(step)) if self.swing is None else self.swing
        return np.asarray(swing > MOVED_STEPS * step)

    def amplitude(self, config: Config, share: float, plan: Plan | None = None) -> Amplitude:
        """The largest safe amplitude for all plausible arms.

        If there is none, the amplitude of the last run is used, which the real arm has shown to be safe, or less if it
        was not. Raises NoSafeTorque if there was no run yet.
        """
        ensemble = self.belief.ensemble(self._farther)
        cap = self.cap
        if falls_over(config, self.belief):
            share *= _FALLING_SHARE
            if self.steps:
                most = np.maximum(_FALLING_RAISE * self.steps[-1].peak_torque, _LEAST_TORQUE * most_torque(config))
                cap = most if cap is None else np.minimum(cap, most)
        try:
            return largest_amplitude(config, ensemble, share, plan, self.pose, cap)
        except NoSafeTorque:
            if not self.steps:
                raise
        torque = self.steps[-1].peak_torque
        torque = torque if self.cap is None else np.minimum(torque, self.cap)
        plan = with_peaks(config, torque) if plan is None else scaled(config, plan, torque)
        return Amplitude(plan, torque, predict(config, plan, ensemble, pose=self.pose))

    @property
    def _farther(self) -> float:
        """Ratio of the allowed to the observed range of motion, for the joint with the most room."""
        allowed = np.ptp(np.array([joint.position_limit for joint in self.config.joints]), axis=1)
        swing = np.zeros(len(allowed)) if self.swing is None else self.swing
        return float((allowed / np.maximum(swing, 0.02)).max())

    def _pilot(self) -> None:
        """Play small runs until every joint moves."""
        while len(self.steps) < MOST_PILOTS:
            number = len(self.steps)
            config = pilot_config(self.held)
            found = self._pilot_amplitude(config, PILOT_SHARES[min(number, len(PILOT_SHARES) - 1)])
            self._play(config, f"pilot-{number + 1}", "Pilot" if number == 0 else f"Pilot {number + 1}", found)
            moved = self.moved
            if moved.all():
                return
            still = [joint.name for joint, moves in zip(self.config.joints, moved, strict=True) if not moves]
            if (found.peak_torque[~moved] >= _AT_LIMIT * most_torque(config)[~moved]).all():
                self._give_up(config, still)
            self.player.say(
                f"{_and(still)} did not move: friction is larger than this torque. Repeating with more torque."
            )
        moved = self.moved
        if not moved.all():
            self._give_up(config, [j.name for j, m in zip(self.config.joints, moved, strict=True) if not m])

    def _pilot_amplitude(self, config: Config, share: float) -> Amplitude:
        """The safe amplitude of a pilot; a joint that has not moved yet gets only moderately more torque than before.

        Just above static friction, motion grows quickly with torque, and a joint that stood still reveals little about
        it.
        """
        found = self.amplitude(config, share)
        if not self.steps:
            return found
        most = np.where(self.moved, np.inf, _MOST_RAISE * self.steps[-1].peak_torque)
        if (found.peak_torque <= most).all():
            return found
        plan = scaled(config, found.plan, np.minimum(found.peak_torque, most))
        torque = plan.segments[0].peak_torque
        return Amplitude(plan, torque, predict(config, plan, self.belief.ensemble(self._farther), pose=self.pose))

    def _raise_to_limits(self) -> tuple[Config, Amplitude]:
        """Play intermediate runs until the arm is known well enough to go straight to its limits."""
        config = self.held
        plan = self.waves(config)
        found = self.amplitude(config, 1.0, plan)
        while not self._certain(config, found) and len(self.steps) < MOST_STEPS:
            self.player.say(
                "The estimate is still too uncertain to go straight to the limits: adding an intermediate run."
            )
            number = len(self.steps) + 1
            self._play(step_config(config), f"step-{number}", f"Step {number}", only_first(found))
            former, config = found.peak_torque, self.held
            found = self.amplitude(config, 1.0, self.waves(config) if config.stabiliser is not None else plan)
            if (found.peak_torque <= (_MORE if self._shares(found).min() > _FAIR else _LITTLE_MORE) * former).all():
                break  # the updated belief allows hardly more torque
        return config, self._roomiest(config, found)

    def _roomiest(self, config: Config, found: Amplitude) -> Amplitude:
        """The amplitude that leaves least of the range unused, of `found` and of other waves if it leaves much.

        A little more torque may throw some of the arms over: with other waves that comes later, or to the other side.
        """
        limited = (found.peak_torque >= _AT_LIMIT * most_torque(config)).all() or self.cap is not None
        if limited or config.experiment.design == "optimal" or used_range(found).min() >= _MUCH_ROOM:
            return found
        for plan in roomy_plans(config, Physics.of(self.belief.middle), 1 + _OTHER_WAVES)[1:]:
            other = self.amplitude(config, 1.0, plan)
            found = max(found, other, key=lambda each: float(used_range(each).min()))
            if used_range(found).min() >= _MUCH_ROOM:
                break
        return found

    def _play(self, config: Config, folder: str, name: str, found: Amplitude) -> None:
        played_config = with_torque(config, found.peak_torque)
        # The first period is informative even if unsettled; the ramp out, unlike a cut, lets the arm come to rest.
        calm = Amplitude(replace(found.plan, settle_within=np.inf), found.peak_torque, found.prediction)
        played = self.play(played_config, self.run.below(folder, played_config), name, calm)
        self.learn(played_config, played)

    def play(self, config: Config, folder: RunFolder, name: str, found: Amplitude) -> Played:
        """Play one run from where the last one left the arm, checked against the plausible arms."""
        arms = self.belief.ensemble(self._farther)
        return self.player.play(config if self.pose is None else _from_anywhere(config), folder, name, found, arms)

    def waves(self, config: Config) -> Plan:
        """Waves for the full run of the arm as it is thought to be."""
        arm = Physics.of(self.belief.middle)
        if config.experiment.design == "optimal":
            return designed_plan(config, arm, [name for name in self.belief.names if _is_base(name)])
        return roomy_plan(config, arm)

    def _certain(self, config: Config, found: Amplitude) -> bool:
        shares = self._shares(found)
        full = found.peak_torque >= _AT_LIMIT * most_torque(config)
        capped = np.zeros_like(full) if self.cap is None else found.peak_torque >= _AT_LIMIT * self.cap
        enough = CERTAIN * (_FALLING_SHARE if falls_over(config, self.belief) else 1.0)
        return bool(((shares >= enough) | full | capped).all())

    @staticmethod
    def _shares(found: Amplitude) -> Array:
        """Fraction of the limit that a typical arm reaches (joints,)."""
        return np.asarray(np.median(found.prediction.shares, axis=0)[:GUARDED].max(axis=0))

    def _give_up(self, config: Config, still: list[str]) -> None:
        tried = "; ".join(
            f"{step.name} {', '.join(f'{torque:.3g}' for torque in step.peak_torque)} N m" for step in self.steps
        )
        most = ", ".join(f"{torque:.3g}" for torque in most_torque(config))
        raise ExperimentError(
            f"{_and(still)} did not move by {MOVED_STEPS} encoder steps. Tried: {tried}; the current limits allow "
            f"{most} N m. Move it by hand with torque off. If it is free, raise its current_limit or voltage_limit, "
            "check the supply, widen position_limit, lengthen experiment.period, or use a stronger servo."
        )


def used_range(found: Amplitude) -> Array:
    """Share of its position range that each joint of the median arm uses (joints,)."""
    lowest, highest = found.prediction.median[:2]
    low, high = found.prediction.limits[:2]
    used: Array = (highest - lowest) / (high - low)
    return used


def pilot_config(config: Config) -> Config:
    """A pilot's configuration: half the period if the band allows it, no held-out multisine, no waiting for steady
    state.
    """
    experiment = config.experiment
    update: dict[str, Any] = {"held_out": False, "peak_torque": None, "periods": 1}
    update["max_settling_periods"] = min(experiment.max_settling_periods, _PILOT_SETTLING)
    if experiment.band is not None:
        samples = round(experiment.samples * _PILOT_PERIOD_SHARE)
        period = samples / experiment.rate
        low, high = experiment.band
        update |= {"period": period, "band": [max(low, 1 / period), high]}
    return config.model_copy(update={"experiment": experiment.model_copy(update=update)})


def _from_anywhere(config: Config) -> Config:
    """The configuration for an arm that friction may have left away from its rest pose after an earlier run."""
    return config.model_copy(update={"arm": config.arm.model_copy(update={"rest_tolerance": 2 * np.pi})})


def _within_limits(config: Config, pose: Array) -> Array:
    """A pose beyond a limit, where a stopped run may leave the arm, moved to it: the next run begins by moving in."""
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    return np.asarray(np.clip(pose, middle - _INSIDE * half, middle + _INSIDE * half))


def only_first(found: Amplitude) -> Amplitude:
    """The same amplitude with only the first multisine."""
    plan = replace(found.plan.first_segment(), max_settling_periods=_PILOT_SETTLING, periods=1)
    return Amplitude(plan, found.peak_torque, found.prediction)


def with_torque(config: Config, peak_torque: Array) -> Config:
    """The configuration with this peak torque (joints,) [N m]."""
    experiment = config.experiment.model_copy(update={"peak_torque": peak_torque.tolist()})
    return config.model_copy(update={"experiment": experiment})


def step_config(config: Config) -> Config:
    """The configuration without the second multisine and without waiting for a steady motion."""
    settling = min(config.experiment.max_settling_periods, _PILOT_SETTLING)
    update = {"held_out": False, "max_settling_periods": settling, "periods": 1}
    return config.model_copy(update={"experiment": config.experiment.model_copy(update=update)})


def _is_base(name: str) -> bool:
    return name.startswith(
        ("inertia", "coupling", "armature", "gravity", "viscous", "coulomb_1", "coulomb_2", "offset")
    )


def _and(names: list[str]) -> str:
    return " and ".join(names).capitalize()
