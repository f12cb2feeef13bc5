"""Fourier coefficients of a settled period, and what is computed from them: noise, cut-off, exact derivatives, and held
commands.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array, Mask

Lines = npt.NDArray[np.complex128]

SIGNAL_OVER_NOISE = 4.0  # power ratio above which a band of lines counts as signal
BAND = 8  # number of lines that are evaluated together


_DRAWS = 16  # draws of interpolated white noise, for a standard deviation accurate to about 1 %
_AHEAD = np.array((3.0, -3.0, 1.0))
"""Weights of the three nearest samples, nearest first, for quadratic extrapolation by one sample."""


@dataclass(frozen=True)
class PeriodicMotion:
    """Angles, velocities and accelerations of one period (joints, samples) [rad, rad/s, rad/s^2]."""

    position: Array
    velocity: Array
    acceleration: Array


def lines_of(signal: Array) -> Lines:
    """Return the coefficients c_k (..., samples // 2 + 1) of a period (..., samples): the sum of c_k exp(j k w0 t)."""
    return np.asarray(np.fft.rfft(signal, axis=-1) / signal.shape[-1])


def noise_power(lines: Lines) -> Array:
    """Return the mean |c|^2 of the noise per line (joints,), from the upper half of the lines, which are not
    excited.

    The median of an exponentially distributed power is log 2 times its mean and is robust to a few outlying lines. Odd
    and even lines are evaluated separately: the rounding error of a motion whose second half mirrors its first has no
    even lines at all.
    """
    upper = np.abs(lines[:, lines.shape[1] // 2 :]) ** 2
    medians = [np.median(upper[:, first::2], axis=1) for first in (0, 1)]
    noise: Array = np.mean(medians, axis=0) / np.log(2.0)
    return noise


def white_noise(position: Array, valid: Mask | None = None) -> Array:
    """Return the standard deviation (joints,) [rad] of the white noise in one period of angles (joints, samples) [rad].

    It is estimated from the upper quarter of the lines, far above the frequencies of any motion. A linear trend is
    removed first, since the jump between the ends of a period would spread over all lines.

    valid: samples that were received (joints, samples); the others are interpolated linearly, and the result is
    corrected for the effect of interpolation on white noise.
    """
    noise = _upper_noise(without_jump(position))
    if valid is None or valid.all():
        return noise
    of_valid: Array = noise / np.array([_interpolated_noise(row) for row in valid])
    return of_valid


def without_jump(position: Array) -> Array:
    """Return a period (joints, samples) without the linear trend from its beginning to its end."""
    samples = position.shape[1]
    closed: Array = position - _jump(position)[:, None] * (np.arange(samples) / samples)
    return closed


def slow_part(position: Array, lines: int) -> Array:
    """Return the part of a period that its first `lines` Fourier coefficients describe (joints, samples)."""
    kept = np.fft.rfft(position, axis=1)
    kept[:, lines:] = 0.0
    return np.asarray(np.fft.irfft(kept, position.shape[1], axis=1))


def _upper_noise(position: Array) -> Array:
    lines = lines_of(position)
    upper = lines[:, lines.shape[1] // 2 :]
    noise: Array = np.sqrt(noise_power(upper) * position.shape[1])
    return noise


def _interpolated_noise(valid: Mask) -> float:
    """Return the noise estimate for unit white noise whose samples are interpolated except at `valid` (samples,)."""
    if valid.all() or not valid.any():
        return 1.0
    return float(np.sqrt(np.mean(np.square(_upper_noise(interpolated_noise(valid))))))


def interpolated_noise(valid: Mask) -> Array:
    """Return white noise of standard deviation 1 (draws, samples), interpolated wherever samples are not `valid`."""
    index = np.arange(valid.size)
    drawn = np.random.default_rng(_DRAWS).standard_normal((_DRAWS, valid.size))
    drawn[:, ~valid] = [np.interp(index[~valid], index[valid], row[valid]) for row in drawn]
    return drawn


def _jump(position: Array) -> Array:
    """Return the gap (joints,) between the ends of a period (joints, samples), less the motion in one sampling
    interval.

    At low rates, a joint moves by many encoder steps from the last sample of a period to the first of the next.
    """
    if position.shape[1] < len(_AHEAD):
        return np.zeros(len(position))
    after = position[:, : -len(_AHEAD) - 1 : -1] @ _AHEAD - position[:, 0]
    before = position[:, -1] - position[:, : len(_AHEAD)] @ _AHEAD
    jump: Array = 0.5 * (after + before)
    return jump


def cut_off(lines: Lines) -> int:
    """Return the highest harmonic with signal on any joint, determined from the mean power of bands of lines."""
    count = (lines.shape[1] - 1) // BAND
    power = np.abs(lines[:, 1 : 1 + count * BAND]) ** 2
    bands = power.reshape(lines.shape[0], count, BAND).mean(axis=2)
    signal = np.nonzero((bands > SIGNAL_OVER_NOISE * noise_power(lines)[:, None]).any(axis=0))[0]
    return int(BAND * (signal[-1] + 1)) if signal.size else 1


def motion_of(lines: Lines, harmonics: int, fundamental: float, samples: int) -> PeriodicMotion:
    """Return the motion reconstructed from the lines up to `harmonics`.

    The derivatives are exact: each multiplies line k by j k w0.
    """
    kept = np.zeros_like(lines)
    kept[:, : harmonics + 1] = lines[:, : harmonics + 1]
    turn = 1j * fundamental * np.arange(lines.shape[1])
    waves = (np.fft.irfft(samples * kept * turn**order, samples, axis=-1) for order in range(3))
    return PeriodicMotion(*waves)


def held_lines(command: Array, rate: float, delay: float) -> Lines:
    """Return the lines of a command (joints, samples) after a zero-order hold and a delay of `delay` [s].

    The hold scales line k by sinc(f_k / rate) and delays it by half a sample. `delay` may be negative.
    """
    lines = lines_of(command)
    frequency = np.arange(lines.shape[-1]) * rate / command.shape[-1]
    held = np.sinc(frequency / rate) * np.exp(-2j * np.pi * frequency * (0.5 / rate + delay))
    return np.asarray(lines * held)
