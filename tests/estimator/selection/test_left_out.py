"""Terms that a model omits: found by the score test, named in the verdict, included in error bars; friction drift."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hil.estimation.settled_estimate import _torque_instead
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.selection.candidates import candidates, colour, considered
from hil.estimator.selection.drift import Drift, friction_change, torque_change
from hil.estimator.selection.settled import choose
from hil.estimator.selection.validation import validate
from hil.estimator.selection.verdict import Evidence, judge
from hil.estimator.selection.waves import ranked_cycles, wave_peaks
from hil.fakes.plants.arm import Arm, base_parameters

Recorder = Callable[[Arm, Multisine], SettledPeriod]
Wave = Callable[..., Multisine]
PLAIN = Model(2, "coulomb", "delay")
PEAKS = (0.8, 0.42)


def changed(arm: Arm, **changes: float) -> Arm:
    return arm.model_copy(update={"drives": tuple(drive.model_copy(update=changes) for drive in arm.drives)})


def wrong_encoders(period: SettledPeriod, once: float, twice: float) -> SettledPeriod:
    """Return the period as read by encoders with the given periodic errors [encoder steps]."""
    step = period.position_step[:, None]
    error = once * np.sin(period.position + 0.7) + twice * np.sin(2.0 * period.position - 0.4)
    return replace(period, position=np.round(period.position / step + error) * step)


@pytest.mark.parametrize(
    ("part", "changes"),
    [
        ("saturation", {"saturation": 0.05, "saturation_current": 0.44}),
        ("cable", {"cable_stiffness": 0.02, "cable_angle": 0.3}),
    ],
)
def test_what_is_missing_is_named_with_its_evidence(
    ideal_arm: Arm, recorded: Recorder, wave: Wave, part: str, changes: dict[str, float]
) -> None:
    period = recorded(changed(ideal_arm, **changes), wave(1, PEAKS))
    estimate = identify(period, PLAIN)
    found = candidates(period, estimate, {})
    seen = {each.part: each for each in found}
    assert seen[part].evidence > 1.0
    verdict = judge(estimate, validate(period, estimate), Evidence(candidates=found))
    assert verdict.trust != "yes"
    assert "The residual looks most like" in verdict.sentences[0] and 'friction = "auto"' in verdict.sentences[0]
    tried = judge(estimate, validate(period, estimate), Evidence(candidates=found, tried_all=True))
    assert '"auto"' not in " ".join(tried.sentences)


def test_of_nothing_nothing_is_seen(ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, PLAIN)
    assert max(each.evidence for each in candidates(ideal_period, estimate, {})) < 1.0
    assert colour(estimate.residual) < 1.5


def test_error_bars_hold_what_is_left_out_and_cannot_be_ruled_out(
    ideal_arm: Arm, recorded: Recorder, wave: Wave
) -> None:
    """With half a percent less torque at the peak, the residual is clean but gravity is off by many standard errors."""
    period = recorded(changed(ideal_arm, saturation=0.005, saturation_current=0.44), wave(1, PEAKS))
    estimate = identify(period, PLAIN)
    truth = np.array(list(base_parameters(ideal_arm).values()))
    wider = np.sqrt(np.diag(considered(period, estimate)))[:12]
    assert np.all(wider >= estimate.std[:12])
    error = np.abs(estimate.value[:12] - truth)
    assert (error / estimate.std[:12]).max() > 4.0
    assert (error / wider).max() < 3.0


@pytest.mark.slow
def test_encoders_that_are_not_linear_are_found_out(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    choice = choose([wrong_encoders(ideal_period, 5.7, 2.0)], None, "delay")
    found = choice.estimate
    assert "encoder" in found.model.options
    truth = base_parameters(ideal_arm)
    for name, true in truth.items():
        std = found.std[found.names.index(name)]
        assert abs(found.parameters[name] - true) < max(0.01 * abs(true), 4.0 * std), name


def test_the_noise_of_an_encoder_is_measured(ideal_period: SettledPeriod) -> None:
    step = ideal_period.position_step[:, None]
    noise = 0.5 * step * np.random.default_rng(3).standard_normal(ideal_period.position.shape)
    noisy = replace(ideal_period, position=np.round((ideal_period.position + noise) / step) * step)
    assert noisy.noise / step[:, 0] == pytest.approx(np.full(2, np.hypot(0.5, 6**-0.5)), rel=0.08)  # rounded twice
    estimate = identify(noisy, PLAIN)
    verdict = judge(estimate, validate(noisy, estimate), Evidence(held_out=np.array([0.001, 0.001])))
    assert verdict.trust == "yes"
    assert "encoders' noise" in verdict.sentences[0]
    assert "does not have" not in " ".join(verdict.sentences)


def test_where_ripple_repeats_is_seen_in_what_a_fit_leaves(ideal_arm: Arm, recorded: Recorder, wave: Wave) -> None:
    period = recorded(changed(ideal_arm, ripple=0.01, ripple_cycles=9.0), wave(1, PEAKS))
    estimate = identify(period, PLAIN, coarse=True)
    (found,) = ranked_cycles(wave_peaks(period, estimate, (3.0, 5.0, 7.0, 9.0, 11.0, 13.0), ("ripple",)), 1)
    assert found == {"ripple_cycles_1": 9.0, "ripple_cycles_2": 9.0}


def test_friction_that_fell_is_told(
    ideal_arm: Arm, ideal_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    estimate = identify(ideal_period, PLAIN)
    drives = tuple(
        drive.model_copy(update={"coulomb": 0.92 * drive.coulomb, "viscous": 0.92 * drive.viscous})
        for drive in ideal_arm.drives
    )
    later = recorded(ideal_arm.model_copy(update={"drives": drives}), wave(2, PEAKS))
    drift = friction_change(later, estimate, 30.0)
    assert drift.is_seen
    assert drift.change == pytest.approx([-0.08, -0.08], abs=0.004)
    said = judge(estimate, validate(ideal_period, estimate), Evidence(drift=drift)).sentences
    assert any("Friction of joint 1 fell by 8" in sentence or "fell by 7.9" in sentence for sentence in said)
    assert any("grease warms up" in sentence and "experiment.warm_up" in sentence for sentence in said)
    rose = replace(drift, change=-drift.change)
    said = judge(estimate, validate(ideal_period, estimate), Evidence(drift=rose)).sentences
    (sentence,) = [each for each in said if "Friction of joint 1 rose" in each]
    assert "which warming up does not explain" in sentence and "experiment.warm_up" not in sentence
    same = friction_change(recorded(ideal_arm, wave(2, PEAKS)), estimate, 30.0)
    assert not same.is_seen


def test_a_torque_that_only_acts_in_the_held_out_motion_is_not_called_friction(
    ideal_arm: Arm, ideal_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    estimate = identify(ideal_period, PLAIN)
    first, second = ideal_arm.drives
    pulled = second.model_copy(update={"offset": second.offset - 0.03})
    later = recorded(ideal_arm.model_copy(update={"drives": (first, pulled)}), wave(2, PEAKS))
    torque, drift = torque_change(later, estimate), friction_change(later, estimate, 30.0)
    assert torque.change == pytest.approx([0.0, -0.03], abs=1e-3)
    assert torque.is_seen.tolist() == [False, True]
    assert torque.explains_better_than(drift)
    (said,) = [
        each
        for each in judge(estimate, validate(ideal_period, estimate), Evidence(torque=torque)).sentences
        if "acts in the held-out one" in each
    ]
    assert "+0.03 N m on joint 2 acts" in said and "joint 1" not in said
    found = _torque_instead(later, estimate, drift)
    assert found is not None and found.change == pytest.approx(torque.change)
    assert _torque_instead(recorded(ideal_arm, wave(2, PEAKS)), estimate, drift) is None, "nothing to explain"
    fine = replace(validate(ideal_period, estimate), residual_over_floor=np.ones(2))
    well = Evidence(held_out=np.full(2, 1e-3))
    assert [judge(estimate, fine, each).trust for each in (well, replace(well, torque=torque))] == ["yes", "with care"]


def test_friction_that_fell_is_not_called_a_torque(
    ideal_arm: Arm, ideal_period: SettledPeriod, recorded: Recorder, wave: Wave
) -> None:
    estimate = identify(ideal_period, PLAIN)
    drives = tuple(drive.model_copy(update={"coulomb": 0.92 * drive.coulomb}) for drive in ideal_arm.drives)
    later = recorded(ideal_arm.model_copy(update={"drives": drives}), wave(2, PEAKS))
    drift = friction_change(later, estimate, 30.0)
    assert drift.is_seen
    assert not torque_change(later, estimate).explains_better_than(drift)


def test_after_a_jump_of_a_position_nothing_else_is_blamed(ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, PLAIN)
    late = ideal_period.position.copy()
    late[1, ideal_period.samples // 2 :] += 10.0 * ideal_period.position_step[1]
    jumped = replace(ideal_period, position=late)
    estimate = identify(jumped, PLAIN, coarse=True)
    validation = validate(jumped, estimate)
    drift = Drift(np.array([0.0, -0.05]), np.full(2, 1e-3), 13.0)
    evidence = Evidence(held_out=np.array([0.002, 0.002]), drift=drift)
    said = " ".join(judge(estimate, validation, evidence).sentences)
    assert "Friction seems to have changed within 13 s (joint 2 by -5 %), but" in said and "grease" not in said
    verdict = judge(estimate, validation, replace(evidence, disturbances=("The position of elbow jumped.",)))
    said = " ".join(verdict.sentences)
    assert verdict.trust == "with care"
    assert "The position of elbow jumped." in said
    for cause in ("grease", "Friction", "looks most like", "No available term", 'friction = "auto"', "detection"):
        assert cause not in said


def test_errors_beyond_the_motion_itself_are_readable_and_said_once(ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, PLAIN)
    validation = validate(ideal_period, estimate)
    evidence = Evidence(held_out=np.array([0.1, 4.2]), held_out_as_fitted=np.array([0.1, 4.2001]))
    (said,) = [each for each in judge(estimate, validation, evidence).sentences if "held-out" in each]
    assert said.count("420 %") == 1 and "e+" not in said


def test_a_prediction_that_takes_friction_from_the_held_out_motion_says_so(ideal_period: SettledPeriod) -> None:
    estimate = identify(ideal_period, Model(2, "coulomb", "delay"))
    validation = validate(ideal_period, estimate)
    evidence = Evidence(held_out=np.array([0.001, 0.002]), held_out_as_fitted=np.array([0.03, 0.001]))
    verdict = judge(estimate, validation, evidence)
    (said,) = [each for each in verdict.sentences if "held-out" in each]
    assert "0.2 %" in said and "taken from that motion" in said
    assert "With friction as in the fitted motion, it predicts that motion to within 3 %" in said
    assert verdict.trust == "yes"


def test_a_parameter_that_is_hardly_there_is_not_known_to_within_thousands_of_percent(
    ideal_period: SettledPeriod,
) -> None:
    estimate = identify(ideal_period, PLAIN)
    validation = validate(ideal_period, estimate)
    relative = dict(validation.relative_std) | {"coulomb_1": 4762.15}
    faint = replace(
        validation,
        relative_std=relative,
        torque_std=dict(validation.torque_std) | {"coulomb_1": 1e-3},
    )
    verdict = judge(estimate, faint, Evidence(held_out=np.array([0.002, 0.002])))
    assert verdict.trust == "yes"
    assert "coulomb_1 cannot be distinguished from zero. It hardly affects this arm" in " ".join(verdict.sentences)
