"""Objective of stage 2 for a chain: squared one-step-ahead position prediction errors, plus the prior.

An observer keeps the simulation close to the measured angles, even for an arm that is unstable without feedback: each
position is predicted from past measurements and the model (the prediction error method; Ljung, System Identification,
2nd ed. 1999, chapter 7). Its gains are chosen by the estimator, regardless of the feedback the robot had. Stiff gains
follow any motion but carry little information; soft gains carry nearly as much as an open-loop simulation.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import LONGEST, ChainCoordinates
from hil.estimator.chain.model.chain_model import ADDED_MASS, ChainModel
from hil.estimator.chain.model.late_torque import as_moving, complete, lags_of
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation, pieces
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.covariance import Scatter
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic, minimise
from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.options import MinimiserOptions
from hil.estimator.simulation.drive import torque_and_slopes

MINIMISER = MinimiserOptions()
MOST_KEPT = 1 << 26  # bytes of derivatives


@dataclass
class _Latest:
    """The latest simulation with derivatives, kept because the covariance needs the one at the minimum again."""

    x: Array | None = None
    parts: dict[int, list[tuple[slice, Array, Array]]] = field(default_factory=dict)
    """Samples, residuals and derivatives of each period that was simulated to its end."""
    size: int = 0


@dataclass(frozen=True)
class ChainProblem:
    """Residuals of several periods under one model.

    The coordinates are those of the parameters, followed by each period's initial state.
    """

    periods: tuple[SettledPeriod, ...]
    model: ChainModel
    coordinates: ChainCoordinates
    prior: Prior
    state_scale: Array
    """Scale of the initial state (2 joints,) [rad, rad/s]."""
    weights: tuple[Array, ...]
    """Inverse standard deviation of each sample (samples, joints) [1/rad] for each period; 0 for missing samples."""
    steps: int
    """Integration steps per sample."""
    softness: float
    """Natural frequency of the observer [Hz]."""
    finer: int = 1
    """Number of smaller integration steps that replace one where a joint may be near standstill."""
    every: int = 1
    """Only every `every`-th sample is compared, with integration steps longer by that factor; above 1 only if `steps`
    is 1.
    """
    reach: float = 1.0
    """Fraction of their maximum change per step that friction-shape parameters may use; less near the minimum."""
    prior_weight: float = 1.0
    """Factor on the prior's precision: above 1 while model errors exceed the noise that the weights assume, so that the
    prior still decides what the data do not determine."""
    added: tuple[Array | None, ...] = ()
    """Known base parameters of what was added to the arm in each period (base parameters,) [SI]; None for nothing."""
    _latest: _Latest = field(init=False, repr=False, compare=False, default_factory=_Latest)

    @property
    def count(self) -> int:
        """Number of parameters."""
        return len(self.coordinates.names)

    def parameters(self, x: Array) -> dict[str, float]:
        """Return the parameters by name [SI]."""
        return dict(zip(self.coordinates.names, self.coordinates.values(x[: self.count]).tolist(), strict=True))

    def start(self, x: Array, period: int) -> Array:
        """Return the state at the first sample of a period (2, joints) [rad, rad/s]."""
        size = self.state_scale.size
        first = self.count + period * size
        return (x[first : first + size] * self.state_scale).reshape(2, -1)

    def run_of(self, period: SettledPeriod, parameters: dict[str, float]) -> ChainRun:
        """Return the simulation's input for a period, with the delay and lag of these parameters."""
        torque, slopes = torque_and_slopes(
            *(period.torque, period.rate, period.command_to_sample, self.steps),
            delay=parameters.get("delay", 0.0),
            lag=lags_of(parameters, self.model.joints),
        )
        return ChainRun(
            self._thinned(np.moveaxis(torque, 0, 2)),
            self._thinned(np.transpose(slopes, (2, 3, 0, 1))),
            np.ascontiguousarray(period.position.T[:: self.every][: period.samples // self.every]),
            self.every / (period.rate * self.steps),
            self.finer,
        )

    def _thinned(self, of_steps: Array) -> Array:
        """Average values per step (samples, steps, ...) over groups of `every` samples."""
        if self.every > 1:
            whole = of_steps[: len(of_steps) // self.every * self.every]
            of_steps = whole.reshape(-1, self.every, *of_steps.shape[1:]).mean(axis=1)
        return np.ascontiguousarray(of_steps)

    def gain(self, period: SettledPeriod) -> Array:
        """Return the gains of the critically damped observer (2, joints) [1, 1/s] per sample."""
        turn = 2.0 * np.pi * self.softness
        gains = np.array([2.0 * turn, turn * turn]) * self.every / period.rate
        return np.repeat(gains[:, None], period.joints, axis=1)

    def evaluate(self, x: Array) -> Quadratic:
        """Return the sum of squares at `x` with its normal equations."""
        parameters = self.parameters(x)
        normal, gradient = np.zeros((x.size, x.size)), np.zeros(x.size)
        if not all(map(np.isfinite, parameters.values())):
            return Quadratic(np.inf, normal, gradient)
        cost = self._add_prior(x, normal, gradient)
        for index, (period, weight) in enumerate(zip(self.periods, self.weights, strict=True)):
            where, slopes = self._where(x, index)
            J_J, J_r = np.zeros((slopes.size, slopes.size)), np.zeros(slopes.size)
            for part, r, J in self._pieces(x, index, period, parameters):
                if r is None:
                    return Quadratic(np.inf, normal, gradient)
                square = np.square(weight[:: self.every][part]).reshape(-1)
                found = normal_equations(J.reshape(-1, slopes.size), r.reshape(-1), square)
                with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges has an infinite sum
                    J_J, J_r = J_J + found[0], J_r + found[1]
                    cost += float(square @ r.reshape(-1) ** 2)
            with np.errstate(over="ignore", invalid="ignore"):
                normal[np.ix_(where, where)] += J_J * np.outer(slopes, slopes)
                gradient[where] += J_r * slopes
        if not (np.isfinite(cost) and np.all(np.isfinite(normal))):
            return Quadratic(np.inf, np.zeros_like(normal), np.zeros_like(gradient))
        return Quadratic(cost, normal, gradient)

    def minimise(
        self,
        x: Array,
        ftol: float,
        damping: float | None = None,
        options: MinimiserOptions = MINIMISER,
        at: Quadratic | None = None,
    ) -> Minimum:
        """Minimise the sum of squares from `x` until its relative decrease is less than `ftol`.

        at: the sum of squares at `x`, if known.
        """

        def limits(point: Array) -> tuple[Array, Array]:
            least, most = np.full(point.size, -LONGEST), np.full(point.size, LONGEST)
            self.coordinates.limit(point[: self.count], self.reach, least, most)
            return least, most

        return minimise(
            self.evaluate, x, ftol, damping, at, move=self.coordinates.moved, limits=limits, options=options
        )

    def prior_cost(self, x: Array) -> float:
        """Return the prior's part of the sum of squares at `x`."""
        return self._add_prior(x, np.zeros((x.size, x.size)), np.zeros(x.size))

    def cost(self, x: Array) -> float:
        """Return the sum of squares at `x` alone; infinite if the motion diverges."""
        total = self.prior_cost(x)
        for (run, position), weight in zip(self._motions(x), self.weights, strict=True):
            if position is None:
                return np.inf
            total += float(np.nansum(np.square(weight[:: self.every][: len(position)] * (position - run.measured))))
        return total

    def positions(self, x: Array) -> tuple[Array, ...] | None:
        """Return the predicted positions of each period (joints, samples) [rad]; None if a motion diverges."""
        found = []
        for _, position in self._motions(x):
            if position is None:
                return None
            found.append(position.T)
        return tuple(found)

    def _motions(self, x: Array) -> Iterator[tuple[ChainRun, Array | None]]:
        """Yield each period's run and its simulated positions (samples, joints) [rad], or None if the simulation
        diverges.
        """
        parameters = self.parameters(x)
        for index, period in enumerate(self.periods):
            run = self.run_of(period, parameters)
            moved = self._of_period(index, parameters)
            simulation = Simulation(self.model.base, moved, self.start(x, index), self.gain(period))
            yield run, simulation.go_on(run, slice(0, len(run.measured)))[0]

    def scatter(self, x: Array, lags: int) -> Array:
        """Return the sum of products of the scores, in coordinates; see `hil.estimator.fit.covariance`."""
        total = np.zeros((x.size, x.size))
        parameters = self.parameters(x)
        for index, (period, weight) in enumerate(zip(self.periods, self.weights, strict=True)):
            where, slopes = self._where(x, index)
            scatter = Scatter(slopes.size, lags)
            for part, r, J in self._pieces(x, index, period, parameters):
                assert r is not None  # the minimum's motion is finite
                scatter.add(np.einsum("sj,sjc->sc", weight[part] ** 2 * r, J))
            total[np.ix_(where, where)] += scatter.sum() * np.outer(slopes, slopes)
        return total

    def weighted(self, x: Array, index: int, most: int) -> Iterator[tuple[Array, Array]]:
        """Yield each joint's weighted residual (samples,) in a period and its Jacobian (samples, coordinates).

        Only the first `most` samples are used, rounded up to whole pieces.
        """
        period, weight = self.periods[index], self.weights[index]
        where, slopes = self._where(x, index)
        residuals, jacobians = [], []
        for part, r, J in self._pieces(x, index, period, self.parameters(x)):
            assert r is not None  # the minimum's motion is finite
            residuals.append(weight[part] * r)
            jacobians.append(weight[part][:, :, None] * J * slopes)
            if part.stop >= most:
                break
        residual, jacobian = np.concatenate(residuals), np.concatenate(jacobians)
        for joint in range(period.joints):
            every = np.zeros((len(residual), x.size))
            every[:, where] = jacobian[:, joint]
            yield residual[:, joint], every

    def _pieces(
        self, x: Array, index: int, period: SettledPeriod, parameters: dict[str, float]
    ) -> Iterator[tuple[slice, Array | None, Array]]:
        """Yield the samples, residuals and derivatives of a period, piece by piece.

        The residuals, predicted minus measured (samples, joints) [rad], are 0 where a sample is missing, and None if
        the motion diverges. The derivatives are with respect to parameters and initial state.
        """
        latest = self._latest
        if latest.x is None or not np.array_equal(latest.x, x):
            latest.x, latest.parts, latest.size = x.copy(), {}, 0
        if index in latest.parts:
            yield from latest.parts[index]
            return
        run = self.run_of(period, parameters)
        names = self.coordinates.names
        moved, added = self._of_period(index, parameters), self._added(index)
        simulation = Simulation(self.model.base, moved, self.start(x, index), self.gain(period), names)
        kept = []
        for part in pieces(len(run.measured)):
            position, derivative = simulation.go_on(run, part)
            if position is None:  # the derivatives are not finite either
                yield part, None, derivative
                return
            complete(self.model.base, parameters, names, derivative)
            if added is not None:
                derivative[:, :, names.index(ADDED_MASS)] = derivative[:, :, : added.size] @ added
            r = np.where(np.isnan(run.measured[part]), 0.0, position - run.measured[part])
            yield part, r, derivative
            latest.size += derivative.nbytes
            if latest.size < MOST_KEPT:
                kept.append((part, r, derivative))
        if latest.size < MOST_KEPT:
            latest.parts[index] = kept

    def _added(self, index: int) -> Array | None:
        return self.added[index] if self.added else None

    def _of_period(self, index: int, parameters: dict[str, float]) -> dict[str, float]:
        """Return the parameters of the equivalent arm (`as_moving`) in a period, with what had been added to it."""
        parameters, added = as_moving(self.model.base, parameters), self._added(index)
        if added is None:
            return parameters
        names, scale = self.model.base.names, parameters[ADDED_MASS]
        return parameters | {name: parameters[name] + scale * float(x) for name, x in zip(names, added, strict=True)}

    def _where(self, x: Array, index: int) -> tuple[list[int], Array]:
        """Return the coordinates on which a period's motion depends, and the derivatives of parameters and state with
        respect to them.
        """
        size = self.state_scale.size
        first = self.count + index * size
        where = [*range(self.count), *range(first, first + size)]
        return where, np.concatenate((self.coordinates.slopes(x[: self.count]), self.state_scale))

    def _add_prior(self, x: Array, normal: Array, gradient: Array) -> float:
        """Add the prior's contribution to `normal` and `gradient` in place; return its sum of squares."""
        base, count, factor = self.model.base.count, self.count, self.prior_weight
        value, slope = self.coordinates.values(x[:count]), self.coordinates.slopes(x[:count])
        at = np.arange(base)
        miss, by = (value[:base] - self.prior.value) / self.prior.std, slope[:base] / self.prior.std
        normal[at, at] += factor * by * by
        gradient[at] += factor * by * miss
        shapes, likely, spread = self.coordinates.likely
        away = (x[shapes] - likely) / spread
        normal[shapes, shapes] += factor / spread**2
        gradient[shapes] += factor * away / spread
        cost = float(miss @ miss) + float(away @ away)
        precision, scales = self.prior.scale_precision, self.coordinates.torque_scales
        if precision is not None and scales.size:
            normal[np.ix_(scales, scales)] += factor * precision
            gradient[scales] += factor * precision @ x[scales]  # the coordinates are logarithms
            cost += float(x[scales] @ precision @ x[scales])
        return factor * cost
