"""Multisines: sums of cosines on chosen harmonics of one period, with phases that keep the peaks low.

The crest factor is lowered by minimising the L2p norm with increasing p: Guillaume, Schoukens, Pintelon, Kollar,
"Crest-factor minimization using nonlinear Chebyshev approximation methods", IEEE Trans. IM 40 (1991) 982. The authors
use Gauss-Newton steps, whose cost is lines^2 x samples. Here, the wave and its gradient take one FFT each, and the
steps are those of L-BFGS, which also reaches lower peaks (1.40 instead of 1.44 for 25 lines).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt

from hil.estimator.arrays import Array
from hil.estimator.errors import ExcitationError
from hil.estimator.excitation.harmonics import harmonics_within
from hil.estimator.excitation.lbfgs import descend

Harmonics = npt.NDArray[np.int64]

DETECTION = 4  # one of this many odd lines is left unexcited
NORMS = (4, 16, 64)  # p of the L2p norms, in order of use
FINAL_NORMS = (64, 256)  # the same p, for the best candidate
STARTS = 4  # number of random initial guesses of the phases, in addition to Schroeder's
ITERATIONS = 40  # per norm
OVERSAMPLING = 8  # samples per cycle of the highest line while phases are optimised
FINAL_OVERSAMPLING = 24  # the same for the best candidate, so that no peaks remain between samples


@dataclass(frozen=True)
class Multisine:
    """One period of torque for each joint: the sum of amplitude * cos(2 pi line t / period + phase)."""

    rate: float
    """Sampling rate [1/s]."""
    period: float
    """Length of the period [s]; a whole number of samples."""
    lines: tuple[tuple[int, ...], ...]
    """Excited harmonics of each joint."""
    amplitudes: tuple[tuple[float, ...], ...]
    """Amplitude of each line [N m]."""
    phases: tuple[tuple[float, ...], ...]
    """Phase of each line [rad]."""
    torque: Array
    """One period (joints, samples) [N m], each value held until the next sample."""

    @property
    def joints(self) -> int:
        return len(self.lines)

    @property
    def samples(self) -> int:
        return int(self.torque.shape[1])

    @property
    def crest_factor(self) -> Array:
        """Peak value of each joint's samples relative to their RMS (joints,)."""
        peak: Array = np.abs(self.torque).max(axis=1) / np.sqrt(np.mean(self.torque**2, axis=1))
        return peak


