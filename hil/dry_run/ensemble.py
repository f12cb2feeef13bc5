"""Plausible parameter sets of the real arm, drawn from a prior, or from an earlier result and its covariance."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.dry_run.prior import base_draws
from hil.errors import ConfigError
from hil.estimation.result import QUANTISATION_FLOOR_TICKS
from hil.estimator.arrays import Array
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import term_of
from hil.model_file import model_of, read_result
from hil.plan.chain_model import torque_constant_stds
from hil.results.result import Result

MODEL_SPREAD = 0.005
"""Relative standard deviation added to every identified parameter for model error, which the covariance omits."""

_LEAST_SHARE = 0.05  # smallest allowed fraction of a positive parameter's nominal value
_LEAST_WIDTH = 0.01  # rad/s, width of the Coulomb step: narrower steps change little and take longer to simulate
_MOST_COUPLING = 0.95  # relative to sqrt(inertia_1 inertia_2)


@dataclass(frozen=True)
class Ensemble:
    """An ensemble of possible arms.

    physics: parameters of each arm. torque_scale: ratio of actual to commanded torque (arms, joints), with the
    uncertainty of the torque constants; 1 for arms drawn from a result, whose parameters are in units of the commanded
    torque. source: "prior" or "result".
    """

    physics: tuple[Physics, ...]
    torque_scale: Array
    source: str

    @property
    def size(self) -> int:
        return len(self.physics)

    def first(self, count: int) -> "Ensemble":
        return Ensemble(self.physics[:count], self.torque_scale[:count], self.source)

    def only(self, arms: NDArray[np.intp]) -> "Ensemble":
        return Ensemble(tuple(self.physics[arm] for arm in arms), self.torque_scale[arms], self.source)


def prior_ensemble(config: Config, count: int, seed: int = 0) -> Ensemble:
    """Draw arms with the configured link lengths; `[arm.prior]` gives the other distributions. Raises ConfigError."""
    base = base_draws(config, count, seed)
    physics = tuple(Physics.of({name: float(values[arm]) for name, values in base.items()}) for arm in range(count))
    return Ensemble(physics, scale_draws(config, count, seed), "prior")


def scale_draws(config: Config, count: int, seed: int = 0) -> Array:
    """Draw ratios of true to assumed torque constants (count, joints)."""
    random = np.random.default_rng((seed, 6))
    spread = torque_constant_stds(config)
    drawn: Array = np.exp(np.sqrt(np.log1p(spread**2)) * random.standard_normal((count, len(config.joints))))
    return drawn


def earlier_result(config: Config, path: Path) -> Result:
    """Read the result of an earlier run on the same planar arm, from a run folder or result.json.

    Raises ResultError, and ConfigError if the result is for another arm.
    """
    result = read_result(path)
    if result.chain is not None:
        raise ConfigError(f"{config.path} describes a planar arm; {path} is the result of a spatial one.")
    if result.joints != len(config.joints):
        raise ConfigError(
            f"{config.path} describes {_joints(len(config.joints))}; the earlier run {path} identified "
            f"{result.joints}. Name a run of this arm."
        )
    if result.arm is not None:
        model_of(result, path)  # complete and finite
    return result


def _joints(count: int) -> str:
    return "1 joint" if count == 1 else f"{count} joints"


def result_ensemble(result: Result, count: int) -> Ensemble:
    """Draw arms from a result. Its covariance is widened by the model error that the residual indicates."""
    physics = tuple(Physics.of(each) for each in result_draws(result, count))
    return Ensemble(physics, np.ones((count, result.joints)), "result")


def result_draws(result: Result, count: int) -> list[dict[str, float]]:
    """Draw the parameters of `count` arms as in `result_ensemble`, keyed by the estimator's names [SI]."""
    names = result.covariance.names
    covariance = result.covariance.array()
    known = result.values
    value = np.array([known[name] for name in names])
    ticks = max(result.fit.residual_rms_ticks, default=QUANTISATION_FLOOR_TICKS)
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)
    # A residual above rounding indicates model error, which shifts parameters by more than their covariance suggests.
    widened = covariance * max(1.0, ticks / QUANTISATION_FLOOR_TICKS) ** 2
    extra = np.diag((MODEL_SPREAD * value) ** 2)
    random = np.random.default_rng((0, 7))
    drawn = _draws(random, value, widened + extra, count)
    return [_physical(dict(zip(names, row.tolist(), strict=True)), known) for row in drawn]


def _draws(random: np.random.Generator, mean: Array, covariance: Array, count: int) -> Array:
    """Draw (count, parameters) from a normal distribution. Parameters are scaled, since they differ by orders of
    magnitude.
    """
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlation = covariance / np.outer(scale, scale)
    size, axes = np.linalg.eigh(0.5 * (correlation + correlation.T))
    spread = axes * np.sqrt(np.maximum(size, 0.0))
    drawn: Array = mean + scale * (random.standard_normal((count, mean.size)) @ spread.T)
    return drawn


def nominal(result: Result) -> Physics:
    """Return the arm with the estimated parameters of a result."""
    return Physics.of(result.values)


def _physical(drawn: dict[str, float], known: dict[str, float]) -> dict[str, float]:
    """Clip a draw to the physically possible range."""
    for name, value in drawn.items():
        if term_of(name).range in {"positive", "floor"}:
            centre = abs(known[name])
            least = _LEAST_WIDTH if term_of(name).range == "floor" else 1e-9
            drawn[name] = max(value, _LEAST_SHARE * centre, least)
    return within_range(drawn)


def within_range(parameters: dict[str, float]) -> dict[str, float]:
    """Return the parameters with the coupling limited so that the mass matrix is positive definite."""
    if "coupling" not in parameters:
        return parameters
    most = _MOST_COUPLING * float(np.sqrt(parameters["inertia_1"] * parameters["inertia_2"]))
    return {**parameters, "coupling": min(max(parameters["coupling"], -most), most)}
