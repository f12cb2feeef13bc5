"""A path that excites a chain: finite Fourier series of the joint angles (Swevers, Ganseman, Tukel, De Schutter, Van
Brussel, IEEE Transactions on Robotics and Automation 13 (1997) 730).

Played as the torque that a rough model of the arm needs for it, with a spring and a damper in software around it. Of
several paths with random phases, the one that determines the base parameters best overall is chosen.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.base_parameters import BaseParameters
from hil.estimator.chain.prior import Prior
from hil.estimator.errors import ExcitationError

CANDIDATES = 24
LOOKED_AT = 200  # samples of each candidate
NOISE = 0.02  # of a joint's torque: what a candidate's regression is thought to leave


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
    """A path about `centre` (joints,) [rad] with harmonics up to `highest` [Hz], each joint within `swing` (joints,)
    [rad] of it and no faster than `speed` (joints,) [rad/s]. Raises ExcitationError."""
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
    """Logarithm of the determinant of the information about the base parameters, in units of the prior's."""
    some = slice(0, None, max(1, path.position.shape[1] // LOOKED_AT))
    Y = base.regressor(path.position[:, some], path.velocity[:, some], path.acceleration[:, some])
    level = np.sqrt(np.mean((Y @ prior.value) ** 2, axis=1)) + 1e-9
    rows = (Y * prior.std / (NOISE * level[:, None, None])).reshape(-1, base.count)
    return float(np.linalg.slogdet(rows.T @ rows + np.eye(base.count))[1])
