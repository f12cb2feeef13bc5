"""Optimal excitation: amplitudes and phases that minimise the largest relative standard error, within limits.

The standard errors are those of the likelihood (`hil.estimator.fit.stage2`) on one settled period. The search is a
(1+1) evolution strategy with step-size control by Rechenberg's success rule: first over the shape of the amplitude
spectra and the extent of each joint's motion, then over the phases as well. The criterion is described in Pronzato and
Pazman, "Design of experiments in nonlinear models", 2013, chapter 5 (E and minimax criteria).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.blas import one_blas_thread
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.models.parameters import ABSENT, CONSTANTS, Physics
from hil.estimator.models.terms import extra_names
from hil.estimator.simulation.closed_loop import Feedback, Response, respond, resting
from hil.estimator.threads import thread_count

KNOTS = 4  # number of knots of each joint's amplitude spectrum, over the logarithm of the line number
SHAPE_TRIALS = 60
PHASE_TRIALS = 60
DIFFERENCE = 1e-3  # finite difference: relative for a parameter, absolute for the state [rad, rad/s]
SCALING_ROUNDS = 12
LEAST_SHARE = 1e-3
THREADS = 2
LEAST_WIDTH = 0.02  # rad/s


@dataclass(frozen=True)
class Limits:
    """Limits of the motion, per joint (joints,): angles [rad], velocity [rad/s], torque [N m]."""

    low: Array
    high: Array
    velocity: Array
    torque: Array


@dataclass(frozen=True)
class Design:
    """The designed multisine, and the plain one scaled to the limits, each with its largest relative standard error."""

    multisine: Multisine
    plain: Multisine
    worst: float
    plain_worst: float


def smoothed(physics: Physics) -> Physics:
    """Return the arm with friction steps widened to at least LEAST_WIDTH, so that it can be simulated faster."""
    vector = physics.vector.copy()
    for joint in (1, 2):
        index = CONSTANTS.index(f"coulomb_width_{joint}")
        vector[index] = max(vector[index], LEAST_WIDTH)
    return Physics(vector, physics.delay, physics.lag)


@dataclass(frozen=True)
class DesignProblem:
    """Objective and constraints of the design."""

    physics: Physics
    names: tuple[str, ...]
    """Names of the parameters whose standard errors are considered."""
    limits: Limits
    pose: Array
    """Rest pose (joints,) [rad]."""
    position_step: Array
    """Encoder resolution (joints,) [rad]."""
    feedback: Feedback

    def worst(self, wave: Multisine) -> float:
        """Return the largest relative standard error of `names` from a settled period of `wave`.

        The result is infinite if the period does not determine all of these parameters.
        """
        deviations = self.standard_errors(wave)
        return float((deviations / self.scale()).max())

    def standard_errors(self, wave: Multisine) -> Array:
        """Return the standard errors of `names` (parameters,) [SI]."""
        start = self._settled(wave)
        nominal = self._positions(self.physics, start, wave)
        columns = self._columns(wave, start, nominal)
        norm = np.linalg.norm(columns, axis=0)
        seen = norm > 1e-9 * norm.max()
        if not seen[: len(self.names)].all() or not np.isfinite(norm).all():
            return np.full(len(self.names), np.inf)
        scaled = columns[:, seen] / norm[seen]
        inverse = linalg.pinv(scaled.T @ scaled, rcond=1e-14, hermitian=True)
        count = len(self.names)
        deviations: Array = np.sqrt(np.maximum(np.diag(inverse), 0.0))[:count] / norm[seen][:count]
        return deviations

    def scale(self) -> Array:
        """Return the values by which standard errors are divided: the parameters or, for offsets, the joints' Coulomb
        friction [SI].
        """
        known = dict(zip(CONSTANTS, self.physics.vector.tolist(), strict=True))
        against = [name.replace("offset", "coulomb") if name.startswith("offset") else name for name in self.names]
        return np.maximum(np.abs([known[name] for name in against]), 1e-9)

    def shares(self, wave: Multisine) -> Array:
        """Return the fraction of its limits that each joint uses (joints,), in the transient and the settled period."""
        response = self._two_periods(wave)
        limits, pose = self.limits, self.pose
        up = (response.position.max(axis=1) - pose) / (limits.high - pose)
        down = (pose - response.position.min(axis=1)) / (pose - limits.low)
        speed = np.abs(response.velocity).max(axis=1) / limits.velocity
        torque = np.abs(wave.torque).max(axis=1) / limits.torque
        share: Array = np.maximum.reduce([up, down, speed, torque])
        return np.nan_to_num(share, nan=1e3, posinf=1e3)

    def scaled(self, wave: Multisine, target: Array) -> Multisine:
        """Return `wave` with each joint's torque scaled to use at most the fraction `target` (joints,) of its
        limits.
        """
        most = 0.999 * self.limits.torque / np.abs(wave.torque).max(axis=1)
        factor = 0.3 * most
        best, reached = _times(wave, 0.05 * most), 0.0
        exponent = 0.8
        for _ in range(SCALING_ROUNDS):
            candidate = _times(wave, factor)
            share = self.shares(candidate) / target
            if share.max() <= 1.0 and share.min() > reached:
                best, reached = candidate, float(share.min())
                if reached > 0.96:
                    break
            factor = np.minimum(factor * np.clip((0.98 / np.maximum(share, LEAST_SHARE)) ** exponent, 0.6, 1.6), most)
            exponent = max(0.3, 0.9 * exponent)
        return best

    def positions(self, wave: Multisine) -> Array:
        """Return the positions in the transient and the settled period (joints, samples) [rad]."""
        return self._two_periods(wave).position

    def _two_periods(self, wave: Multisine) -> Response:
        command = np.tile(wave.torque, 2)
        return respond(self.physics, resting(self.pose), command, wave.rate, self.feedback)

    def _settled(self, wave: Multisine) -> Array:
        return self._two_periods(wave).state

    def _positions(self, physics: Physics, start: Array, wave: Multisine) -> Array:
        return respond(physics, start, wave.torque, wave.rate, self.feedback).position

    def _columns(self, wave: Multisine, start: Array, nominal: Array) -> Array:
        """Return the derivatives of all positions, in units of the rounding error, with respect to parameters, nuisance
        parameters and initial state.
        """
        noise = (self.position_step / np.sqrt(12.0))[:, None]

        def by_parameter(name: str) -> Array:
            physics, change = _moved(self.physics, name)
            column: Array = ((self._positions(physics, start, wave) - nominal) / (change * noise)).reshape(-1)
            return column

        def by_state(place: tuple[int, int]) -> Array:
            moved = start.copy()
            moved[place] += DIFFERENCE
            difference = self._positions(self.physics, moved, wave) - nominal
            column: Array = (difference / (DIFFERENCE * noise)).reshape(-1)
            return column

        joints = wave.joints
        places = [(row, joint) for row in (0, 1) for joint in range(joints)]
        with ThreadPoolExecutor(thread_count(THREADS)) as threads:
            columns = [*threads.map(by_parameter, (*self.names, *self._nuisances(joints)))]
            columns += threads.map(by_state, places)
        return np.stack(columns, axis=1)

    def _nuisances(self, joints: int) -> list[str]:
        known = dict(zip(CONSTANTS, self.physics.vector.tolist(), strict=True))
        terms = [name for name in extra_names(joints) if name in known]
        present = [name for name in terms if known[name] not in {0.0, ABSENT[name]}]
        return [*present, "lag"]


@one_blas_thread
def design_optimal(plain: Multisine, problem: DesignProblem, seed: int) -> Design:
    """Reduce the standard errors defined by `problem`, starting from `plain` and keeping its lines and period.

    The same seed gives the same wave.
    """
    random = np.random.default_rng((seed, 11))
    whole = np.ones(plain.joints)
    start = problem.scaled(plain, whole)
    phases = tuple(np.asarray(each) for each in plain.phases)
    best = _Candidate(np.zeros((plain.joints, KNOTS)), phases, whole)
    plain_worst = problem.worst(start)
    found, wave = plain_worst, start
    step = 0.5
    for trial in range(SHAPE_TRIALS + PHASE_TRIALS):
        tried = best.mutated(random, step, 0.0 if trial < SHAPE_TRIALS else step)
        candidate = problem.scaled(tried.wave(plain), tried.share)
        worst = problem.worst(candidate)
        if worst < found:
            best, found, wave = tried, worst, candidate
            step = min(1.0, 1.5 * step)
        else:
            step = max(0.05, 0.93 * step)
        if trial == SHAPE_TRIALS - 1:
            step = 0.3
    return Design(wave, start, found, plain_worst)


@dataclass(frozen=True)
class _Candidate:
    """A candidate in the search.

    shape: log amplitudes at the knots (joints, KNOTS).
    phases: phases of each joint's lines [rad].
    share: fraction of the limits to use (joints,).
    """

    shape: Array
    phases: tuple[Array, ...]
    share: Array

    def mutated(self, random: np.random.Generator, step: float, phase_step: float) -> "_Candidate":
        shape = self.shape + step * random.standard_normal(self.shape.shape)
        share = np.minimum(self.share * np.exp(0.2 * step * random.standard_normal(self.share.shape)), 1.0)
        phases = tuple(each + phase_step * random.standard_normal(each.size) for each in self.phases)
        return _Candidate(np.clip(shape, -4.0, 4.0), phases, share)

    def wave(self, plain: Multisine) -> Multisine:
        """Return this candidate's multisine, scaled to the peaks of `plain`."""
        amplitudes, phases, torque = [], [], np.empty_like(plain.torque)
        for joint, lines in enumerate(plain.lines):
            order = np.log(np.asarray(lines, dtype=np.float64))
            knots = np.linspace(order.min(), order.max() + 1e-9, KNOTS)
            amplitude = np.exp(np.interp(order, knots, self.shape[joint]))
            phase = self.phases[joint]
            spectrum = np.zeros(plain.samples // 2 + 1, dtype=np.complex128)
            spectrum[list(lines)] = 0.5 * plain.samples * amplitude * np.exp(1j * phase)
            wave = np.fft.irfft(spectrum, plain.samples)
            factor = float(np.abs(plain.torque[joint]).max() / np.abs(wave).max())
            torque[joint] = factor * wave
            amplitudes.append(tuple((factor * amplitude).tolist()))
            phases.append(tuple(np.mod(phase, 2.0 * np.pi).tolist()))
        return replace(plain, amplitudes=tuple(amplitudes), phases=tuple(phases), torque=torque)


def _times(wave: Multisine, factor: Array) -> Multisine:
    amplitudes = tuple(tuple(float(f) * a for a in each) for f, each in zip(factor, wave.amplitudes, strict=True))
    return replace(wave, amplitudes=amplitudes, torque=wave.torque * factor[:, None])


def _moved(physics: Physics, name: str) -> tuple[Physics, float]:
    """Slightly increase the constant `name`; return the changed physics and the increase."""
    if name == "lag":
        change = 1e-5
        return Physics(physics.vector, physics.delay, physics.lag + change), change
    vector = physics.vector.copy()
    index = CONSTANTS.index(name)
    change = DIFFERENCE * max(abs(float(vector[index])), 1e-3)
    vector[index] += change
    return Physics(vector, physics.delay, physics.lag), change
