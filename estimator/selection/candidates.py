"""Evaluation of omitted model terms without fits: score tests, and the effect of the omission on the standard errors.

Near an estimate the motion is linear in small changes of any parameter. One simulation with derivatives with respect to
all of them yields the decrease in the sum of squares that each term would bring (C. R. Rao's score test, Proc.
Cambridge Phil. Soc. 44 (1948) 50) and the resulting changes in the fitted parameters. Terms that cannot be ruled out,
such as an encoder's zero or torque saturation, therefore widen the standard errors even if the motion does not reveal
them: they are "considered" (S. F. Schmidt, Advances in Control Systems 3 (1966) 293), with their typical size as the
prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.fit.covariance import autocorrelation
from hil.estimator.fit.objective import Run
from hil.estimator.fit.reparametrisation import Lever, Sizes
from hil.estimator.fit.ripple import WAVES
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.fit.stabilised_run import StabilisedRun
from hil.estimator.identify import Estimate
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import FRICTIONS, OPTIONS, Option, term_of
from hil.estimator.options import IntegrationOptions

MAX_LAG_SHARE = 0.05  # fraction of the samples over which a residual's autocorrelation is summed
INTEGRATION = IntegrationOptions()
SMOOTH: tuple[Option, ...] = ("asymmetry", "saturation", "cable", "encoder")
"""Terms whose effect vanishes smoothly at zero, so that including them adds little cost to a fit."""


@dataclass(frozen=True)
class Candidate:
    """A model with one more term than the estimate's model, and that term's score test."""

    model: Model
    part: str
    """The option or friction law that is added."""
    names: tuple[str, ...]
    """Names of the parameters that are added."""
    evidence: float
    """Decrease in the sum of squares relative to that expected by chance; significant above 1."""
    explained: float
    """Fraction of the sum of squares that the term explains."""
    values: Mapping[str, float]
    """Initial guesses of the added parameters."""


@dataclass(frozen=True)
class Linearised:
    """Quadratic approximation of the weighted sum of squares near an estimate.

    The unknowns (as in the shapes below) are the parameters, followed by the initial state.
    """

    names: tuple[str, ...]
    """Names of the parameters: those of the estimate and those of candidates."""
    value: Array
    """Point of expansion (parameters,) [SI]."""
    normal: Array
    """J'WJ (unknowns, unknowns)."""
    gradient: Array
    """J'Wr (unknowns,), where r is simulated minus measured position."""
    samples: int
    """Number of valid samples over all joints. Each joint's residual is divided by its RMS, so the sum of squares
    equals this number.
    """
    colour: float
    """Factor by which the residual's correlation raises the decrease expected by chance; 1 for white residuals."""
    precision: Array
    """Inverse prior variances of the parameters (parameters,), 0 without a prior."""
    lever: Lever | None = None
    """Prior on coupling relative to gravity_2."""

    @cached_property
    def expected(self) -> Array:
        """Contribution of the priors of all unknowns to the normal equations (unknowns, unknowns)."""
        expected = np.zeros_like(self.normal)
        count = len(self.names)
        expected[:count, :count] = np.diag(self.precision)
        if self.lever is not None:
            _, slope = self.lever.residual(self.value)
            expected[:count, :count] += np.outer(slope, slope)
        return expected

    @cached_property
    def states(self) -> list[int]:
        """Indices of the initial state among the unknowns."""
        return list(range(len(self.names), len(self.normal)))

    def places(self, names: Sequence[str]) -> list[int]:
        """Return the indices of parameters among the unknowns."""
        return [self.names.index(name) for name in names]

    def fall(self, names: Sequence[str]) -> tuple[float, Array]:
        """Return the decrease in the sum of squares if the parameters `names` are freed, and the changes in their
        values.

        The initial state is freed as well.
        """
        at = [*self.places(names), *self.states]
        normal, gradient = self.normal[np.ix_(at, at)], self.gradient[at]
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        prior = self.expected[np.ix_(at, at)] * self.colour
        inverse = linalg.pinv((normal + prior) / np.outer(scale, scale), rcond=1e-11, hermitian=True)
        step = -(inverse @ (gradient / scale)) / scale
        return float(-gradient @ step), step[: len(names)]


