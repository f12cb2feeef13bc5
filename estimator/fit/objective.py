"""The likelihood's objective: the weighted sum of squares of measured minus simulated position over several runs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.fit.covariance import Scatter
from hil.estimator.fit.levenberg_marquardt import Minimum, Quadratic, minimise, step_limits
from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.fit.reparametrisation import CoordinatePrior, Coordinates, Lever
from hil.estimator.fit.simulated_run import SimulatedRun
from hil.estimator.fit.stabilised_run import StabilisedRun
from hil.estimator.models.parameters import Physics
from hil.estimator.options import MinimiserOptions

Run = SimulatedRun | StabilisedRun


@dataclass(frozen=True)
class Objective:
    """Residuals of several runs under one model.

    The coordinates are those of the parameters, followed by each run's initial state.
    """

    runs: tuple[Run, ...]
    coordinates: Coordinates
    state_scale: Array
    """Scale of the initial state (2 joints,) [rad, rad/s]."""
    weights: tuple[Array, ...]
    """Inverse standard deviation of each sample (joints, samples) [1/rad] for each run; 0 for missing samples."""
    prior: CoordinatePrior
    """Prior of the parameters."""
    minimiser: MinimiserOptions
    max_relative_decrease: float
    """Maximum relative decrease in the width of a smoothed Coulomb step per iteration."""
    horizon: float = 1.0
    """Fraction of each run that is used, starting at its beginning."""
    tracking_stiffness: Array | None = None
    """Stiffness of springs that pull the simulated arm to the measured angles (joints,) [N m/rad]."""
    fixed_parameters: bool = False
    """Whether only the initial states are fitted."""
    lever: Lever | None = None
    """Prior on coupling relative to gravity_2."""

    @property
    def count(self) -> int:
        return len(self.coordinates.names)

    def physics(self, x: Array) -> Physics:
        """Return the physical constants at the coordinates `x`."""
        values = self.coordinates.values(x[: self.count]).tolist()
        return Physics.of(dict(zip(self.coordinates.names, values, strict=True)))

    def start(self, x: Array, run: int) -> Array:
        """Return the state at the first sample of a run (2, joints) [rad, rad/s] at the coordinates `x`."""
        size = self.state_scale.size
        first = self.count + run * size
        return (x[first : first + size] * self.state_scale).reshape(2, -1)

    def evaluate(self, x: Array) -> Quadratic:
        """Return the weighted sum of squares at `x` with its normal equations."""
        physics = self.physics(x)
        total = self._expected(x)
        if not np.all(np.isfinite(physics.vector)):
            return replace(total, cost=np.inf)
        for index, (run, weight) in enumerate(zip(self.runs, self.weights, strict=True)):
            transform = self._transform(x, index)
            n, b = np.zeros((transform.shape[0],) * 2), np.zeros(transform.shape[0])
            cost = 0.0
            for part, position, derivative in run.pieces(
                physics, self.start(x, index), self.coordinates.names, self.tracking_stiffness, self.horizon
            ):
                square = np.square(weight[:, part]).reshape(-1)
                r = (position - run.measured[:, part]).reshape(-1)
                normal, gradient = normal_equations(derivative.reshape(r.size, -1), r, square)
                n, b, cost = n + normal, b + gradient, cost + float(np.sum(square * r * r))
                if not (np.isfinite(cost) and np.all(np.isfinite(n)) and np.all(np.isfinite(b))):
                    return Quadratic(np.inf, total.normal, total.gradient)
            total = Quadratic(
                total.cost + cost,
                total.normal + transform.T @ n @ transform,
                total.gradient + transform.T @ b,
            )
        return total

    def _expected(self, x: Array) -> Quadratic:
        normal, gradient = np.zeros((x.size, x.size)), np.zeros(x.size)
        normal[: self.count, : self.count] = np.diag(self.prior.precision)
        gradient[: self.count] = self.prior.precision * (x[: self.count] - self.prior.centre)
        cost = self.prior.cost(x[: self.count])
        if self.lever is not None:
            away, slope = self.lever.residual(self.coordinates.values(x[: self.count]))
            by_coordinate = slope @ self.coordinates.slopes(x[: self.count])
            normal[: self.count, : self.count] += np.outer(by_coordinate, by_coordinate)
            gradient[: self.count] += away * by_coordinate
            cost += away**2
        return Quadratic(cost, normal, gradient)

    def expected_normal(self, x: Array) -> Array:
        """Return the prior's contribution to the normal equations (parameters, parameters)."""
        return self._expected(x).normal[: self.count, : self.count]

    def with_prior_weighted(self, factor: Array) -> "Objective":
        """Return this objective with each parameter's prior precision multiplied by `factor` (parameters,)."""
        lever = self.lever
        if lever is not None:
            lever = replace(lever, std=lever.std / float(np.sqrt(factor[[lever.coupling, lever.gravity]].min())))
        return replace(self, prior=self.prior.weighted(factor), lever=lever)

    def minimise(self, x: Array, ftol: float, damping: float | None = None, at: Quadratic | None = None) -> Minimum:
        """Minimise the sum of squares from `x`; see `hil.estimator.fit.levenberg_marquardt.minimise`."""
        return minimise(
            *(self.evaluate, x, ftol, damping, at),
            cost=self.cost_at,
            move=self.coordinates.moved,
            limits=self._limits,
            options=self.minimiser,
        )

    def _limits(self, x: Array) -> tuple[Array, Array]:
        """Return the minimum and maximum change of each coordinate in a step."""
        least, most = step_limits(x, self.minimiser)
        self.coordinates.limit(x[: self.count], least, most, self.max_relative_decrease)
        if self.fixed_parameters:
            least[: self.count] = most[: self.count] = 0.0
        return least, most

    def cost_at(self, x: Array) -> float:
        """Return the weighted sum of squares at `x`; this takes a fraction of the time that `evaluate` takes."""
        physics = self.physics(x)
        if not np.all(np.isfinite(physics.vector)):
            return np.inf
        total = self._expected(x).cost
        with np.errstate(over="ignore", invalid="ignore"):  # if a motion diverges
            for index, (run, weight) in enumerate(zip(self.runs, self.weights, strict=True)):
                position = run.position(physics, self.start(x, index), self.tracking_stiffness, self.horizon)
                samples = position.shape[1]
                total += float(np.sum(np.square(weight[:, :samples] * (position - run.measured[:, :samples]))))
        return total if np.isfinite(total) else np.inf

    def cost(self, positions: Sequence[Array]) -> float:
        """Return the weighted sum of squares for simulated positions of each run (joints, samples) [rad]."""
        squares = [
            np.square(weight * (position - run.measured))
            for run, weight, position in zip(self.runs, self.weights, positions, strict=True)
        ]
        return float(sum(square.sum() for square in squares))

    def positions(self, x: Array) -> tuple[Array, ...]:
        """Return the simulated positions of each run (joints, samples) [rad]."""
        physics = self.physics(x)
        return tuple(run.position(physics, self.start(x, index)) for index, run in enumerate(self.runs))

    def scatter(self, x: Array, lags: int) -> Array:
        """Return the sum of products of the scores (coordinates, coordinates) over windows of `lags` samples.

        See `hil.estimator.fit.covariance`.
        """
        physics = self.physics(x)
        total = self._expected(x).normal
        for index, (run, weight) in enumerate(zip(self.runs, self.weights, strict=True)):
            transform = self._transform(x, index)
            scatter = Scatter(transform.shape[0], lags)
            for part, position, derivative in run.pieces(physics, self.start(x, index), self.coordinates.names):
                square = weight[:, part] ** 2 * (position - run.measured[:, part])
                scatter.add(np.einsum("js,jsc->sc", square, derivative))
            total += transform.T @ scatter.sum() @ transform
        return total

    def _transform(self, x: Array, run: int) -> Array:
        """Return the derivatives of a run's parameters and initial state (rows) with respect to all coordinates
        (columns).
        """
        size = self.state_scale.size
        transform = np.zeros((self.count + size, x.size))
        transform[: self.count, : self.count] = self.coordinates.slopes(x[: self.count])
        first = self.count + run * size
        transform[self.count :, first : first + size] = np.diag(self.state_scale)
        return transform
