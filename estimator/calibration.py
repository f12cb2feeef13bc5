"""Torque constants from a known mass, by maximum likelihood over two settled periods, one of them with the mass.

Every parameter of a joint scales with its torque constant. A mass M bolted to the last link at a known distance changes
the arm's parameters by amounts that are known in kilograms and metres:

    gravity_2 + M d g    inertia_2 + M d^2 + J    coupling + M l1 d    gravity_1 + M l1 g    inertia_1 + M l1^2
    (one joint: gravity_1 + M d g, inertia_1 + M d^2 + J)

Both periods are fitted together. Each joint's torque is the commanded one times an unknown factor: the ratio of true to
assumed torque constant.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError
from hil.estimator.fit.levenberg_marquardt import Quadratic, minimise
from hil.estimator.fit.normal_equations import normal_equations
from hil.estimator.fit.reparametrisation import Coordinates
from hil.estimator.fit.resolved_widths import resolved_widths
from hil.estimator.identify import Estimate
from hil.estimator.models.parameters import Physics
from hil.estimator.models.terms import term_of
from hil.estimator.options import CalibrationOptions
from hil.estimator.simulation.arm import simulate, steps_per_sample
from hil.estimator.simulation.drive import motor_torque

DEFAULTS = CalibrationOptions()
ADDED = {
    1: ("gravity_1", "inertia_1"),
    2: ("gravity_2", "inertia_2", "coupling", "gravity_1", "inertia_1"),
}


@dataclass(frozen=True)
class KnownMass:
    """A mass bolted to the last link, on the line from that link's joint through the link's centre of mass."""

    mass: float
    """Mass [kg]."""
    distance: float
    """Distance from the last joint to the mass's centre of mass [m]."""
    inertia: float = 0.0
    """Inertia about its own centre of mass [kg m^2]."""
    length: float = 0.0
    """Length of link 1 from joint to joint [m]; only needed for an arm of two joints."""

    def change(self, gravity: float, joints: int) -> dict[str, float]:
        """Return the change in the base parameters [SI]; raises ModelError for impossible values."""
        if not (self.mass > 0.0 and self.distance > 0.0 and self.inertia >= 0.0):
            raise ModelError(
                f"a mass of {self.mass:g} kg at {self.distance:g} m with inertia {self.inertia:g} kg m^2: mass and "
                "distance must be positive, inertia non-negative"
            )
        M, d, g = self.mass, self.distance, gravity
        about = self.inertia + M * d**2
        if joints == 1:
            return {"gravity_1": M * d * g, "inertia_1": about}
        if self.length <= 0.0:
            raise ModelError(
                "the length of link 1 must be known: measure it from joint to joint and pass it with --length"
            )
        added = (M * d * g, about, M * self.length * d, M * self.length * g, M * self.length**2)
        return dict(zip(ADDED[2], added, strict=True))


@dataclass(frozen=True)
class Calibration:
    """Torque constants of the joints, and the arm parameters that follow from them."""

    factor: Array
    """Ratio of true to assumed torque constant of each joint (joints,)."""
    factor_std: Array
    names: tuple[str, ...]
    value: Array
    """Parameters of the arm without the mass (parameters,) [SI]."""
    std: Array
    residual_steps: Array
    """RMS of the residual in encoder steps (runs, joints)."""
    misfit: float
    """Weighted sum of squared residuals per sample; 1 for noise alone."""


@one_blas_thread
def calibrate(
    without: SettledPeriod,
    with_mass: SettledPeriod,
    first: Estimate,
    known: KnownMass,
    gravity: float,
    options: CalibrationOptions = DEFAULTS,
) -> Calibration:
    """Estimate the torque constants of all joints from two settled periods.

    Args:
        without: settled period of the arm without the mass.
        with_mass: settled period of the arm with the mass.
        first: estimate obtained from `without` with the assumed torque constants; its model is used for both periods.
        known: the mass.
        gravity: acceleration of gravity in the arm's plane [m/s^2].
        options: tolerances and limits.

    Returns:
        The ratio of true to assumed torque constant of each joint, and the arm's parameters for the true constants.

    Raises:
        ModelError: if the periods differ in their number of joints.
        ConvergenceError: if the fit does not converge.
    """
    if without.joints != with_mass.joints:
        raise ModelError(f"one run has {without.joints} joints but the other has {with_mass.joints}")
    problem = _TwoRuns((without, with_mass), first, known.change(gravity, without.joints), options)
    minimum = minimise(problem.evaluate, problem.start(), options.ftol, options=options.minimiser)
    x, joints = minimum.x, without.joints
    samples = sum(int(period.valid.sum()) for period in problem.periods)
    variance = minimum.at.cost / max(1, samples - x.size)
    norm = np.sqrt(np.maximum(np.diag(minimum.at.normal), 1e-300))
    covariance = variance * linalg.pinv(minimum.at.normal / np.outer(norm, norm), rcond=1e-13, hermitian=True)
    covariance /= np.outer(norm, norm)
    factor = np.exp(x[:joints])
    slope = problem.coordinates.slopes(x[joints : joints + problem.size])
    of_values = slope @ covariance[joints : joints + problem.size, joints : joints + problem.size] @ slope.T
    residual = problem.residual(x).reshape(-1)
    steps, taken = [], 0
    for period in problem.periods:
        count = period.position.size
        rows = residual[taken : taken + count].reshape(joints, -1) * period.noise[:, None]
        steps.append(np.sqrt(np.sum(rows**2, axis=1) / period.valid.sum(axis=1)) / period.position_step)
        taken += count
    return Calibration(
        factor,
        factor * np.sqrt(np.diag(covariance)[:joints]),
        first.model.names,
        problem.coordinates.values(x[joints : joints + problem.size]),
        np.sqrt(np.diag(of_values)),
        np.stack(steps),
        minimum.at.cost / samples,
    )


