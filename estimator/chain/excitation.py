"""Excitation of a chain by paths that are finite Fourier series of the joint angles.

Swevers, Ganseman, Tukel, De Schutter, Van Brussel, IEEE Transactions on Robotics and Automation 13 (1997) 730. A path
is played as the torque that a rough model of the arm needs for it, plus a software spring and damper. Among several
paths with random phases, the one that best determines the base parameters as a whole is chosen.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.base_parameters import BaseParameters
from hil.estimator.chain.prior import Prior
from hil.estimator.errors import ExcitationError

CANDIDATES = 24
LOOKED_AT = 200  # samples of each candidate that are evaluated
NOISE = 0.02  # assumed residual of a candidate's regression, as a fraction of each joint's torque


@dataclass(frozen=True)
class Path:
    """One period of a motion (joints, samples) [rad, rad/s, rad/s^2]."""

    position: Array
    velocity: Array
    acceleration: Array


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
    """Design a path with harmonics up to `highest` [Hz], in which each joint stays within limits.

    The joints stay within `swing` (joints,) [rad] of `centre` (joints,) [rad] and below `speed` (joints,) [rad/s].
    rate: samples per second; period [s]; prior: rough parameters, whose uncertainty weights the information. Raises
    ExcitationError.
    """
    count = int(np.floor(highest * period + 1e-9))
    if count < 2 or highest > rate / 8 or min(swing.min(), speed.min()) <= 0.0:
        raise ExcitationError(
            f"a path of {period:g} s with harmonics up to {highest:g} Hz at {rate:g} samples/s, swing {swing.min():g} "
            f"rad, speed {speed.min():g} rad/s: needs at least two harmonics below an eighth of the rate, and a "
            "positive swing and speed"
        )
    rng = np.random.default_rng(seed)
    paths = [_candidate(rng, rate, period, count, centre, swing, speed) for _ in range(CANDIDATES)]
    return max(paths, key=lambda path: _certainty(base, prior, path))


def _candidate(
    rng: np.random.Generator, rate: float, period: float, count: int, centre: Array, swing: Array, speed: Array
) -> Path:
    samples = round(rate * period)
    lines = np.zeros((centre.size, samples // 2 + 1), dtype=np.complex128)
    lines[:, 1 : count + 1] = rng.standard_normal((centre.size, count)) + 1j * rng.standard_normal((centre.size, count))
    turn = 2j * np.pi * np.arange(lines.shape[1]) / period
    position, velocity, acceleration = (np.fft.irfft(lines * turn**order, samples, axis=1) for order in range(3))
    scale = np.minimum(swing / np.abs(position).max(axis=1), speed / np.abs(velocity).max(axis=1))[:, None]
    return Path(centre[:, None] + scale * position, scale * velocity, scale * acceleration)


def _certainty(base: BaseParameters, prior: Prior, path: Path) -> float:
    """Return the log determinant of the information about the base parameters, relative to that of the prior."""
    some = slice(0, None, max(1, path.position.shape[1] // LOOKED_AT))
    Y = base.regressor(path.position[:, some], path.velocity[:, some], path.acceleration[:, some])
    level = np.sqrt(np.mean((Y @ prior.value) ** 2, axis=1)) + 1e-9
    rows = (Y * prior.std / (NOISE * level[:, None, None])).reshape(-1, base.count)
    return float(np.linalg.slogdet(rows.T @ rows + np.eye(base.count))[1])
