"""The current belief about the arm: an ensemble drawn from the prior and updated with measured motion.

Each recorded motion is assimilated by an ensemble smoother with multiple data assimilation (Emerick and Reynolds,
Computers and Geosciences 55 (2013) 3). Every arm of the ensemble is given the real arm's commands, and is then updated
towards the measured motion by regressing parameters on motion over the ensemble. Parameters that a motion does not
determine keep the prior's spread. A joint that did not move is informative too: arms that would have moved are shifted
towards more friction.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.ensemble import Ensemble, result_draws, scale_draws, within_range
from hil.dry_run.prior import base_draws
from hil.estimator.arrays import Array, Mask
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import term_of
from hil.estimator.simulation.many_arms import ManyArms
from hil.pilot.seen import Seen
from hil.plan.stabiliser import feedback_of
from hil.results.result import Result

_FRICTION = ("viscous", "coulomb", "stribeck_rise")
_FRICTION_CHANGE = 0.1  # relative standard deviation of friction from day to day

_LINEAR = ("offset", "zero")
"""Parameters that may have either sign, and are therefore not represented by their logarithms."""

_TIMES = 160
"""Number of instants at which the measured and the simulated motion of a joint are compared."""
_LINEAR_RANGE = 0.02  # rad; larger displacements are compared by their logarithms, smaller ones linearly
_ERROR = 0.08
"""Assumed model error of a simulated displacement, relative to that displacement."""
_LEAST_ERROR_STEPS = 1.5
MOVED_STEPS = 26
"""Smallest range of motion for which a joint counts as having moved [encoder steps]."""
_STILL = 0.02  # rad, allowed range of motion of a simulated joint if the real one stood still
_MOST_RAISES, _RAISE = 12, (0.05, 0.25)
"""If a simulated joint moves although the real one stood still, the logarithm of its friction is increased, at most
`_MOST_RAISES` times, by a random amount from the range `_RAISE`.
"""

_INFLATIONS = (12.0, 6.0, 4.0, 2.0)
"""Factors by which successive updates multiply the variance of the measurement errors. Their reciprocals add up to 1,
so that each measurement counts once.
"""
_LONGEST_MOVE = 1.0  # largest change of a parameter per update, in e-folds or prior standard deviations
_HOPELESS = 3.0  # multiple of the median misfit above which an arm is replaced
_LEAST_SPREAD = 0.01  # relative model error, per doubling of the range of motion


@dataclass(frozen=True)
class Belief:
    """Arms that could be the real one.

    coordinates (arms, parameters): logarithms of positive parameters; parameters that may have either sign are instead
    divided by `scale`.
    scale: standard deviation in the prior (parameters,). fixed: parameters that do not vary. learned: number of
    updates.
    """

    names: tuple[str, ...]
    coordinates: Array
    scale: Array
    fixed: dict[str, float]
    learned: int = 0
    seed: int = 0

    @property
    def parameters(self) -> list[dict[str, float]]:
        """Parameters of every arm, keyed by the estimator's names [SI], assuming the first joint's nominal torque
        constant.
        """
        return [
            within_range({**self.fixed, **dict(zip(self.names, values.tolist(), strict=True))})
            for values in self._values(self.coordinates)
        ]

    @property
    def middle(self) -> dict[str, float]:
        """Parameters of the median arm."""
        values = self._values(np.median(self.coordinates, axis=0)[None])[0]
        return within_range({**self.fixed, **dict(zip(self.names, values.tolist(), strict=True))})

    def spread(self, name: str) -> float:
        """Standard deviation of a parameter's logarithm."""
        return float(self.coordinates[:, self.names.index(name)].std())

    def ensemble(self, farther: float = 1.0) -> Ensemble:
        """Return the ensemble for a dry run. farther: range of motion to simulate, relative to the observed range."""
        belief = self if not self.learned else self._widened(_LEAST_SPREAD * (1.0 + np.log2(max(1.0, farther))))
        parameters = belief.parameters
        joints = 2 if "torque_scale_2" in parameters[0] else 1
        scale = np.array([[1.0, each.pop("torque_scale_2", 1.0)][:joints] for each in parameters])
        physics = tuple(Physics.of(each) for each in parameters)
        return Ensemble(physics, scale, "belief" if self.learned else "prior")

    def after(self, config: Config, seen: Seen) -> "Belief":
        """The belief after an update with the recorded motion `seen`."""
        step = np.array([joint.joint.servo.position_unit for joint in config.joints])
        moved = seen.swing > MOVED_STEPS * step
        random = np.random.default_rng((self.seed, 8, self.learned))
        belief = self._held(config, seen, ~moved, random)
        if moved.any():
            belief = belief._drawn_to(config, seen, moved, random)._held(config, seen, ~moved, random)
        return replace(belief, learned=self.learned + 1)

    def _held(self, config: Config, seen: Seen, still: Mask, random: np.random.Generator) -> "Belief":
        """Raise the dry friction of arms whose joints move although the real ones stood `still` (joints,)."""
        belief = self
        places = [self.names.index(f"coulomb_{joint + 1}") for joint in np.flatnonzero(still)]
        count = len(self.coordinates)
        moving = np.arange(count)
        for _ in range(_MOST_RAISES if places else 0):
            moves = np.zeros((count, len(places)), dtype=np.bool_)
            moves[moving] = np.ptp(belief._motions(config, seen, moving)[:, still], axis=2) > _STILL
            moving = np.flatnonzero(moves.any(axis=1))
            if not moving.size:
                break
            x = belief.coordinates.copy()
            x[:, places] += np.where(moves, random.uniform(*_RAISE, moves.shape), 0.0)
            belief = replace(belief, coordinates=x)
        return belief

    def _drawn_to(self, config: Config, seen: Seen, moved: Mask, random: np.random.Generator) -> "Belief":
        """Apply the smoother to the motion of the joints selected by `moved` (joints,)."""
        index = np.unique(np.linspace(0, seen.command.shape[1] - 1, _TIMES).astype(int))
        index = index[np.isfinite(seen.position[:, index]).all(axis=0)]
        step = np.array([joint.joint.servo.position_unit for joint in config.joints])
        error = np.hypot(_ERROR * _compressed(seen.swing), _LEAST_ERROR_STEPS * step / _LINEAR_RANGE)[moved, None]
        measured = (_compressed(seen.position[:, index] - seen.pose[:, None])[moved] / error).reshape(-1)

        def foreseen(belief: Belief) -> Array:
            displaced = (belief._motions(config, seen)[:, :, index] - seen.pose[:, None])[:, moved]
            return np.nan_to_num(_compressed(np.clip(displaced, -10.0, 10.0)) / error).reshape(len(displaced), -1)

        belief = self
        for inflation in _INFLATIONS:
            belief = belief._moved(foreseen(belief), measured, inflation, random)
        left = np.mean((foreseen(belief) - measured) ** 2, axis=1)
        return belief._without_strays(left, random)

    def _motions(self, config: Config, seen: Seen, arms: NDArray[np.int64] | None = None) -> Array:
        """Motion (arms, joints, samples) [rad] of the arms with the given indices (default: all) under the recorded
        commands.
        """
        coordinates = self.coordinates if arms is None else self.coordinates[arms]
        ensemble = replace(self, learned=0, coordinates=coordinates).ensemble()
        poses = np.tile(seen.pose, (ensemble.size, 1))
        many = ManyArms(ensemble.physics, ensemble.torque_scale, poses, feedback_of(config))
        return many.positions(seen.command, config.experiment.rate)

    def _moved(self, foreseen: Array, measured: Array, inflation: float, random: np.random.Generator) -> "Belief":
        """One smoother update with measurement errors scaled by sqrt(inflation)."""
        x = self.coordinates
        parts, data = x - x.mean(axis=0), foreseen - foreseen.mean(axis=0)
        goal = measured + np.sqrt(inflation) * random.standard_normal(foreseen.shape)
        # P'D (D'D + c I)^-1 = P' (DD' + c I)^-1 D: there are fewer arms than data.
        regularised = data @ data.T + inflation * (len(x) - 1) * np.eye(len(x))
        change = (goal - foreseen) @ data.T @ np.linalg.solve(regularised, parts)
        change = np.clip(change, -_LONGEST_MOVE, _LONGEST_MOVE)
        return replace(self, coordinates=x + change)

    def _without_strays(self, left: Array, random: np.random.Generator) -> "Belief":
        """Replace arms that fit far worse than the rest with slightly perturbed copies of others."""
        strays = left > _HOPELESS * np.median(left) + 1.0
        if not strays.any() or strays.all():
            return self
        x = self.coordinates.copy()
        kept = x[~strays]
        chosen = kept[random.integers(len(kept), size=int(strays.sum()))]
        x[strays] = chosen + 0.3 * kept.std(axis=0) * random.standard_normal(chosen.shape)
        return replace(self, coordinates=x)

    def _widened(self, spread: float) -> "Belief":
        random = np.random.default_rng((self.seed, 9, self.learned))
        return replace(self, coordinates=self.coordinates + spread * random.standard_normal(self.coordinates.shape))

    def _values(self, coordinates: Array) -> Array:
        linear = np.array([name.startswith(_LINEAR) for name in self.names])
        return np.where(linear, coordinates * self.scale, np.exp(np.clip(coordinates, -40.0, 40.0)))


