"""Comparison of other identification methods, each tuned and timed, on the same settled period.

All methods receive the same positions and commands. The commands are delayed by the time that hil estimated in stage 1,
so that no other method has to estimate the delay. Each method is tuned by trying several settings and keeping those
whose simulation is closest to the recording; only the run time with these settings is reported.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import InverseDynamics, fit_inverse_dynamics
from hil.estimator.baselines.kalman import Filter, Filtered, fit_by_kalman
from hil.estimator.baselines.paper_lines import fit_linearised
from hil.estimator.baselines.rls import fit_recursively
from hil.estimator.data.joined_periods import joined
from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import EstimationError
from hil.estimator.fit.stage1 import fit_lines
from hil.estimator.selection.prediction import prediction_rms

CUTOFFS = (6.0, 10.0, 15.0, 25.0, 40.0)  # Hz
HIGHEST_SHARE = 0.45  # highest cut-off frequency as a fraction of the sampling rate; a filter needs less than a half
WIDTHS = (0.007, 0.02, 0.05, 0.15)  # rad/s
VELOCITY_NOISES = (1e-4, 1e-3, 1e-2, 1e-1)  # rad/s per sqrt(s)
SHORT = 0.5  # s; length of the simulations by which settings are compared
PERIODS = 3  # repetitions of the settled period joined end to end for the filters, which need time to converge

Fit = InverseDynamics | Filtered
Setting = tuple[float, float]


@dataclass(frozen=True)
class Peer:
    """Result of another identification method."""

    name: str
    parameters: dict[str, float]
    """Base parameters, and any other parameters needed to simulate the result, by name [SI]."""
    std: dict[str, float]
    """Standard errors as reported by the method, by name [SI]."""
    seconds: float
    """Run time with the chosen settings [s]."""
    settings: str
    """Description of the chosen settings."""
    tried: int
    """Number of settings tried."""


def compare_peers(period: SettledPeriod, length: float | None, gravity: float) -> Iterator[Peer]:
    """Yield the results of IDIM-LS, RLS, EKF, UKF and the linearised method of Zhu et al. on one settled period.

    length: length of link 1 [m]; gravity: acceleration of gravity [m/s^2]. The method of Zhu et al. needs both to
    separate the inertias; if `length` is None, this method is skipped on an arm of two joints.
    """
    recording = joined(period, 1)
    delay = fit_lines(period).delay

    def inverse(setting: Setting) -> Fit:
        return fit_inverse_dynamics([recording], setting[0], setting[1], delay)

    def recursive(setting: Setting) -> Fit:
        return fit_recursively([recording], setting[0], setting[1], delay)

    highest = HIGHEST_SHARE * period.rate
    cutoffs = [cutoff for cutoff in CUTOFFS if cutoff <= highest] or [highest]
    filters = tuple(product(cutoffs, WIDTHS))
    words = "cut-off {:g} Hz, Coulomb width {:g} rad/s"
    idim = _best("idim_ls", inverse, filters, words, recording, delay)
    yield idim
    yield _best("rls", recursive, filters, words, recording, delay)
    long = joined(period, PERIODS)
    start = np.array([idim.parameters[name] for name in idim.std])
    for kind in ("ekf", "ukf"):
        yield _best_filter(kind, long, start, recording, delay)
    if period.joints == 1 or length is not None:
        began = time.perf_counter()
        linear = fit_linearised(period, length, gravity)
        seconds = time.perf_counter() - began
        yield Peer("paper", linear.parameters | {"delay": delay}, linear.std, seconds, linear.remark, 1)


def _best_filter(kind: Filter, long: Recording, start: Array, recording: Recording, delay: float) -> Peer:
    def run(setting: Setting) -> Fit:
        return fit_by_kalman(long, start, kind, setting[0], setting[1], delay)

    settings = tuple(product(WIDTHS[:2], VELOCITY_NOISES))
    words = "Coulomb width {:g} rad/s, velocity noise {:g} rad/s/sqrt(s)"
    return _best(kind, run, settings, words, recording, delay)


def _best(
    name: str,
    fit: Callable[[Setting], Fit],
    settings: tuple[Setting, ...],
    words: str,
    recording: Recording,
    delay: float,
) -> Peer:
    found: list[tuple[float, Peer]] = []
    for setting in (settings[0], *settings):  # the first one twice, so that compilation is not timed
        began = time.perf_counter()
        try:
            result = fit(setting)
        except EstimationError:
            continue
        seconds = time.perf_counter() - began
        width = setting[1] if name in {"idim_ls", "rls"} else setting[0]
        parameters = dict(zip(result.names, result.value.tolist(), strict=True)) | {"delay": delay}
        parameters |= {f"coulomb_width_{joint + 1}": width for joint in range(recording.joints)}
        std = dict(zip(result.names, result.std.tolist(), strict=True))
        peer = Peer(name, parameters, std, seconds, words.format(*setting), len(settings))
        found.append((_misfit(recording, parameters), peer))
    if not found:
        raise EstimationError(f"{name} failed with each of its {len(settings)} settings")
    return min(found, key=lambda pair: pair[0])[1]


def _misfit(recording: Recording, parameters: Mapping[str, float]) -> float:
    rms = prediction_rms([recording], parameters, SHORT, recording.joints)
    return float(np.sum(rms / recording.filled().std(axis=1)))