def linearised(
    period: SettledPeriod, estimate: Estimate, names: Sequence[str], known: Mapping[str, float]
) -> Linearised:
    """Expand the sum of squares of `period` about `estimate`, which was fitted to it.

    `names`: additional parameters. Each is expanded about its value in `known` or, if it is missing there, about the
    value at which it has no effect.
    """
    used = without_spikes(period)
    added = [name for name in names if name not in estimate.names]
    every = (*estimate.names, *added)
    values = {name: known.get(name, term_of(name).absent) for name in added} | estimate.parameters
    physics = Physics.of({**known, **values})
    run = simulated_run(used)
    rms = np.sqrt(np.nanmean(estimate.residual**2, axis=1))[:, None]
    weight = np.where(np.isfinite(estimate.residual), 1.0 / np.maximum(rms, 1e-300), 0.0)
    unknowns = len(every) + 2 * period.joints
    normal, gradient = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
    for part, position, derivative in run.pieces(physics, estimate.start, every):
        J = (derivative * weight[:, part, None]).reshape(-1, unknowns)
        normal += J.T @ J
        gradient += J.T @ (weight[:, part] * (position - run.measured[:, part])).reshape(-1)
    sizes = _sizes(period, estimate)
    spread = np.array(
        [np.inf if term_of(name).spread is None else sizes.of(term_of(name).spread or 1.0) for name in every]
    )
    return Linearised(
        every,
        np.array([values[name] for name in every]),
        normal,
        gradient,
        int(np.isfinite(estimate.residual).sum()),
        colour(estimate.residual * weight),
        1.0 / spread**2,
        Lever.of(estimate.model, estimate.parameters.get("gravity_2", 0.0), sizes),
    )


def candidates(period: SettledPeriod, estimate: Estimate, known: Mapping[str, float]) -> list[Candidate]:
    """Return the terms that could be added to the estimate's model, most significant first.

    `known`: the periods of ripple and cogging (`hil.estimator.selection.waves`), by parameter name; ripple or cogging
    without a given period is not considered.
    """
    model = estimate.model
    richer = richer_models(model)
    for wave in WAVES:
        if f"{wave}_cycles_1" not in known:
            richer.pop(wave, None)
    new = {part: tuple(n for n in more.names if n not in model.names) for part, more in richer.items()}
    about = linearised(period, estimate, [n for names in new.values() for n in names], known)
    return ranked(about, estimate.names, richer, known)


def ranked(
    about: Linearised, fitted: Sequence[str], richer: Mapping[str, Model], known: Mapping[str, float]
) -> list[Candidate]:
    """Return the score tests of the models in `richer`, whose keys name the part that each model adds to `fitted`."""
    new = {part: tuple(n for n in more.names if n not in fitted) for part, more in richer.items()}
    base, _ = about.fall(fitted)
    found = []
    for part, more in richer.items():
        fall, step = about.fall((*fitted, *new[part]))
        free = sum("cycles" not in name for name in new[part])
        chance = about.colour * free * np.log(max(about.samples / about.colour, 3.0))
        moved = dict(zip(new[part], step[len(fitted) :].tolist(), strict=True))
        found.append(
            Candidate(
                more,
                part,
                new[part],
                max(0.0, fall - base) / chance,
                max(0.0, fall - base) / about.samples,
                {name: _started(name, change, known) for name, change in moved.items()},
            )
        )
    return sorted(found, key=lambda each: -each.evidence)


def considered(period: SettledPeriod, estimate: Estimate) -> Array:
    """Return the estimate's covariance (parameters, parameters) [SI], including the effect of omitted terms that cannot
    be ruled out.

    A fit of these terms, with their prior, would change the parameters; these changes count as errors too.
    """
    left_out = unruled(estimate.model)
    if not left_out:
        return estimate.covariance
    return widened(linearised(period, estimate, left_out, {}), estimate.names, estimate.covariance, left_out)


def unruled(model: Model) -> list[str]:
    """Return the parameters that the model lacks and whose typical size is known."""
    absent = [option for option in OPTIONS if option not in model.options and _may_be(option, model)]
    left_out = [name for name in model.having(*absent).names if name not in model.names] if absent else []
    return [name for name in left_out if term_of(name).spread is not None]


