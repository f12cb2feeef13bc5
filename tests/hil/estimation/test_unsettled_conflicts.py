"""The verdict on estimates from arbitrary motion: values that contradict what was known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimation.unsettled.estimate import Given, conflicts_in
from hil.estimation.unsettled.plausibility import undetermined
from hil.estimator.data.recording import Recording
from hil.estimator.selection.segment_verdict import SegmentEvidence, judge_segments, relative_std

NAMES = ("inertia_1", "gravity_1", "viscous_1", "coulomb_1", "offset_1")

TIME = np.arange(0.0, 4.0, 0.01)
RECORDING = Recording(
    TIME, np.ones((2, TIME.size)), np.stack([2.0 * np.sin(7.0 * TIME)] * 2), np.full(2, 0.0015), "held"
)
"""Torques of 1 N m and speeds of 10 rad/s RMS."""


def estimated(ratio: float = 1.0, zero: float = 0.0, left: float = 1.0) -> Any:
    """An estimate whose residual is `left` times the noise."""
    return SimpleNamespace(
        model=SimpleNamespace(base_names=NAMES),
        names=(*NAMES, "torque_scale_2"),
        value=np.array([0.02, 0.5, 0.04, 0.05, 0.0, ratio]),
        std=np.array([1e-4, 1e-3, 1e-4, 1e-4, 1e-3, 2e-3]),
        zeros=np.array([[0.0, zero]]),
        zeros_std=np.full((1, 2), 1e-3),
        residual_over_noise=np.array([left]),
        segment_length=1.0,
    )


@pytest.mark.parametrize(
    ("estimate", "given", "trust", "said"),
    [
        (estimated(1.2), Given(), "yes", ""),
        (estimated(1.2), Given({"torque_scale_2": 0.02}), "with care", "torque_scale_2 is 1.2"),
        (estimated(2.0, left=3.0), Given(), "no", "torque_scale_2 is 2"),
        (estimated(zero=0.2), Given(), "yes", ""),
        (estimated(zero=0.2), Given(zeros=True), "with care", "zero_2 is 0.2"),
    ],
)
def test_values_far_from_the_files_lower_the_verdict(estimate: Any, given: Given, trust: str, said: str) -> None:
    recordings = [RECORDING]
    held_out = np.array([0.001, 0.001])
    verdict = judge_segments(recordings, estimate, SegmentEvidence(held_out, conflicts=conflicts_in(estimate, given)))
    assert verdict.trust == trust
    assert said in " ".join(verdict.sentences)
    assert bool(said) == ("standard deviations from" in " ".join(verdict.sentences))


def test_dry_friction_that_is_zero_and_known_to_be_so_is_no_weakness() -> None:
    """Relative to a value of zero, no error is small."""
    estimate = estimated()
    place = NAMES.index("coulomb_1")
    estimate.value[place], estimate.std[place] = 1e-12, 1e-5
    assert relative_std([RECORDING], estimate)["coulomb_1"] == pytest.approx(1e-4, rel=0.01)
    estimate.std[place] = 0.5
    assert relative_std([RECORDING], estimate)["coulomb_1"] > 1.0


@pytest.mark.parametrize(
    ("left", "error", "std", "undetermined", "trust", "said"),
    [
        (1.1, 0.011, 1e-4, (), "with care", "the error of the prediction exceeds 1 %"),
        (2.5, 0.004, 1e-4, (), "yes", "not fully explained: its residual is 2.5 times the noise (up to 5 times"),
        (5.1, 0.004, 1e-4, (), "with care", "the residual exceeds 5 times the noise"),
        (5.1, 0.06, 1e-4, (), "no", 'An error above 5 % makes the verdict "no"'),
        (1.6, 0.06, 1e-4, (), "no", 'An error above 5 % makes the verdict "no"'),
        (1.1, 0.06, 1e-4, (), "with care", "the error of the prediction exceeds 1 %"),
        (1.1, 0.16, 1e-4, (), "no", 'An error above 15 % makes the verdict "no": half of this motion does not'),
        (1.6, 0.16, 1e-4, (), "no", 'An error above 5 % makes the verdict "no": check the columns, their units'),
        (1.1, None, 1e-4, (), "with care", "the residual exceeds 1.06 times the noise"),
        (1.0, 0.004, 5e-3, (), "with care", "viscous_1 is not known to within 10 %"),
        (1.5, 0.004, 1e-4, ("Not determined: x.",), "yes", "Not determined: x."),
        (1.6, 0.004, 1e-4, ("Not determined: x.",), "with care", "only if the residual is at most 1.5 times the noise"),
    ],
)
def test_the_verdict_names_the_limit_that_a_number_exceeds(
    left: float, error: float | None, std: float, undetermined: tuple[str, ...], trust: str, said: str
) -> None:
    """One rule for all recordings; a residual of 1.1 times the noise is not "cannot explain"."""
    recordings = [RECORDING]
    estimate = estimated(left=left)
    estimate.std[2] = std
    held_out = None if error is None else np.array([error])
    verdict = judge_segments(recordings, estimate, SegmentEvidence(held_out, undetermined=undetermined))
    sentences = " ".join(verdict.sentences)
    assert verdict.trust == trust and said in sentences
    assert ("cannot explain" in sentences) == (left > 5.0)
    assert ('The verdict is not "yes" because' in sentences) == (trust == "with care")


@pytest.mark.parametrize("spoiled", [True, False])
def test_the_verdict_gives_its_own_reason_and_no_infinite_uncertainty(spoiled: bool) -> None:
    recordings = [RECORDING]
    estimate = estimated(left=9.0)
    estimate.std[3] = np.inf
    reason = "the fit leaves 13 % of the motion of joint 2 unexplained"
    evidence = SegmentEvidence(np.array([0.5, 0.5]), faulty=True, spoiled=spoiled, reason=reason)
    said = " ".join(judge_segments(recordings, estimate, evidence).sentences)
    assert f"Do not use these numbers: {reason}." in said
    assert "This motion does not determine coulomb_1." in said
    assert "inf" not in said.replace("information", "")


def test_an_undetermined_term_is_listed_without_an_infinite_error() -> None:
    names, value = ("coulomb_1", "coulomb_2", "coulomb_width_1"), np.array([1.0, 1.0, 37.0])
    estimate: Any = SimpleNamespace(names=names, value=value, std=np.array([1e-3, 1e-3, np.inf]))
    estimate.parameters = dict(zip(names, value.tolist(), strict=True))
    (said,) = undetermined([RECORDING], estimate)
    assert "coulomb_width_1 (not at all)" in said


@pytest.mark.parametrize(("value", "is_said"), [(1e-9, True), (0.01, False)])
def test_an_inertia_that_ended_at_0_makes_the_errors_of_the_others_doubtful(value: float, is_said: bool) -> None:
    estimate = estimated()
    names = (*NAMES[:-1], "armature_2", NAMES[-1])
    estimate.model.base_names, estimate.names = names, (*names, "torque_scale_2")
    estimate.value = np.insert(estimate.value, 4, value)
    estimate.std = np.insert(estimate.std, 4, np.inf)
    said = " ".join(judge_segments([RECORDING], estimate, SegmentEvidence(np.array([0.004]))).sentences)
    assert "This motion does not determine armature_2" in said
    assert ("assume this value and may be far too small" in said) == is_said
