"""Both stages on the four-joint arm with stiction and Stribeck friction; described masses are off by 20 %."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.choice import choose_chain
from hil.estimator.chain.fit.regression import fit_filtered
from hil.estimator.chain.identify import ChainEstimate, identify_chain
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior, scale_precision
from hil.estimator.chain.model.tilt import TILT, tilt_between
from hil.estimator.chain.simulation.prediction import predict
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation
from hil.estimator.chain.simulation.stepping import JOINT_TERMS
from hil.estimator.data.recording import Recording
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ModelError


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return bench.set_up(bench.BENCHES[4], 1)


@pytest.fixture(scope="module")
def period(setup: bench.Setup) -> SettledPeriod:
    return bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101))


@pytest.fixture(scope="module")
def short_period(setup: bench.Setup) -> SettledPeriod:
    """For tests of what a fit finds, rather than of how accurate it is."""
    return bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101, 5.0))


@pytest.fixture(scope="module")
def estimate(setup: bench.Setup, period: SettledPeriod) -> ChainEstimate:
    return identify_chain(period, ChainModel(setup.base), setup.prior)


def test_torque_friction_and_residual(setup: bench.Setup, estimate: ChainEstimate) -> None:
    other = bench.path_of(bench.BENCHES[4], setup, 201)
    found = bench.errors(setup, estimate.value[: setup.base.count], other)
    assert found["torque_error_percent"] < 0.4
    assert found["base_median_percent"] < 0.1
    assert estimate.residual_steps.max() < 0.31
    for joint, drive in enumerate(setup.arm.drives, start=1):
        assert estimate.parameters[f"viscous_{joint}"] == pytest.approx(drive.viscous, rel=0.005)
        assert estimate.parameters[f"coulomb_{joint}"] == pytest.approx(drive.coulomb, rel=0.005)
    assert estimate.parameters["lag"] == pytest.approx(1e-3, abs=1e-4)


def test_stage_2_is_several_times_better_than_filtered_least_squares(
    setup: bench.Setup, period: SettledPeriod, estimate: ChainEstimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bench, "foretold", lambda *_: None)  # a figure of the benchmark that takes most of the time
    other = bench.path_of(bench.BENCHES[4], setup, 201)
    ours = bench.errors(setup, estimate.value[: setup.base.count], other)
    held_out = bench.record(bench.BENCHES[4], setup, other)
    classic = bench.classic(setup, period, held_out, other)
    assert classic["torque_error_percent"] < 5
    assert ours["torque_error_percent"] < classic["torque_error_percent"] / 4


def test_intervals_hold_the_truth(setup: bench.Setup, estimate: ChainEstimate) -> None:
    count = setup.base.count
    away = np.abs(estimate.value[:count] - setup.truth) / estimate.std[:count]
    assert np.mean(away < 1.96) > 0.85
    assert away.max() < 6


def test_it_foretells_a_motion_that_it_never_saw(setup: bench.Setup, estimate: ChainEstimate) -> None:
    other = bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 201))
    assert relative_error(other.position, predict(estimate.model, estimate.parameters, other)).max() < 0.005


def test_missing_samples_cost_little(setup: bench.Setup, period: SettledPeriod, estimate: ChainEstimate) -> None:
    holes = period.position.copy()
    holes[np.random.default_rng(1).random(holes.shape) < 0.02] = np.nan
    found = identify_chain(replace(period, position=holes), ChainModel(setup.base), setup.prior)
    np.testing.assert_array_less(np.abs(found.value - estimate.value), 4 * estimate.std + 1e-9)


def test_what_the_data_do_not_show_is_said(setup: bench.Setup, short_period: SettledPeriod) -> None:
    """With ten times coarser encoders, some base parameters come from the description."""
    step = 40 * short_period.position_step
    coarse = replace(
        short_period, position=np.round(short_period.position / step[:, None]) * step[:, None], position_step=step
    )
    found = identify_chain(coarse, ChainModel(setup.base, friction="coulomb"), setup.prior)
    assert found.from_prior
    assert set(found.from_prior) < set(setup.base.names)


def test_a_model_of_other_joints_is_refused(setup: bench.Setup, period: SettledPeriod) -> None:
    one = replace(
        period, position=period.position[:3], torque=period.torque[:3], position_step=period.position_step[:3]
    )
    with pytest.raises(ModelError, match="4 joints but the period has 3"):
        identify_chain(replace(one, stabiliser=None), ChainModel(setup.base), setup.prior)


def test_derivatives_are_those_of_the_simulation(setup: bench.Setup) -> None:
    base = setup.base
    joints, samples, steps = base.chain.joints, 60, 3
    rng = np.random.default_rng(3)
    parameters = dict(zip(base.names, setup.truth.tolist(), strict=True))
    likely = {"viscous": 0.05, "coulomb": 0.05, "offset": 0.01, "coulomb_width": 0.05, "stribeck_rise": 0.3}
    likely |= {"stribeck_velocity": 0.2, "load": 0.03, "torque_scale": 1.02, "zero": 0.01}
    parameters |= {f"{term}_{joint + 1}": likely[term] for term in JOINT_TERMS for joint in range(joints)}
    names = (*parameters, "delay", "lag")
    torque, late = 0.5 * rng.standard_normal((2, samples, steps, joints))
    slopes = np.stack((late, -late), axis=2)
    measured = 0.1 * rng.standard_normal((samples, joints))
    gain = np.array([[0.05] * joints, [0.4] * joints])
    start = np.stack((np.array(setup.arm.start), np.full(joints, 0.3)))

    def run(values: dict[str, float], begin: np.ndarray, nudge: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        recorded = ChainRun(torque + nudge * late, slopes, measured, 1 / 1200)
        simulation = Simulation(base, values, begin, gain, names)
        position, derivative = simulation.go_on(recorded, slice(0, samples))
        assert position is not None
        return position, derivative

    _, derivative = run(parameters, start)
    step = 1e-6
    for index, name in enumerate(parameters):
        up, down = (run({**parameters, name: parameters[name] + sign * step}, start)[0] for sign in (1, -1))
        differences = (up - down) / (2 * step)
        np.testing.assert_allclose(derivative[:, :, index], differences, rtol=1e-4, atol=2e-6, err_msg=name)
    for index in range(2 * joints):
        nudge = np.zeros((2, joints))
        nudge[index // joints, index % joints] = step
        differences = (run(parameters, start + nudge)[0] - run(parameters, start - nudge)[0]) / (2 * step)
        np.testing.assert_allclose(derivative[:, :, len(names) + index], differences, rtol=1e-4, atol=2e-6)
    differences = (run(parameters, start, step)[0] - run(parameters, start, -step)[0]) / (2 * step)
    np.testing.assert_allclose(derivative[:, :, names.index("delay")], differences, rtol=1e-4, atol=2e-6)


def test_filtered_least_squares_takes_any_recording(setup: bench.Setup, period: SettledPeriod) -> None:
    at = np.arange(period.samples) / period.rate
    recording = Recording(at, period.torque, period.position, period.position_step, between="held")
    value, std = fit_filtered([recording], ChainModel(setup.base), setup.prior, 8.0)
    assert value.shape == std.shape == (setup.base.count + 12,)
    assert np.all(std > 0)


def test_wrong_torque_constants_are_found(setup: bench.Setup, period: SettledPeriod) -> None:
    """Joints share links, so no arm is consistent with constants that are off by different factors: their ratios differ
    from 1 by more than ten standard errors.
    """
    wrong = np.array([1.0, 1.03, 0.97, 1.02])
    assumed = replace(period, torque=period.torque * wrong[:, None])
    prior = replace(setup.prior, scale_precision=scale_precision(np.full(4, 0.05)))
    found = identify_chain(assumed, ChainModel(setup.base, torque_scale=True), prior)
    assert found.residual_steps.max() < 0.31
    ratios = np.array([found.parameters[f"torque_scale_{joint}"] for joint in (2, 3, 4)])
    np.testing.assert_allclose(ratios, 1.0 / wrong[1:], rtol=3e-3)
    std = np.array([found.std[found.names.index(f"torque_scale_{joint}")] for joint in (2, 3, 4)])
    assert np.all(np.abs(ratios - 1.0) > 10.0 * std)


def test_auto_adds_what_the_recording_shows(
    setup: bench.Setup, period: SettledPeriod, short_period: SettledPeriod
) -> None:
    """An encoder whose zero is off is found; a recording that is explained keeps the plain model."""
    plain = choose_chain(period, ChainModel(setup.base), setup.prior)
    assert plain.estimate.model == ChainModel(setup.base)
    assert len(plain.trials) == 1
    shifted = short_period.position.copy()
    shifted[1] -= 0.08
    choice = choose_chain(replace(short_period, position=shifted), ChainModel(setup.base), setup.prior)
    assert choice.gained > 1.02
    assert choice.trials[0].model == ChainModel(setup.base)
    found = choice.estimate
    assert found.model.zeros
    assert found.parameters["zero_2"] == pytest.approx(0.08, abs=0.01)


def test_a_tilted_base_is_found(setup: bench.Setup) -> None:
    real = replace(setup, arm=setup.arm.model_copy(update={"base": (0.04, -0.02, 0.0)}))
    path = bench.path_of(bench.BENCHES[4], setup, 101, 5.0)
    tilted_period = bench.record(bench.BENCHES[4], real, path)
    base = BaseParameters.of(setup.base.chain, tilts=True)
    prior = Prior.of(base, setup.arm.description.parameters)
    found = choose_chain(tilted_period, ChainModel(base, base_tilt=True), prior).estimate
    assert found.model == ChainModel(base, base_tilt=True)  # nothing else is taken for the tilt
    truth = dict(zip(TILT, tilt_between(setup.base.chain.gravity, real.arm.gravity_vector), strict=True))
    for name, true in truth.items():
        assert abs(true) > 0.015
        assert found.parameters[name] == pytest.approx(true, abs=0.002)
        assert abs(found.parameters[name] - true) < 4 * found.std[found.names.index(name)]
    assert found.residual_steps.max() < 0.31
    assert found.unseen == ()


@pytest.mark.slow
def test_a_tilt_that_gravity_cannot_show_is_said(setup: bench.Setup, period: SettledPeriod) -> None:
    weightless = Chain(*setup.base.chain.arrays[:3], np.array([0.0, 0.0, -1e-9]))
    base = BaseParameters.of(weightless)
    found = identify_chain(
        period, ChainModel(base, zeros=True, base_tilt=True), Prior.of(base, setup.arm.description.parameters)
    )
    assert set(TILT) <= set(found.unseen)
    assert all(found.std[found.names.index(name)] > 0.05 for name in TILT)