def prior_belief(config: Config, arms: int, seed: int = 0) -> Belief:
    """Draw the prior belief from link lengths and `[arm.prior]`. Raises ConfigError."""
    base, scale = base_draws(config, arms, seed), scale_draws(config, arms, seed)
    supposed = {name: v / scale[:, 0] if term_of(name).of_torque else v for name, v in base.items()}
    if scale.shape[1] == 2:
        supposed["torque_scale_2"] = scale[:, 1] / scale[:, 0]
    return _of_draws(supposed, seed)


def earlier_belief(config: Config, result: Result, arms: int) -> Belief:
    """Draw the belief from the result of an earlier run on the same arm. Raises ConfigError.

    Terms that the result's model lacks are left out. Friction is drawn with a wider spread than its error bars
    indicate, since it varies with temperature.
    """
    prior = prior_belief(config, arms)
    random = np.random.default_rng((0, 10))
    drawn = result_draws(result, arms)
    supposed = dict(prior.fixed)
    draws: dict[str, Array] = {}
    for name in prior.names:
        values = np.array([each.get(name, term_of(name).absent) for each in drawn])
        if name.startswith(_FRICTION):
            values = values * np.exp(_FRICTION_CHANGE * random.standard_normal(arms))
        if np.ptp(values) == 0.0 or (not name.startswith(_LINEAR) and values.min() <= 0.0):
            supposed[name] = result.values.get(name, term_of(name).absent)
        else:
            draws[name] = values
    belief = _of_draws(draws, 0)
    return replace(belief, fixed=supposed | belief.fixed, learned=1)


def _of_draws(draws: dict[str, Array], seed: int) -> Belief:
    fixed = {name: float(values[0]) for name, values in draws.items() if np.ptp(values) == 0.0}
    names = tuple(name for name in draws if name not in fixed)
    scale = np.array([draws[name].std() for name in names])
    columns = [draws[name] / draws[name].std() if name.startswith(_LINEAR) else np.log(draws[name]) for name in names]
    return Belief(names, np.stack(columns, axis=1), scale, fixed, seed=seed)


def _compressed(displacement: Array) -> Array:
    """Compress displacements: linear near zero, logarithmic far from it, so that large ones are compared by their
    ratio.
    """
    return np.asarray(np.arcsinh(displacement / _LINEAR_RANGE))
