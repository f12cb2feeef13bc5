"""Objective of stage 2 for a chain: squared one-step-ahead position prediction errors, plus the prior.

An observer keeps the simulation close to the measured angles, even for an arm that is unstable without feedback: each
position is predicted from past measurements and the model (the prediction error method; Ljung, System Identification,
2nd ed. 1999, chapter 7). A stiff observer follows any motion but yields little information; a soft one yields nearly as
much as an open-loop simulation.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.fit.coordinates import LONGEST, ChainCoordinates
from hil.estimator.chain.model.chain_model import ADDED_MASS, ChainModel
from hil.estimator.chain.model.late_torque import as_moving, complete, lags_of, losses
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation, pieces
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.covariance import Scatter
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic, minimise
from hil.estimator.fit.normal_equations import Products
from hil.estimator.options import MinimiserOptions
from hil.estimator.simulation.drive import torque_and_slopes

MINIMISER = MinimiserOptions()
MOST_KEPT = 1 << 26  # maximum size of the stored derivatives [bytes]


@dataclass
class _Latest:
    """The latest simulation with derivatives.

    It is shared by problems that differ only in weights or prior, and reused for the covariance at the minimum.
    """

    x: Array | None = None
    objects: tuple[object, ...] = ()
    settings: tuple[float, ...] = ()
    """Other settings on which the simulation depends."""
    parts: dict[int, list[tuple[slice, Array, Array]]] = field(default_factory=dict)
    """Samples, angles and derivatives of each period that was simulated to the end."""
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
    """Number of smaller steps into which an integration step is divided if a joint may be near standstill during it."""
    every: int = 1
    """Only every `every`-th sample is compared, and integration steps are longer by this factor, which may exceed 1
    only if `steps` is 1.
    """
    reach: float = 1.0
    """Fraction of the maximum change per step that friction-shape parameters may use; smaller near the minimum."""
    prior_weight: float = 1.0
    """Factor on the prior's precision. It exceeds 1 while model errors exceed the noise that the weights assume, so
    that the prior still decides what the data do not determine.
    """
    added: tuple[Array | None, ...] = ()
    """Change in the base parameters due to the known mass in each period (base parameters,) [SI]; None without a mass.
    """
    latest: _Latest = field(repr=False, compare=False, default_factory=_Latest)

    @property
    def count(self) -> int:
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
        """Return the simulation's input for a period, with the delay and lag taken from `parameters`."""
        torque, slopes = torque_and_slopes(
            *(period.torque, period.rate, period.command_to_sample, self.steps),
            delay=parameters.get("delay", 0.0),
            lag=lags_of(parameters, self.model.joints),
        )
        return ChainRun(
            self._thinned(np.moveaxis(torque, 0, 2)),
            self._thinned(np.transpose(slopes, (2, 3, 0, 1))),
            self._measured(period),
            self.every / (period.rate * self.steps),
            self.finer,
        )

    def _measured(self, period: SettledPeriod) -> Array:
        """Return the measured angles that are compared with the simulation (samples, joints) [rad]."""
        return np.ascontiguousarray(period.position.T[:: self.every][: period.samples // self.every])

    def _thinned(self, of_steps: Array) -> Array:
        """Average the values for each step (samples, steps, ...) over groups of `every` samples."""
        if self.every > 1:
            whole = of_steps[: len(of_steps) // self.every * self.every]
            of_steps = whole.reshape(-1, self.every, *of_steps.shape[1:]).mean(axis=1)
        return np.ascontiguousarray(of_steps)

    def gain(self, period: SettledPeriod) -> Array:
        """Return the observer's gains per sample (2, joints) [1, 1/s].

        They make an error of the state decay as with the critically damped observer in continuous time, at every
        sampling rate.
        """
        interval = self.every / period.rate
        kept = math.exp(-2.0 * math.pi * self.softness * interval)
        gains = np.array([1.0 - kept**2, (1.0 - kept) ** 2 / interval])
        return np.repeat(gains[:, None], period.joints, axis=1)

    def evaluate(self, x: Array) -> Quadratic:
        """Return the sum of squares at `x` with its normal equations."""
        return self._with_prior(x, self._of_data(x))

    def tempered(self, x: Array) -> tuple["ChainProblem", Quadratic]:
        """Return the problem with the prior reweighted, and its sum of squares at `x`.

        The prior's weight becomes the mean squared residual at `x` relative to the assumed noise, but at least 1.
        Repeated readings have the same reduced weight as in the sum of squares.
        """
        data = self._of_data(x)
        problem = replace(self, prior_weight=max(1.0, data.cost / self.counted))
        return problem, problem._with_prior(x, data)

    @property
    def counted(self) -> float:
        """Number of samples compared; repeated readings have the same reduced weight as in the sum of squares."""
        counted = (
            np.square(weight * period.noise)[:: self.every]
            for weight, period in zip(self.weights, self.periods, strict=True)
        )
        return max(1.0, sum(float(np.sum(each)) for each in counted))

    def _with_prior(self, x: Array, data: Quadratic) -> Quadratic:
        """Return the sum of squares including the prior's part; infinite if the data's part is infinite."""
        normal, gradient = data.normal.copy(), data.gradient.copy()
        if not np.isfinite(data.cost):
            return Quadratic(np.inf, normal, gradient)
        cost = data.cost + self._add_prior(x, normal, gradient)
        if not (np.isfinite(cost) and np.all(np.isfinite(normal))):
            return Quadratic(np.inf, np.zeros_like(normal), np.zeros_like(gradient))
        return Quadratic(cost, normal, gradient)

    def _of_data(self, x: Array) -> Quadratic:
        parameters = self.parameters(x)
        normal, gradient = np.zeros((x.size, x.size)), np.zeros(x.size)
        if not all(map(np.isfinite, parameters.values())):
            return Quadratic(np.inf, normal, gradient)
        cost = 0.0
        for index, (period, weight) in enumerate(zip(self.periods, self.weights, strict=True)):
            where, slopes = self._where(x, index)
            products = Products(slopes.size)
            squares = np.square(weight[:: self.every])
            for part, r, J in self._pieces(x, index, period, parameters):
                if r is None:
                    return Quadratic(np.inf, normal, gradient)
                square = squares[part].reshape(-1)
                products.add(J.reshape(-1, slopes.size), r.reshape(-1), square)
                with np.errstate(over="ignore", invalid="ignore"):  # a motion that diverges has an infinite sum
                    cost += float(square @ r.reshape(-1) ** 2)
            J_J, J_r = products.sums
            with np.errstate(over="ignore", invalid="ignore"):
                normal[np.ix_(where, where)] += J_J * np.outer(slopes, slopes)
                gradient[where] += J_r * slopes
        return Quadratic(cost if np.isfinite(cost) else np.inf, normal, gradient)

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
        """Return the sum of squares at `x` without its normal equations; infinite if the motion diverges."""
        total = self.prior_cost(x)
        for position, period, weight in zip(self._motions(x), self.periods, self.weights, strict=True):
            if position is None:
                return np.inf
            missed = position - self._measured(period)
            total += float(np.nansum(np.square(weight[:: self.every][: len(position)] * missed)))
        return total

    def positions(self, x: Array) -> tuple[Array, ...] | None:
        """Return the predicted positions of each period (joints, samples) [rad]; None if a motion diverges."""
        found = []
        for position in self._motions(x):
            if position is None:
                return None
            found.append(position.T)
        return tuple(found)

    def _motions(self, x: Array) -> Iterator[Array | None]:
        """Yield each period's simulated positions (samples, joints) [rad], or None if the simulation diverges."""
        parameters = self.parameters(x)
        for index, period in enumerate(self.periods):
            if self._knows(x) and index in self.latest.parts:
                yield np.concatenate([position for _, position, _ in self.latest.parts[index]])
                continue
            run = self.run_of(period, parameters)
            moved = self._of_period(index, parameters)
            simulation = Simulation(self.model.base, moved, self.start(x, index), self.gain(period))
            yield simulation.go_on(run, slice(0, len(run.measured)))[0]

    def _knows(self, x: Array) -> bool:
        """Whether the latest simulation with derivatives was that of this problem at `x`."""
        latest = self.latest
        return (
            latest.x is not None
            and all(one is other for one, other in zip(latest.objects, self._objects, strict=True))
            and latest.settings == self._settings
            and np.array_equal(latest.x, x)
        )

    @property
    def _objects(self) -> tuple[object, ...]:
        return self.periods, self.model, self.coordinates.names, self.state_scale, self.added

    @property
    def _settings(self) -> tuple[float, ...]:
        return self.steps, self.softness, self.finer, self.every

    def scatter(self, x: Array, lags: int) -> Array:
        """Return the scatter matrix S of the scores (coordinates, coordinates); see `hil.estimator.fit.covariance`."""
        total = np.zeros((x.size, x.size))
        parameters = self.parameters(x)
        for index, (period, weight) in enumerate(zip(self.periods, self.weights, strict=True)):
            where, slopes = self._where(x, index)
            scatter = Scatter(slopes.size, lags)
            for part, r, J in self._pieces(x, index, period, parameters):
                assert r is not None  # the motion at the minimum is finite
                scatter.add(np.einsum("sj,sjc->sc", weight[part] ** 2 * r, J))
            total[np.ix_(where, where)] += scatter.sum() * np.outer(slopes, slopes)
        return total

    def weighted(self, x: Array, index: int, most: int) -> Iterator[tuple[Array, Array]]:
        """Yield each joint's weighted residual (samples,) in a period and its Jacobian (samples, coordinates).

        Only the first `most` samples are used, rounded up to whole pieces of the simulation.
        """
        period, weight = self.periods[index], self.weights[index]
        where, slopes = self._where(x, index)
        residuals, jacobians = [], []
        for part, r, J in self._pieces(x, index, period, self.parameters(x)):
            assert r is not None  # the motion at the minimum is finite
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
        latest = self.latest
        measured = self._measured(period)
        if not self._knows(x):
            latest.x, latest.parts, latest.size = x.copy(), {}, 0
            latest.objects, latest.settings = self._objects, self._settings
        if index in latest.parts:
            for part, known, derivative in latest.parts[index]:
                yield part, _missed(known, measured[part]), derivative
            return
        run = self.run_of(period, parameters)
        names = self.coordinates.names
        moved, added = self._of_period(index, parameters), self._added(index)
        lost = losses(self.model.base, parameters, names)
        simulation = Simulation(self.model.base, moved, self.start(x, index), self.gain(period), names)
        kept: list[tuple[slice, Array, Array]] = []
        for part in pieces(len(run.measured)):
            position, derivative = simulation.go_on(run, part)
            if position is None:  # the derivatives are not finite either
                yield part, None, derivative
                return
            complete(lost, derivative)
            if added is not None:
                derivative[:, :, names.index(ADDED_MASS)] = derivative[:, :, : added.size] @ added
            yield part, _missed(position, measured[part]), derivative
            latest.size += derivative.nbytes
            if latest.size < MOST_KEPT:
                kept.append((part, position, derivative))
        if latest.size < MOST_KEPT:
            latest.parts[index] = kept

    def _added(self, index: int) -> Array | None:
        return self.added[index] if self.added else None

    def _of_period(self, index: int, parameters: dict[str, float]) -> dict[str, float]:
        """Return the parameters of the equivalent arm (`as_moving`) in a period, including any mass added to it."""
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


def _missed(position: Array, measured: Array) -> Array:
    """Return the residuals, 0 where a sample is missing."""
    return np.where(np.isnan(measured), 0.0, position - measured)
