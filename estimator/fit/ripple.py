"""Period of torque ripple and cogging over the joint angle: a scan that needs no initial guess.

For each number of cycles per turn, the regression on Fourier coefficients gets two more columns: torque times the sine
and the cosine of that multiple of the angle or, for cogging, the sine and the cosine themselves. The best number is the
likelihood's initial guess.
"""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.fourier import PeriodicMotion, held_lines, lines_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.fit.stage1 import LinearEstimate
from hil.estimator.models.regressor import regressor
from hil.estimator.options import LinearOptions

Wave = Literal["ripple", "cogging"]
WAVES: tuple[Wave, ...] = get_args(Wave)
"""Options that add a torque that is periodic over the joint angle: proportional to the motor torque (ripple) or
independent of it (cogging).
"""
CYCLES = np.arange(3.0, 40.01, 0.25)  # cycles per turn to try; fewer are due to gravity, cables or encoders
COULOMB_WIDTH = LinearOptions().coulomb_width
STRIBECK_VELOCITY = 0.15  # rad/s: a rough value suffices to separate the Stribeck rise from the ripple


def find_waves(periods: Sequence[SettledPeriod], linear: LinearEstimate, wave: Wave) -> dict[str, float]:
    """Return each joint's cycles per turn and the sine and cosine parts of its ripple [1] or cogging [N m], by name."""
    found: dict[str, float] = {}
    for joint in range(periods[0].joints):
        each = [
            _prepared(period, motion, harmonics, joint, linear.delay)
            for period, motion, harmonics in zip(periods, linear.motions, linear.harmonics, strict=True)
        ]
        Q = linalg.qr(np.concatenate([columns for columns, _, _, _ in each]))[0]
        goal = _without(Q, np.concatenate([torque for _, torque, _, _ in each]))
        best: tuple[float, float, Array] = (-1.0, 0.0, np.zeros(2))
        for cycles in CYCLES.tolist():
            waves = [
                _waves(torque if wave == "ripple" else np.ones_like(torque), angle, cycles, size)
                for _, size, torque, angle in _parts(each)
            ]
            extra = _without(Q, np.concatenate(waves))
            share = np.asarray(linalg.lstsq(extra, goal, rcond=None)[0], dtype=np.float64)
            explained = float(goal @ goal - np.sum((goal - extra @ share) ** 2))
            best = max(best, (explained, cycles, share), key=lambda trial: trial[0])
        # Motor torque = commanded torque (1 + ripple) + cogging, so the fitted coefficients have the opposite sign.
        found |= {f"{wave}_cycles_{joint + 1}": best[1]}
        found |= {f"{wave}_sin_{joint + 1}": -float(best[2][0]), f"{wave}_cos_{joint + 1}": -float(best[2][1])}
    return found


def _parts(each: list[tuple[Array, Array, Array, Array]]) -> list[tuple[Array, int, Array, Array]]:
    return [(columns, columns.shape[0] // 2, torque, angle) for columns, _, torque, angle in each]


def _prepared(
    period: SettledPeriod, motion: PeriodicMotion, harmonics: int, joint: int, delay: float
) -> tuple[Array, Array, Array, Array]:
    """Return the Fourier coefficients of a joint's columns and torque as real numbers, and the joint's torque and angle
    over time.
    """
    Y = regressor(motion.position, motion.velocity, motion.acceleration, COULOMB_WIDTH)[joint]
    velocity = motion.velocity[joint]
    sign = np.tanh(velocity / COULOMB_WIDTH)
    lines = held_lines(period.torque, period.rate, delay - period.command_to_sample)[joint]
    kept = lines.copy()
    kept[harmonics + 1 :] = 0.0
    torque = np.fft.irfft(kept * period.samples, period.samples)
    friction = (sign * np.exp(-((velocity / STRIBECK_VELOCITY) ** 2)), sign * np.abs(torque), np.abs(velocity))
    # Zero errors, cables and saturation have effects that resemble slow ripple.
    angles = np.cumsum(motion.position, axis=0)
    slow = (*np.sin(angles), motion.position[joint], torque**3, *np.sin(2.0 * motion.position))
    columns = np.column_stack((Y, *friction, *slow))
    columns = columns[:, np.abs(columns).max(axis=0) > 0.0]
    rows = _real(lines_of(columns.T)[:, : harmonics + 1]).T
    return rows, _real(lines[None, : harmonics + 1])[0], torque, motion.position[joint]


def _waves(size: Array, angle: Array, cycles: float, lines: int) -> Array:
    waves = np.stack((size * np.sin(cycles * angle), size * np.cos(cycles * angle)))
    return _real(lines_of(waves)[:, :lines]).T


def _real(lines: np.ndarray) -> Array:
    return np.concatenate((lines.real, lines.imag), axis=1)


def _without(Q: Array, b: Array) -> Array:
    """Return the component of `b` orthogonal to the columns of `Q`."""
    left: Array = b - Q @ (Q.T @ b)
    return left
