"""`hil compare` for spatial arms: both stages of hil, and filtered inverse dynamics, on one settled period."""

import time
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimation.chain_estimate import true_chain_parameters, wanted_chain_model
from hil.estimation.settled_period import settled_period
from hil.estimator.arrays import Array
from hil.estimator.baselines.compare import Peer
from hil.estimator.chain.choice import choose_chain
from hil.estimator.chain.fit.regression import fit_filtered
from hil.estimator.chain.fit.stage1 import COULOMB_WIDTH, fit_lines
from hil.estimator.chain.identify import identify_chain
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.simulation.prediction import predict
from hil.estimator.data.joined_periods import joined
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import EstimationError
from hil.plan.chain_model import known_chain
from hil.plan.plan import HELD_OUT, IDENTIFY
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder

CUTOFFS = (2.0, 4.0, 6.0, 10.0, 15.0, 25.0)  # Hz
LARGE = 0.1
"""Parameters below this fraction of the largest of their kind are left out of the comparison: near zero, a relative
error is meaningless.
"""


def compare_chain(run: RunFolder, mujoco: bool) -> tuple[Mapping[str, float] | None, dict[str, Peer], "Judge"]:
    """Apply every method to the settled period of `run`; return the true parameters if known, the results, and the
    object that evaluates their predictions.

    Raises HilError, EstimationError.
    """
    config, facts = run.load_config(), run.load_facts()
    if mujoco:
        raise ConfigError(
            f"{config.path}: --mujoco is for planar arms: mujoco.sysid differentiates a spatial arm's simulation "
            "numerically, which takes minutes per recording (benchmarks/chain.py has that comparison). Leave out "
            "--mujoco."
        )
    samples = load_samples(run.samples_path, len(config.joints))
    period = settled_period(config, facts, samples, IDENTIFY)
    held_out = settled_period(config, facts, samples, HELD_OUT) if HELD_OUT in facts.segments else None
    known = known_chain(config)
    judge = Judge(wanted_chain_model(config, known), held_out)
    peers = {peer.name: peer for peer in _methods(config, period, judge)}
    return true_chain_parameters(config, known), peers, judge


class Judge:
    """Predicts the held-out path with each method's parameters."""

    def __init__(self, model: ChainModel, held_out: SettledPeriod | None) -> None:
        self.model = model
        self._held_out = held_out

    def error(self, parameters: Mapping[str, float], period: SettledPeriod | None = None) -> float | None:
        """Prediction error relative to the motion's RMS, for the worst joint; None if nothing was held out or the
        simulation diverges. period: the period to predict, by default the held-out one.
        """
        shown = self._held_out if period is None else period
        if shown is None:
            return None
        try:
            error = float(relative_error(shown.position, predict(self.model, dict(parameters), shown)).max())
        except EstimationError:
            return None
        return error if np.isfinite(error) else None


def worst_chain_error(parameters: Mapping[str, float], truth: Mapping[str, float]) -> tuple[str, float]:
    """Return the base parameter or friction term with the largest relative error, and that error.

    Offsets are left out, and so are parameters that are small compared with others of the same kind (see LARGE).
    """
    kinds = {name: name.partition("_")[0] for name in truth if not name.startswith(("offset", "base_tilt"))}
    largest = {kind: max(abs(truth[name]) for name in kinds if kinds[name] == kind) for kind in set(kinds.values())}
    errors = {
        name: abs(parameters.get(name, 0.0) / truth[name] - 1.0)
        for name, kind in kinds.items()
        if truth[name] and abs(truth[name]) >= LARGE * largest[kind]
    }
    worst = max(errors, key=lambda name: errors[name])
    return worst, errors[worst]


def _methods(config: Config, period: SettledPeriod, judge: Judge) -> Iterator[Peer]:
    model, prior = judge.model, known_chain(config).prior
    began = time.perf_counter()
    if config.model.friction == "auto":
        ours = choose_chain(period, model, prior).estimate
    else:
        ours = identify_chain(period, model, prior)
    seconds = time.perf_counter() - began
    yield Peer("hil", ours.parameters, _by_name(ours.names, ours.std), seconds, ours.model.description, 1)
    began = time.perf_counter()
    linear = fit_lines([period], model, prior)
    seconds = time.perf_counter() - began
    words = "first stage alone: least squares on the period's Fourier coefficients"
    yield Peer(
        "fourier_lines", _simulated(model, linear.value), _by_name(model.linear_names, linear.std), seconds, words, 1
    )
    recording = joined(period, 2)  # the ends, which the filter distorts, are left out

    def filtered(cutoff: float) -> tuple[Array, Array]:
        return fit_filtered([recording], model, prior, cutoff, linear.delay)

    yield _best(filtered, judge, period)


def _best(fit: Callable[[float], tuple[Array, Array]], judge: Judge, period: SettledPeriod) -> Peer:
    """Return the result for the cut-off frequency that reproduces the fitted period best, as for planar arms."""
    model = judge.model
    found: list[tuple[float, Peer]] = []
    for cutoff in CUTOFFS:
        began = time.perf_counter()
        try:
            value, std = fit(cutoff)
        except EstimationError:
            continue
        seconds = time.perf_counter() - began
        parameters = _simulated(model, value)
        error = judge.error(parameters, period)
        words = f"cut-off {cutoff:g} Hz"
        peer = Peer("idim_ls", parameters, _by_name(model.linear_names, std), seconds, words, len(CUTOFFS))
        found.append((np.inf if error is None else error, peer))
    if not found:
        raise EstimationError(
            "the recording cannot be filtered at any cut-off: record for longer, or at a higher sample rate"
        )
    return min(found, key=lambda pair: pair[0])[1]


def _simulated(model: ChainModel, value: Array) -> dict[str, float]:
    """Parameters of a regression, including the width of the smoothed Coulomb step that the regression assumes."""
    named = dict(zip(model.linear_names, value.tolist(), strict=True))
    return named | {f"coulomb_width_{joint + 1}": COULOMB_WIDTH for joint in range(model.joints)}


def _by_name(names: tuple[str, ...], values: Array) -> dict[str, float]:
    return dict(zip(names, values.tolist(), strict=True))
