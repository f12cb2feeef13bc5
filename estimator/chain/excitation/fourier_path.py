"""Excitation of a chain by paths whose joint angles are finite Fourier series.

The arm is driven with the torque that an approximate model requires for the path, plus that of a software spring and
damper. The series is optimised for the intended use of the result: predicting the torque of other motions in the same
range. The criterion is evaluated for the worst joint and covers all unknowns of the regression, including friction and
offsets.

This designer is for a box of angles and speeds that the user has chosen ([joint_path]); `path_design` finds the box
itself, within limits of torque and clearance.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.chain.fit.stage1 import columns_of_friction
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import mass_matrix
from hil.estimator.chain.model.prior import Prior
from hil.estimator.data.fourier import PeriodicMotion
from hil.estimator.errors import ExcitationError

CANDIDATES = 24  # number of random initial paths
IMPROVEMENTS = 96  # number of random changes to the best path to try
CHANGE, LEAST_CHANGE = 0.5, 0.1  # first and last size of a change, relative to the path's coefficients
STEEPEST = 2.0  # largest exponent with which random coefficients decrease with the harmonic's number
OTHERS = 3  # number of random motions whose torque is to be predicted
CHANGED = 0.3  # fraction of the coefficients changed at a time
SAMPLES_PER_HARMONIC = 12
NOISE = 4.4e-4  # rad: standard deviation of an angle rounded to 4096 steps per turn
SOFTNESS = 1.0  # Hz: natural frequency of stage 2's observer, which limits how long a torque affects the residual


@dataclass(frozen=True)
class Path:
    """One period of a motion (joints, samples) [rad, rad/s, rad/s^2]."""

    position: Array
    velocity: Array
    acceleration: Array


@dataclass(frozen=True)
class Box:
    """Limits of a path with a given `period` [s] and number of `harmonics`.

    Each joint stays within `swing` (joints,) [rad] of `centre` (joints,) [rad] and moves no faster than `speed`
    (joints,) [rad/s].
    """

    centre: Array
    swing: Array
    speed: Array
    period: float
    harmonics: int

    def path(self, lines: NDArray[np.complex128], samples: int) -> Path:
        """Return the path with the coefficients `lines` (joints, harmonics), scaled to fill the box."""
        spectrum = np.zeros((self.centre.size, samples // 2 + 1), dtype=np.complex128)
        spectrum[:, 1 : self.harmonics + 1] = lines
        turn = 2j * np.pi * np.arange(spectrum.shape[1]) / self.period
        position, velocity, acceleration = (np.fft.irfft(spectrum * turn**order, samples, axis=1) for order in range(3))
        most = np.abs(position).max(axis=1), np.abs(velocity).max(axis=1)
        scale = np.minimum(self.swing / most[0], self.speed / most[1])[:, None]
        return Path(self.centre[:, None] + scale * position, scale * velocity, scale * acceleration)

    def draw(self, rng: np.random.Generator) -> NDArray[np.complex128]:
        """Return random coefficients (joints, harmonics)."""
        return random_lines(rng, self.centre.size, self.harmonics)


def random_lines(rng: np.random.Generator, joints: int, harmonics: int) -> NDArray[np.complex128]:
    """Return Fourier coefficients (joints, harmonics) with random phases and amplitudes.

    Some joints have steep spectra, which give slow, wide motions; others have flat spectra, which give fast ones.
    """
    slower = np.arange(1, harmonics + 1) ** -rng.uniform(0.0, STEEPEST, (joints, 1))
    lines = rng.standard_normal((joints, harmonics)) + 1j * rng.standard_normal((joints, harmonics))
    return (slower * lines).astype(np.complex128)


def design_path(
    base: BaseParameters,
    prior: Prior,
    rate: float,
    period: float,
    highest: float,
    centre: Array,
    swing: Array,
    speed: Array,
    seed: int,
) -> Path:
    """Design a path with harmonics up to `highest` [Hz] that keeps each joint within limits.

    The joints stay within `swing` (joints,) [rad] of `centre` (joints,) [rad] and below `speed` (joints,) [rad/s].
    rate: samples per second; period [s]; prior: approximate parameters, whose uncertainty determines which information
    matters. Raises ExcitationError.
    """
    count = int(np.floor(highest * period + 1e-9))
    if count < 2 or highest > rate / 8 or min(swing.min(), speed.min()) <= 0.0:
        raise ExcitationError(
            f"a path of {period:g} s with harmonics up to {highest:g} Hz at {rate:g} samples/s, swing {swing.min():g} "
            f"rad, speed {speed.min():g} rad/s: it needs at least two harmonics below an eighth of the rate, and a "
            "positive swing and speed"
        )
    rng = np.random.default_rng(seed)
    box = Box(centre, swing, speed, period, count)
    goal = Goal(base, prior, box, round(rate * period))
    drawn = [box.draw(rng) for _ in range(CANDIDATES)]
    errors = [goal.error(lines) for lines in drawn]
    best, error = drawn[int(np.argmin(errors))], min(errors)
    for k in range(IMPROVEMENTS):
        size = CHANGE * (LEAST_CHANGE / CHANGE) ** (k / IMPROVEMENTS)
        typical = np.sqrt(np.mean(np.abs(best) ** 2, axis=1, keepdims=True))
        changed = best + size * typical * box.draw(rng) * (rng.random(best.shape) < CHANGED)
        found = goal.error(changed)
        if found < error:
            best, error = changed, found
    return box.path(best, round(rate * period))


@dataclass(frozen=True)
class Goal:
    """Design criterion: how accurately a path, together with the prior, determines the torque of other motions in its
    box.
    """

    base: BaseParameters
    prior: Prior
    box: Box
    readings: int
    """Number of samples of the recording."""

    def error(self, lines: NDArray[np.complex128]) -> float:
        """Return the expected relative RMS error of the rigid-body torque in other motions, for the worst joint."""
        rows = self._seen(self._columns(self.box.path(lines, self._samples))) * self._lengths
        information = rows.T @ rows
        information[np.diag_indices_from(information)] += 1.0
        covariance = linalg.inv(information)[: self.base.count, : self.base.count]
        wrong = np.sum(self._products * covariance, axis=(1, 2))
        return float(np.max(np.sqrt(wrong) / self._level))

    @property
    def _samples(self) -> int:
        return SAMPLES_PER_HARMONIC * self.box.harmonics

    def _columns(self, path: Path) -> Array:
        """Return the regressor of base parameters, friction and offsets (joints, samples, unknowns)."""
        rigid = self.base.regressor(path.position, path.velocity, path.acceleration)
        motion = PeriodicMotion(path.position, path.velocity, path.acceleration)
        return np.concatenate((rigid, columns_of_friction(motion)), axis=2)

    def _seen(self, columns: Array) -> Array:
        """Return the effect of each unknown on the angles, in units of their noise (joints samples, unknowns).

        A torque acts on the angle through the joint's inertia, and the observer pulls the angle towards the
        measurements. The path is sampled coarsely: each sample represents several samples of the recording.
        """
        spectrum = np.fft.rfft(columns, axis=1) * self._response[:, :, None]
        noise = NOISE * np.sqrt(self._samples / self.readings)
        shown: Array = np.fft.irfft(spectrum, self._samples, axis=1) / noise
        return shown.reshape(-1, columns.shape[2])

    @cached_property
    def _response(self) -> Array:
        """Frequency response of each joint's angle to its torque (joints, frequencies) [rad/(N m)]."""
        described = self.base.as_all(self.prior.value)
        inertia = np.diag(mass_matrix(self.base.chain, described, self.box.centre))
        turn = 2j * np.pi * np.arange(self._samples // 2 + 1) / self.box.period
        soft = 2.0 * np.pi * SOFTNESS
        response: Array = 1.0 / (np.maximum(inertia, 1e-6)[:, None] * (turn + soft) ** 2)
        return response

    @cached_property
    def _lengths(self) -> Array:
        """Prior standard deviation of each unknown; for friction and offset, the joint's RMS torque."""
        friction = np.repeat(self._level_of_joint[None, :], 3, axis=0).reshape(-1)
        return np.concatenate((self.prior.std, friction))

    @cached_property
    def _motions(self) -> Array:
        """Regressor of the base parameters for the other motions (joints, samples, base parameters)."""
        rng = np.random.default_rng(0)
        paths = [self.box.path(self.box.draw(rng), self._samples) for _ in range(OTHERS)]
        parts = [self.base.regressor(path.position, path.velocity, path.acceleration) for path in paths]
        return np.concatenate(parts, axis=1)

    @cached_property
    def _level_of_joint(self) -> Array:
        """RMS torque of the other motions (joints,) [N m]."""
        level: Array = np.sqrt(np.mean((self._motions @ self.prior.value) ** 2, axis=1)) + 1e-9
        return level

    @cached_property
    def _level(self) -> Array:
        level: Array = self._level_of_joint * np.sqrt(self._motions.shape[1])
        return level

    @cached_property
    def _products(self) -> Array:
        """Products of the regressor's columns for the other motions, in units of the prior's standard deviations,
        summed over the samples (joints, base parameters, base parameters).
        """
        others = self._motions * self.prior.std
        products: Array = np.swapaxes(others, 1, 2) @ others
        return products
