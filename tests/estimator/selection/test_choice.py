"""Friction model selection by prediction, robustness, intervals and verdict, on independently simulated arms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.data.settled_period import SettledPeriod, without_spikes
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.fit.covariance import correlation_time, structured_share
from hil.estimator.fit.ripple import find_waves
from hil.estimator.fit.stage1 import fit_lines
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.options import SelectionOptions
from hil.estimator.selection.settled import Selection, choose
from hil.estimator.selection.trial import Trial
from hil.estimator.selection.validation import validate
from hil.estimator.selection.verdict import Evidence, judge
from hil.fakes.plants.arm import Arm, base_parameters
from tests.estimator.conftest import STICKING
from tests.support.elsewhere import Elsewhere
from tests.support.recorded_arm import servo_arm

Recorder = Callable[[Arm, Multisine], SettledPeriod]
Wave = Callable[..., Multisine]


def worst(parameters: dict[str, float], arm: Arm) -> float:
    truth = base_parameters(arm)
    return max(abs(parameters[name] / true - 1.0) for name, true in truth.items() if not name.startswith("offset"))


def test_the_plain_model_is_kept_where_nothing_more_is_true(pendulum: Arm, recorded: Recorder, wave: Wave) -> None:
    period, other = (recorded(pendulum, wave(seed, (0.4,), 5.0)) for seed in (1, 2))
    choice = choose([period], other, "delay")
    assert choice.estimate.model == Model(1, "coulomb", "delay")
    assert choice.gained == 1.0 and choice.cost == pytest.approx(1.0)
    # A further initial guess is used, which the number of iterations shows, and does not affect the result.
    halved = {name: 0.5 * value for name, value in base_parameters(pendulum).items()}
    again = choose([period], other, "delay", starts=[halved])
    first, second = again.trials[0].estimate, choice.trials[0].estimate
    assert first is not None and second is not None and first.iterations != second.iterations
    assert again.estimate.value == pytest.approx(choice.estimate.value, rel=1e-3)


def test_friction_is_chosen_by_what_it_predicts(
    sticking_arm: Arm, sticking_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    choice = choose([sticking_period], recorded(sticking_arm, wave(2, (0.8, 0.42))), "lag")
    assert choice.estimate.model == Model(2, "stribeck", "lag")
    assert worst(choice.estimate.parameters, sticking_arm) < 0.005
    assert choice.estimate.residual_steps.max() <= 0.30
    assert choice.chosen.held_out is not None and choice.chosen.held_out.max() < 0.001
    plain = identify(sticking_period, Model(2, "coulomb", "lag"), coarse=True)
    assert plain.residual_steps.max() > 3.0 * choice.estimate.residual_steps.max()


def test_fits_made_elsewhere_give_the_same_choice(recorded: Recorder, wave: Wave) -> None:
    arm, elsewhere = servo_arm(STICKING, joints=1), Elsewhere()
    period, other = (recorded(arm, wave(seed, (0.4,), 2.5)) for seed in (1, 2))
    choice = choose([period], other, "lag")
    again = choose([period], other, "lag", executor=elsewhere)
    assert elsewhere.submitted >= 3
    assert [each.model for each in again.trials] == [each.model for each in choice.trials]
    assert (again.estimate.value == choice.estimate.value).all()


def test_friction_that_yields_before_it_slides_is_found_out(recorded: Recorder, wave: Wave) -> None:
    bristles = {"presliding_stiffness": 15.0, "presliding_damping": 0.5}
    arm = servo_arm({**STICKING, **bristles}, joints=1)
    periods = [recorded(arm, wave(seed, (0.4,), 7.5)) for seed in (1, 2)]
    choice = choose(periods[:1], periods[1], "lag")
    found = choice.estimate
    assert "presliding" in found.model.options
    assert worst(found.parameters, arm) < 0.005
    assert found.residual_steps.max() <= 0.30
    assert choice.chosen.held_out is not None and choice.chosen.held_out.max() < 0.001
    std = dict(zip(found.names, found.std, strict=True))
    for name, true in bristles.items():
        assert abs(found.parameters[f"{name}_1"] - true) < max(0.02 * true, 3.0 * std[f"{name}_1"])
    plain = choice.trials[0]
    assert "presliding" not in plain.model.options and plain.score > 3.0 * choice.chosen.score


def test_a_wild_reading_costs_nothing(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    position = ideal_period.position.copy()
    wild = np.random.default_rng(1).choice(ideal_period.samples, 8, replace=False)
    position[0, wild] += 1.0
    spiked = replace(ideal_period, position=position)
    left_out = np.flatnonzero(~without_spikes(spiked).valid[0])
    # Two samples from an outlier, the median itself is off by the motion of one sample.
    assert set(wild) <= set(left_out) and left_out.size <= 3 * wild.size
    estimate = identify(spiked, Model(2))
    assert worst(estimate.parameters, ideal_arm) < 0.002
    assert estimate.outliers >= 8


def test_motion_that_is_fast_for_the_sample_rate_is_no_outlier(ideal_period: SettledPeriod) -> None:
    slow = replace(ideal_period, position=ideal_period.position[:, ::40], torque=ideal_period.torque[:, ::40])
    slow = replace(slow, rate=ideal_period.rate / 40)
    assert without_spikes(slow).valid.all()


def test_reversals_at_a_low_rate_are_no_outliers_but_wild_readings_are(ideal_period: SettledPeriod) -> None:
    every = 8  # 50 Hz
    slow = replace(ideal_period, position=ideal_period.position[:, ::every], torque=ideal_period.torque[:, ::every])
    slow = replace(slow, rate=ideal_period.rate / every)
    fast = np.abs(np.diff(slow.position, 2, axis=1)).max(axis=1) / slow.position_step
    assert np.all(fast > 10.0), "reversals must stand out from the median of their neighbours"
    assert without_spikes(slow).valid.all()
    wild = slow.position.copy()
    wild[0, 77], wild[1, [5, 6]], wild[1, 0] = wild[0, 77] + 0.5, wild[1, [5, 6]] - 0.4, np.nan
    left_out = ~without_spikes(replace(slow, position=wild)).valid
    assert left_out[0, 77] and left_out[1, [0, 5, 6]].all()
    assert left_out.sum() <= 8


def test_two_runs_together_tell_more_than_one(
    ideal_arm: Arm, ideal_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    other = recorded(ideal_arm, wave(2, (0.8, 0.42)))
    both, one = identify([ideal_period, other], Model(2)), identify(ideal_period, Model(2))
    assert worst(both.parameters, ideal_arm) < 0.001
    assert np.mean(both.std[:12] / one.std[:12]) < 0.85


def test_the_zeros_of_the_encoders_are_found(ideal_period: SettledPeriod) -> None:
    shifted = replace(ideal_period, position=ideal_period.position - np.array([[0.03], [-0.02]]))
    found = identify(shifted, Model(2, options={"zeros"})).parameters
    assert found["zero_1"] == pytest.approx(0.03, abs=2e-4)
    assert found["zero_2"] == pytest.approx(-0.02, abs=2e-4)


def test_the_ratio_of_two_torque_constants_is_found(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    believed = replace(ideal_period, torque=ideal_period.torque / np.array([[1.0], [1.1]]))
    without, found = identify(believed, Model(2), coarse=True), identify(believed, Model(2, options={"torque_scale"}))
    assert without.residual_steps.max() > 1.0, "no arm with equal torque constants moves like this one"
    assert found.parameters["torque_scale_2"] == pytest.approx(1.1, rel=1e-3)
    assert worst(found.parameters, ideal_arm) < 0.002
    elsewhere = {name: 1.5 * value for name, value in found.parameters.items()}
    again = identify(believed, Model(2, options={"torque_scale"}), starts=[elsewhere])
    assert again.parameters == pytest.approx(found.parameters, rel=0.01), "the initial guess must not affect the result"


def test_intervals_cover_the_truth_where_the_model_lacks_something(
    sticking_arm: Arm, sticking_period: SettledPeriod
) -> None:
    estimate = identify(sticking_period, Model(2, "coulomb", "lag"))
    truth = np.array(list(base_parameters(sticking_arm).values()))
    assert np.abs((estimate.value[:12] - truth) / estimate.std[:12]).max() < 2.6
    verdict = judge(estimate, validate(sticking_period, estimate), Evidence())
    assert verdict.trust != "yes"
    assert "is not fully explained: its residual is 4.1 times the noise" in verdict.sentences[0]


def test_without_gravity_its_torques_are_not_the_least_certain(ideal_period: SettledPeriod) -> None:
    found = identify(ideal_period, Model(2))
    factor = np.array([100.0 if "gravity" in name else 1.0 for name in found.names])
    found = replace(found, covariance=found.covariance * np.outer(factor, factor))
    assert validate(ideal_period, found).weakest.startswith("gravity")
    assert not validate(ideal_period, found, gravity=False).weakest.startswith("gravity")


def test_a_good_estimate_is_trusted(ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, Model(2))
    validation = validate(ideal_period, estimate)
    assert validation.correlated_lags.max() < 0.15
    assert validation.free_run is not None and validation.free_run.max() < 0.002
    assert validation.levels.excited.min() > 100.0 * validation.levels.distortion.max()
    assert judge(estimate, validation, Evidence(held_out=np.array([0.001, 0.001]))).trust == "yes"
    doubtful = Evidence(held_out=np.array([0.001, 0.001]), doubts=("The arm does not lie flat.",))
    assert judge(estimate, validation, doubtful).trust == "with care"


def test_ripple_is_found_without_a_starting_value(ideal_arm: Arm, recorded: Recorder, wave: Wave) -> None:
    drives = [drive.model_copy(update={"ripple": 0.03, "ripple_cycles": 9.0}) for drive in ideal_arm.drives]
    period = recorded(ideal_arm.model_copy(update={"drives": tuple(drives)}), wave(1, (0.8, 0.42)))
    found = find_waves([period], fit_lines(period), "ripple")
    assert found["ripple_cycles_1"] == pytest.approx(9.0, abs=0.26)
    assert found["ripple_sin_2"] == pytest.approx(0.03, rel=0.3)


def test_colour_and_structure_of_a_residual_are_seen() -> None:
    white = np.random.default_rng(1).standard_normal((2, 4000))
    smooth = np.stack([np.convolve(row, np.ones(20) / 4.5, mode="same") for row in white])
    assert correlation_time([white]) < 12 and correlation_time([smooth]) > 20
    assert structured_share(white).max() < 0.05 and structured_share(white + smooth).min() > 0.3


def test_an_estimate_without_standard_errors_is_not_chosen_however_well_it_predicts(
    ideal_period: SettledPeriod,
) -> None:
    """Bristles of 1e8 N m/rad make the fit too sensitive for any standard error."""
    plain = identify(ideal_period, Model(2, "coulomb", "lag"), coarse=True)
    stiff = replace(plain, covariance=np.full_like(plain.covariance, np.inf))
    search = Selection([ideal_period], ideal_period, (), SelectionOptions(), None)
    search.trials = [Trial(each.model, each, None, score, 0.0) for each, score in ((plain, 8.0), (stiff, 3.0))]
    for chosen in search.trials:
        assert search.judged(chosen).estimate is plain
    search.trials = search.trials[1:]
    assert search.judged(search.trials[0]).estimate is stiff, "better than no estimate"
    verdict = judge(stiff, validate(ideal_period, stiff), Evidence(np.zeros(2)))
    said = " ".join(verdict.sentences)
    assert verdict.trust == "no" and "hard to separate" not in said
    assert "No parameter has a standard error" in said and "no information" not in said and "determined" not in said


def test_the_noise_is_not_larger_than_what_the_model_leaves(ideal_period: SettledPeriod) -> None:
    """At a low rate, fast parts of the motion pass for noise."""
    estimate = identify(ideal_period, Model(2))
    validation = validate(ideal_period, estimate)
    levels = replace(validation.levels, noise=1.5 * validation.levels.noise)
    overrated = replace(validation, levels=levels, residual_over_floor=validation.residual_over_floor / 1.5)
    said = judge(estimate, overrated, Evidence(np.zeros(2))).sentences[0]
    assert said == "The model explains the motion down to the encoders' rounding."


def test_an_estimate_with_errors_of_other_terms_only_is_not_chosen_either(ideal_period: SettledPeriod) -> None:
    plain = identify(ideal_period, Model(2, "coulomb", "lag"), coarse=True)
    covariance = np.diag(np.where([name == "lag" for name in plain.names], 1.0, np.inf))
    stiff = replace(plain, covariance=covariance)
    search = Selection([ideal_period], ideal_period, (), SelectionOptions(), None)
    search.trials = [Trial(each.model, each, None, score, 0.0) for each, score in ((plain, 8.0), (stiff, 3.0))]
    assert search.judged(search.trials[1]).estimate is plain


@pytest.mark.parametrize(("left", "is_kept"), [(5.0, False), (1.0, True)])
def test_a_fit_without_standard_errors_is_continued_only_if_it_alone_explains_the_motion(
    ideal_period: SettledPeriod, left: float, is_kept: bool
) -> None:
    fitted = identify(ideal_period, Model(2, "coulomb", "lag"), coarse=True)
    plain = replace(fitted, residual=10.0 * fitted.residual)
    covariance = np.full_like(plain.covariance, np.inf)
    stiff = replace(fitted, residual=left * fitted.residual, covariance=covariance)
    search = Selection([ideal_period], ideal_period, (), SelectionOptions(), None)
    sure, unsure = (Trial(each.model, each, None, 1.0, 0.0) for each in (plain, stiff))
    for found in (search._better(unsure, sure), search._better(sure, unsure)):
        assert found is (unsure if is_kept else sure)


def test_a_parameter_that_the_motion_does_not_determine_is_not_known_to_within_a_million_percent(
    ideal_period: SettledPeriod,
) -> None:
    plain = identify(ideal_period, Model(2, "coulomb", "lag"), coarse=True)
    value, covariance = plain.value.copy(), plain.covariance.copy()
    index = plain.names.index("coulomb_2")
    value[index], covariance[index, index] = 1e-8, 0.7**2
    validation = validate(ideal_period, replace(plain, value=value, covariance=covariance))
    said = " ".join(judge(plain, validation, Evidence(np.zeros(2))).sentences)
    assert "This motion does not determine coulomb_2. To identify it, use more slow reversals" in said


@pytest.mark.parametrize(("ended", "said"), [(True, "the recording ends too early"), (False, "set experiment")])
def test_why_there_is_no_held_out_motion_is_said(ideal_period: SettledPeriod, ended: bool, said: str) -> None:
    plain = identify(ideal_period, Model(2, "coulomb", "lag"), coarse=True)
    evidence = Evidence(None, ended_early=ended)
    assert said in " ".join(judge(plain, validate(ideal_period, plain), evidence).sentences)