def counted(count: int, noun: str) -> str:
    """Return the number followed by the noun, in the plural unless the number is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def zippered_lines(period: float, band: tuple[float, float], joints: int) -> tuple[tuple[int, ...], ...]:
    """Assign the harmonics of 1/`period` [s] within `band` [Hz] to the joints in turn.

    Raises ExcitationError if the band has fewer lines than joints.
    """
    lines = harmonics_within(period, *band)
    if len(lines) < joints:
        raise ExcitationError(
            f"the band {band[0]:g} to {band[1]:g} Hz contains {counted(len(lines), 'harmonic')} of a "
            f"period of {period:g} s, but {joints} joints need one each: widen the band or lengthen the period"
        )
    return tuple(tuple(lines[joint::joints]) for joint in range(joints))


def detecting_lines(period: float, band: tuple[float, float], joints: int, seed: int) -> tuple[tuple[int, ...], ...]:
    """Assign odd harmonics to the joints in turn, but leave one line in every DETECTION unexcited, chosen at random.

    On the unexcited lines, odd or even, the arm's nonlinear distortion becomes visible: see
    `hil.estimator.selection.distortion`. Raises ExcitationError if fewer lines than joints are left.
    """
    every = sorted(line for lines in zippered_lines(period, band, 1) for line in lines if line % 2 == 1)
    random = np.random.default_rng(seed)
    groups = [every[first : first + DETECTION] for first in range(0, len(every), DETECTION)]
    # If the highest group is incomplete, it keeps its lines.
    silent = {int(random.choice(group)) for group in groups if len(group) == DETECTION}
    kept = [line for line in every if line not in silent]
    if len(kept) < joints:
        raise ExcitationError(
            f"the band {band[0]:g} to {band[1]:g} Hz contains {counted(len(kept), 'usable odd harmonic')} of a "
            f"period of {period:g} s, but {joints} joints need one each: widen the band or lengthen the period"
        )
    return tuple(tuple(kept[joint::joints]) for joint in range(joints))


def design_multisine(
    rate: float,
    period: float,
    lines: Sequence[Sequence[int]],
    peak_torque: Sequence[float],
    seed: int,
) -> Multisine:
    """Return a multisine of equal amplitudes with a low crest factor.

    Args:
        rate: sampling rate [1/s].
        period: length of the period [s].
        lines: harmonics of each joint.
        peak_torque: largest sample of each joint [N m].
        seed: random seed; the same seed gives the same phases to the last bit.

    Raises:
        ExcitationError: for a period that is not a whole number of samples, lines outside (0, samples / 2) or assigned
            twice, or a peak that is not positive.
    """
    samples = _whole_samples(rate, period)
    _check_lines(lines, samples)
    _check_peaks(peak_torque, len(lines))
    phases = []
    amplitudes = []
    torque = np.empty((len(lines), samples))
    for joint, (harmonics, peak) in enumerate(zip(lines, peak_torque, strict=True)):
        order = np.asarray(harmonics, dtype=np.int64)
        phase = _low_crest_phases(tuple(order.tolist()), seed, joint)
        wave = _wave(order, phase, samples)
        amplitude = peak / float(np.abs(wave).max())
        torque[joint] = amplitude * wave
        phases.append(tuple(phase.tolist()))
        amplitudes.append((amplitude,) * len(harmonics))
    shared = tuple(tuple(int(line) for line in harmonics) for harmonics in lines)
    return Multisine(rate, period, shared, tuple(amplitudes), tuple(phases), torque)


def _whole_samples(rate: float, period: float) -> int:
    samples = round(rate * period)
    if samples < 1 or abs(samples - rate * period) > 1e-6:
        raise ExcitationError(
            f"a period of {period:g} s at {rate:g} samples/s is {rate * period:g} samples: "
            "choose a period that is a whole number of samples"
        )
    return samples


def _check_lines(lines: Sequence[Sequence[int]], samples: int) -> None:
    taken: dict[int, int] = {}
    for joint, harmonics in enumerate(lines, start=1):
        if not harmonics:
            raise ExcitationError(f"joint {joint} has no lines: give it at least one")
        for line in harmonics:
            if not 0 < line < samples / 2:
                raise ExcitationError(
                    f"line {line} of joint {joint} is outside 1 to {(samples - 1) // 2}, "
                    f"the range that {samples} samples can represent"
                )
            if line in taken:
                raise ExcitationError(
                    f"line {line} is given to joint {taken[line]} and joint {joint}: each line must belong to one joint"
                )
            taken[line] = joint


def _check_peaks(peak_torque: Sequence[float], joints: int) -> None:
    if len(peak_torque) != joints:
        raise ExcitationError(f"{len(peak_torque)} peak torques for {joints} joints: give one per joint")
    for joint, peak in enumerate(peak_torque, start=1):
        if not (peak > 0.0 and math.isfinite(peak)):
            raise ExcitationError(f"peak torque of joint {joint} is {peak:g} N m: it must be positive")


def _wave(order: Harmonics, phase: Array, samples: int) -> Array:
    """Return the sum of cosines of amplitude 1 over one period (samples,)."""
    spectrum = np.zeros(samples // 2 + 1, dtype=np.complex128)
    spectrum[order] = 0.5 * samples * np.exp(1j * phase)
    return np.fft.irfft(spectrum, samples)


@lru_cache(maxsize=512)  # the search for the largest torque rescales the same wave many times
def _low_crest_phases(harmonics: tuple[int, ...], seed: int, joint: int) -> Array:
    """Return the best phases [rad] of several optimisations, starting from perturbed Schroeder phases and from random
    ones.
    """
    order, random = np.asarray(harmonics, dtype=np.int64), np.random.default_rng((seed, joint))
    count = order.size
    schroeder = -np.pi * np.arange(count) * np.arange(1, count + 1) / count
    # Plain Schroeder phases would give every seed the same wave, so they are shifted in time and perturbed.
    starts = [schroeder + order * random.uniform(0.0, 2.0 * np.pi) + random.uniform(-1.0, 1.0, count)]
    starts += [random.uniform(0.0, 2.0 * np.pi, count) for _ in range(STARTS)]
    from scipy.fft import next_fast_len  # slow to import, and few commands need it

    coarse = next_fast_len(OVERSAMPLING * int(order.max()), real=True)
    fine = next_fast_len(FINAL_OVERSAMPLING * int(order.max()), real=True)

    def peak(phase: Array) -> float:
        return float(np.abs(_wave(order, phase, fine)).max())

    best = min((_flattened(order, start, coarse, NORMS) for start in starts), key=peak)
    best = min((best, _flattened(order, best, fine, FINAL_NORMS)), key=peak)
    phases = np.asarray(np.mod(best, 2.0 * np.pi))
    phases.flags.writeable = False
    return phases


def _flattened(order: Harmonics, phase: Array, samples: int, norms: tuple[int, ...]) -> Array:
    """Return phases that lower the wave's peak, by minimising successive L2p norms."""
    for p in norms:
        phase = descend(partial(_norm, order=order, samples=samples, p=p), phase, ITERATIONS)
    return phase


def _norm(phase: Array, order: Harmonics, samples: int, p: int) -> tuple[float, Array]:
    """Return the logarithm of the wave's L2p norm, and its gradient with respect to the phases (lines,)."""
    wave = _wave(order, phase, samples)
    peak = float(max(wave.max(), -wave.min()))
    steep = (wave / peak) ** (2 * p - 1)
    total = float(np.add.reduce(steep * wave)) / peak
    # The derivative with respect to a phase is -sin; its sum over time with `steep` is a Fourier line of `steep`.
    lines = np.fft.rfft(steep)[order]
    gradient = np.imag(np.exp(-1j * phase) * lines) / (peak * total)
    return math.log(total) / (2 * p) + math.log(peak), gradient