def widened(about: Linearised, names: Sequence[str], covariance: Array, left_out: Sequence[str]) -> Array:
    """Return the covariance of the fitted parameters `names`, including the effect of the uncertain parameters
    `left_out`.
    """
    fitted = [*about.places(names), *about.states]
    extra = about.places(left_out)
    scale = np.sqrt(np.maximum(np.diag(about.normal), 1e-300))
    normal, gradient = about.normal / np.outer(scale, scale), about.gradient / scale
    own = normal[np.ix_(fitted, fitted)]
    across = normal[np.ix_(fitted, extra)]
    prior = about.precision[extra] / scale[extra] ** 2
    expected = about.expected[np.ix_(fitted, fitted)] / np.outer(scale[fitted], scale[fitted]) * about.colour
    inverse = linalg.pinv(own + expected, rcond=1e-11, hermitian=True)
    follow = -inverse @ across
    told = (normal[np.ix_(extra, extra)] + across.T @ follow) / about.colour
    open_ = linalg.inv(0.5 * (told + told.T) + np.diag(prior) + 1e-12 * np.eye(len(extra)))
    moved = -open_ @ (gradient[extra] + follow.T @ gradient[fitted]) / about.colour
    count = len(names)
    wider = follow[:count] / scale[:count, None]
    more = wider @ (open_ + np.outer(moved, moved)) @ wider.T
    seen = np.isfinite(np.diag(covariance))
    return np.asarray(covariance + np.where(np.outer(seen, seen), more, 0.0))


def simulated_run(period: SettledPeriod) -> Run:
    """Return the simulation of a period with the integration steps of final fits."""
    if period.stabiliser is None:
        return SimulatedRun.of(period, INTEGRATION)
    return StabilisedRun.of(period, period.stabiliser, INTEGRATION)


def colour(residual: Array) -> float:
    """Return the integrated autocorrelation of a residual (joints, samples) for the worst joint; 1 for white noise.

    Missing samples count as 0.
    """
    worst = 1.0
    for row in np.nan_to_num(residual):
        rho = autocorrelation(row, max(2, int(MAX_LAG_SHARE * row.size)))
        below = np.flatnonzero(rho[1:] < 2.0 / np.sqrt(row.size))
        last = int(below[0]) + 1 if below.size else rho.size
        worst = max(worst, 1.0 + 2.0 * float(rho[1:last].sum()))
    return worst


def richer_models(model: Model) -> dict[str, Model]:
    """Return the models with one more option or the next friction law, keyed by the part that is added.

    Presliding is left out, since the motion is not linear in its parameters.
    """
    absent = [option for option in OPTIONS if option not in model.options and _may_be(option, model)]
    richer: dict[str, Model] = {option: model.having(option) for option in absent if option != "presliding"}
    higher = FRICTIONS[FRICTIONS.index(model.friction) + 1 :][:1]
    return richer | {law: replace(model, friction=law) for law in higher}


def _may_be(option: str, model: Model) -> bool:
    return option not in ("torque_scale", "lags") or model.joints == 2


def _started(name: str, change: float, known: Mapping[str, float]) -> float:
    term = term_of(name)
    if "cycles" in name:
        return known.get(name, term.initial)
    if term.range == "positive":
        return max(0.1 * term.initial, min(term.absent + change, 3.0 * term.initial)) if term.initial else change
    return term.absent + change


def _sizes(period: SettledPeriod, estimate: Estimate) -> Sizes:
    velocity = np.diff(estimate.position, axis=1) * period.rate
    return Sizes(
        float(np.sqrt(np.mean(period.torque**2))),
        float(np.sqrt(np.mean(velocity**2))),
        abs(estimate.parameters["inertia_1"]),
    )


def by_parameters(period: SettledPeriod, estimate: Estimate) -> Array:
    """Return the derivatives of positions with respect to all unknowns (joints, samples, unknowns), divided by the
    residual's RMS.

    The unknowns are the estimate's parameters, followed by the initial state, as in `Linearised`.
    """
    used = without_spikes(period)
    rms = np.sqrt(np.nanmean(estimate.residual**2, axis=1))[:, None]
    weight = np.where(np.isfinite(estimate.residual), 1.0 / np.maximum(rms, 1e-300), 0.0)
    columns, _ = columns_of(
        simulated_run(used), Physics.of(estimate.parameters), estimate.start, tuple(estimate.names), weight
    )
    return columns.reshape(period.joints, -1, columns.shape[1])


def columns_of(run: Run, physics: Physics, start: Array, names: tuple[str, ...], weight: Array) -> tuple[Array, Array]:
    """Return weighted derivatives (joints * samples, unknowns) and simulated positions (joints, samples) [rad]."""
    pieces = list(run.pieces(physics, start, names))
    derivative = np.concatenate([each for _, _, each in pieces], axis=1) * weight[:, :, None]
    position = np.concatenate([each for _, each, _ in pieces], axis=1)
    return derivative.reshape(-1, derivative.shape[2]), position