class _TwoRuns:
    """Residuals of both periods as a function of log factors, parameter coordinates and two initial states."""

    def __init__(
        self,
        periods: tuple[SettledPeriod, SettledPeriod],
        first: Estimate,
        change: dict[str, float],
        options: CalibrationOptions,
    ) -> None:
        self._options = options
        self.periods = periods
        self.size = len(first.names)
        self._first = first
        self._change = np.array([change.get(name, 0.0) for name in first.names])
        scales = np.maximum(np.abs(first.value), 1e-6)
        either = [term_of(name).range == "any" for name in first.names]
        scales[either] = np.maximum(scales[either], 1e-3)
        step = max(1.0 / (period.rate * steps_per_sample(period.rate)) for period in periods)
        resolved = resolved_widths(first.names, first.parameters, step, options.coordinates.widths_per_substep)
        self.coordinates = Coordinates(first.names, scales, options.coordinates, resolved)
        velocity = float(np.sqrt(np.mean(np.gradient(first.position, 1.0 / periods[0].rate, axis=1) ** 2)))
        self._state_scale = np.repeat([options.angle_scale, velocity], periods[0].joints)

    def start(self) -> Array:
        """Return the initial guess: the first period's estimate, and the second period's measured initial state."""
        joints, rate = self.periods[0].joints, self.periods[1].rate
        filled = self.periods[1].filled()
        value = self._first.value.copy()
        for i, name in enumerate(self._first.names):
            if term_of(name).range == "floor":
                value[i] = self._options.initial_width
        speed = (filled[:, 2] - filled[:, -2]) * rate / 4.0
        return np.concatenate(
            (
                np.zeros(joints),
                self.coordinates.coordinates(value),
                self._first.start.reshape(-1) / self._state_scale,
                np.concatenate((filled[:, 0], speed)) / self._state_scale,
            )
        )

    def evaluate(self, x: Array) -> Quadratic:
        """Return the sum of squares at `x`, with normal equations from finite differences."""
        here = self.residual(x)
        jacobian = np.empty((here.size, x.size))
        difference = self._options.difference
        for index in range(x.size):
            there = x.copy()
            there[index] += difference
            jacobian[:, index] = (self.residual(there) - here) / difference
        if not (np.all(np.isfinite(here)) and np.all(np.isfinite(jacobian))):
            return Quadratic(np.inf, np.eye(x.size), np.zeros(x.size))
        return Quadratic(float(np.sum(here * here)), *normal_equations(jacobian, here))

    def residual(self, x: Array) -> Array:
        """Return simulated minus measured positions of both periods, in units of their noise."""
        joints = self.periods[0].joints
        factor = np.exp(x[:joints])
        value = self.coordinates.values(x[joints : joints + self.size])
        rows = []
        for run, period in enumerate(self.periods):
            at = joints + self.size + 2 * joints * run
            state = (x[at : at + 2 * joints] * self._state_scale).reshape(2, joints)
            named = dict(zip(self._first.names, (value + run * self._change).tolist(), strict=True))
            rows.append(_misfit(period, Physics.of(named), state, factor))
        return np.concatenate(rows)


def _misfit(period: SettledPeriod, physics: Physics, state: Array, factor: Array) -> Array:
    steps = steps_per_sample(period.rate)
    torque = motor_torque(
        period.torque * factor[:, None],
        period.rate,
        period.command_to_sample,
        steps,
        delay=physics.delays,
        lag=physics.lags,
    )
    position, _ = simulate(physics, state, torque, 1.0 / (period.rate * steps))
    difference = np.where(period.valid, position - period.position, 0.0)
    return np.asarray((difference / period.noise[:, None]).reshape(-1))
