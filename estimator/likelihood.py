"""Stage 2: maximum likelihood, by least squares of measured minus simulated position over one period.

With errors of position that are alike and independent from sample to sample, as rounding nearly is, the
most likely parameters are those of the smallest weighted sum of squares. The state at the first sample is
unknown too: simulating until the motion is periodic would take two or more periods in place of one.
"""

from dataclasses import dataclass

import numpy as np

from estimator.arrays import Array
from estimator.coordinates import Coordinates, scales_of
from estimator.drive import motor_torque
from estimator.least_squares import LinearEstimate
from estimator.levenberg_marquardt import Minimum, minimise
from estimator.model import Model
from estimator.period import SettledPeriod
from estimator.physics import Physics
from estimator.simulation import simulate, steps_per_sample

WIDTH_FLOOR = 3e-4  # rad/s: narrower cannot be told from friction that sticks
# From a narrow step the fit of a wide one may end in a local minimum, and the other way round: try both.
STARTING_WIDTHS = (0.005, 0.05)  # rad/s
COARSE = 1e-3  # relative gain in the sum of squares at which each try ends
FINE = 1e-6
EXPLAINED = 1.03  # sum of squares per sample in units of the noise: nothing is left for another try to find
ANGLE_SCALE = 0.1  # rad
# Where the terms start that the regression does not see.
START = {"stribeck_rise": 0.2, "stribeck_velocity": 0.2, "load": 0.02}
LEAST_LAG = 1e-4  # s, at the start


@dataclass(frozen=True)
class Fit:
    """The most likely parameters under one model."""

    value: Array
    """In the order of `Model.names` [SI]."""
    covariance: Array
    """Of `value`: inverse information times the residual's variance. Infinite for what leaves no trace."""
    start: Array
    """Angles and velocities at the first sample (2, joints) [rad, rad/s]."""
    position: Array
    """Simulated positions (joints, samples) [rad]."""
    iterations: int
    """Jacobians taken."""


@dataclass(frozen=True)
class Problem:
    """One period's residuals under one model, by coordinates: the parameters', then the first sample's."""

    period: SettledPeriod
    coordinates: Coordinates
    state_scale: Array
    """Of the state at the first sample (2 joints,) [rad, rad/s]."""

    def physics(self, x: Array) -> Physics:
        """The physics at the coordinates `x`."""
        names = self.coordinates.names
        return _physics(names, self.coordinates.values(x[: len(names)]))

    def start(self, x: Array) -> Array:
        """The state at the first sample (2, joints) at the coordinates `x`."""
        return (x[len(self.coordinates.names) :] * self.state_scale).reshape(2, -1)

    def position(self, x: Array) -> Array:
        """Simulated positions (joints, samples) [rad]."""
        period = self.period
        physics = self.physics(x)
        if period.stabiliser is not None:
            return period.stabiliser.positions(physics, self.start(x), period.rate, period.command_to_sample)
        steps = steps_per_sample(period.rate)
        torque = motor_torque(
            period.torque,
            period.rate,
            period.command_to_sample,
            steps,
            delay=physics.delay,
            lag=physics.lag,
        )
        return simulate(physics, self.start(x), torque, 1.0 / (period.rate * steps))[0]

    def residual(self, x: Array) -> Array:
        """Simulated less measured positions in units of their noise, 0 where a sample is missing (all,)."""
        difference = np.where(self.period.valid, self.position(x) - self.period.position, 0.0)
        return (difference / self.period.noise[:, None]).reshape(-1)


def fit_period(period: SettledPeriod, model: Model, linear: LinearEstimate) -> Fit:
    """The most likely parameters of `model`, from stage 1's `linear`. Raises ConvergenceError."""
    velocity = float(np.sqrt(np.mean(linear.motion.velocity**2)))
    torque = float(np.sqrt(np.mean(period.torque**2)))
    scales = scales_of(model.names, torque, velocity, abs(float(linear.value[0])))
    state_scale = np.repeat([ANGLE_SCALE, velocity], period.joints)
    state = np.stack((linear.motion.position[:, 0], linear.motion.velocity[:, 0])).reshape(-1) / state_scale
    coordinates = Coordinates(model.names, scales, WIDTH_FLOOR)
    problem = Problem(period, coordinates, state_scale)
    tries = []
    for width in STARTING_WIDTHS:
        value = _start(model, linear, width)
        x = np.concatenate((coordinates.coordinates(value), state))
        tries.append(minimise(problem.residual, x, COARSE))
        if tries[-1].cost < EXPLAINED * period.valid.sum():
            break
    best = min(tries, key=lambda found: found.cost)
    minimum = minimise(problem.residual, best.x, FINE)
    return Fit(
        coordinates.values(minimum.x[: value.size]),
        _covariance(minimum, coordinates, int(period.valid.sum())),
        problem.start(minimum.x),
        problem.position(minimum.x),
        sum(found.iterations for found in tries) + minimum.iterations,
    )


def _physics(names: tuple[str, ...], value: Array) -> Physics:
    return Physics.of(dict(zip(names, value.tolist(), strict=True)))


def _start(model: Model, linear: LinearEstimate, width: float) -> Array:
    """Parameters to start from [SI] (parameters,): stage 1's, and what it does not see."""
    known = dict(zip(linear.names, linear.value.tolist(), strict=True))
    known |= dict.fromkeys((f"coulomb_width_{joint + 1}" for joint in range(model.joints)), width)
    known |= {"delay": linear.delay, "lag": max(linear.delay, LEAST_LAG)}
    return np.array([known.get(name, START.get(name.rstrip("_12"), 0.0)) for name in model.names])


def _covariance(minimum: Minimum, coordinates: Coordinates, samples: int) -> Array:
    """Covariance of the parameters, the start's state taken as unknown with them."""
    x, normal = minimum.x, minimum.normal
    count = len(coordinates.names)
    variance = minimum.cost / max(1, samples - x.size)
    norm = np.sqrt(np.diag(normal))
    seen = norm > 1e-12 * norm.max()
    lengths = np.outer(norm[seen], norm[seen])
    of_x = np.zeros((x.size, x.size))
    of_x[np.ix_(seen, seen)] = np.linalg.pinv(normal[np.ix_(seen, seen)] / lengths, hermitian=True) / lengths
    slope = coordinates.slopes(x[:count])
    covariance: Array = variance * slope @ of_x[:count, :count] @ slope.T
    covariance[~seen[:count], ~seen[:count]] = np.inf
    return covariance
