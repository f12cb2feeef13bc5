"""`hil compare`: apply other methods to the recording of a run and compare them with its result."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hil.config.schema import Config
from hil.errors import ConfigError
from hil.estimation.comparison.chain_compare import compare_chain, worst_chain_error
from hil.estimation.model_from_config import voltage_driven, wanted_model
from hil.estimation.settled_period import settled_period
from hil.estimation.truth import in_file_unit, true_parameters
from hil.estimator.baselines.compare import Peer, compare_peers
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import EstimationError
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.selection.prediction import settled_prediction_error
from hil.plan.plan import HELD_OUT, IDENTIFY
from hil.results.json_form import to_json
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder, write_json

SCHEMA = 1
OURS = "hil"
OURS_PLAIN = "hil_coulomb"
"""Name of hil's estimate with the friction model of mujoco.sysid, for a fair comparison of computing times."""


@dataclass(frozen=True)
class MethodResult:
    """The entry of one method in compare.json: parameters and standard errors by name [SI], computing time [s].

    settings_tried: number of settings tried; the best result is reported. worst_relative_error: largest relative error
    of inertias, gravity and friction, on a fake arm only. held_out_rms: open-loop prediction error of the held-out
    multisine relative to the RMS of its motion, for the worst joint; None if the simulation does not settle or there
    was no such multisine.
    """

    parameters: Mapping[str, float]
    std: Mapping[str, float]
    seconds: float
    settings: str
    settings_tried: int
    held_out_rms: float | None
    worst_relative_error: float | None = None
    worst_parameter: str | None = None


@dataclass(frozen=True)
class Comparison:
    """The contents of compare.json: every method's result for one settled period, and a fake arm's true parameters."""

    schema: int
    config: str
    truth: Mapping[str, float] | None
    methods: Mapping[str, MethodResult]


def compare_run(run: RunFolder, mujoco: bool) -> Comparison:
    """Apply every method to the settled period of `run` and write compare.json to its folder.

    Raises HilError, EstimationError.
    """
    config, facts = run.load_config(), run.load_facts()
    if config.is_chain:
        return _compare_chain(run, facts.config, mujoco)
    samples = load_samples(run.samples_path, len(config.joints))
    period = settled_period(config, facts, samples, IDENTIFY)
    held_out = settled_period(config, facts, samples, HELD_OUT) if HELD_OUT in facts.segments else None
    truth = true_parameters(config)
    peers = {peer.name: peer for peer in all_methods(config, period, truth, mujoco)}
    methods = {name: judged(peer, truth_for(peer, truth, config), held_out) for name, peer in peers.items()}
    compared = Comparison(SCHEMA, facts.config, truth_for(peers[OURS], truth, config), methods)
    write_json(run.path / "compare.json", to_json(compared))
    return compared


def _compare_chain(run: RunFolder, config: str, mujoco: bool) -> Comparison:
    true, peers, judge = compare_chain(run, mujoco)
    methods, shown = {}, run.load_config()
    for name, peer in peers.items():
        truth = truth_for(peer, true, shown)
        worst, error = (None, None) if not truth else worst_chain_error(peer.parameters, truth)
        methods[name] = _entry(peer, judge.error(peer.parameters), worst, error)
    compared = Comparison(SCHEMA, config, truth_for(peers[OURS], true, shown), methods)
    write_json(run.path / "compare.json", to_json(compared))
    return compared


def truth_for(peer: Peer, truth: Mapping[str, float] | None, config: Config) -> Mapping[str, float] | None:
    """Return the true parameters, scaled to the torque constants that a method's result assumes."""
    return None if truth is None else in_file_unit(truth, config, peer.parameters, len(config.joints)).values


def all_methods(
    config: Config, period: SettledPeriod, truth: Mapping[str, float] | None, mujoco: bool
) -> Iterator[Peer]:
    """Yield hil's own estimate, then those of the other methods."""
    ours = _ours(period, OURS, wanted_model(config.model, period.joints, voltage_driven(config)))
    yield ours
    length = link_length(config)
    yield from compare_peers(period, length, config.arm.gravity)
    if mujoco:
        from hil.estimation.comparison.mujoco_peer import fit_with_mujoco

        if length is None and period.joints == 2:
            raise ConfigError("mujoco.sysid needs the length of link 1: add length_1 under [known].")
        centre = {name: ours.parameters[name] for name in ours.std if name in ours.parameters}
        centre |= truth_for(ours, truth, config) or {}
        yield _ours(period, OURS_PLAIN, Model(period.joints, "coulomb", "delay"))
        yield fit_with_mujoco(period, centre, length or 0.0, config.arm.gravity)


def link_length(config: Config) -> float | None:
    """Length of link 1 [m] from the fake arm or [known]; None if unknown."""
    if config.known is not None and config.known.length_1 is not None:
        return config.known.quantities()["length_1"].value
    if config.is_fake and config.fake is not None and config.fake.arm is not None:
        return config.fake.arm.links[0].length
    return None


def judged(peer: Peer, truth: Mapping[str, float] | None, held_out: SettledPeriod | None) -> MethodResult:
    """Evaluate one method for compare.json."""
    name, worst = (None, None) if not truth else worst_error(peer.parameters, truth)
    return _entry(peer, None if held_out is None else _held_out(held_out, peer.parameters), name, worst)


def _entry(peer: Peer, held_out: float | None, name: str | None, worst: float | None) -> MethodResult:
    return MethodResult(
        parameters=peer.parameters,
        std=peer.std,
        seconds=round(peer.seconds, 6),
        settings=peer.settings,
        settings_tried=peer.tried,
        held_out_rms=held_out,
        worst_relative_error=worst,
        worst_parameter=name,
    )


def worst_error(parameters: Mapping[str, float], truth: Mapping[str, float]) -> tuple[str, float]:
    """Return the inertia, gravity or friction parameter with the largest relative error, and that error.

    Offsets are left out because they are near zero. A parameter that the method does not estimate counts as 0, so its
    relative error is 1.
    """
    errors = {
        name: abs(parameters.get(name, 0.0) / true - 1.0)
        for name, true in truth.items()
        if true and not name.startswith("offset")
    }
    worst = max(errors, key=lambda name: errors[name])
    return worst, errors[worst]


def _ours(period: SettledPeriod, name: str, model: Model) -> Peer:
    began = time.perf_counter()
    estimate = identify(period, model)
    seconds = time.perf_counter() - began
    std = dict(zip(estimate.names, estimate.std.tolist(), strict=True))
    settings = model.description
    return Peer(name, estimate.parameters, std, seconds, settings, 1)


def _held_out(period: SettledPeriod, parameters: Mapping[str, float]) -> float | None:
    try:
        error = float(settled_prediction_error(period, parameters).max())
    except (EstimationError, ValueError, OverflowError, ZeroDivisionError):
        return None
    return error if np.isfinite(error) else None
