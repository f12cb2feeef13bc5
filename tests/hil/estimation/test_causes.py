"""Local defects of recordings are named with their time, and torques that were not those of the column."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.settled_causes import cause_of_residual
from hil.estimation.unsettled import causes as looked_for
from hil.estimation.unsettled.causes import Fitted, causes
from hil.estimation.unsettled.estimate import _with_late_back_emf
from hil.estimation.unsettled.warnings import doubts_of
from hil.estimator.baselines.torque_faults import suspect_clipped, suspect_stop
from hil.estimator.data.recording import Recording
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.selection.segment_verdict import relative_std
from hil.estimator.selection.validation import validate
from tests.support import recorded_arm
from tests.support.paths import CONFIGS
from tests.support.recorded_motion import two_joints

Spoil = Callable[[Recording], Recording]


@dataclass(frozen=True)
class Estimate:
    """The parts of an estimate that are needed to widen its standard errors."""

    names: tuple[str, ...]
    covariance: np.ndarray
    parameters: dict[str, float]


@cache
def healthy(limit: float = np.inf) -> Recording:
    motion = two_joints(8.0, limit)
    return Recording(motion.time, motion.torque, motion.position, np.full(2, 2 * np.pi / 4096), "held")


def found(recording: Recording, predicted: np.ndarray, left: float = 20.0) -> tuple[str, ...]:
    estimate: Any = SimpleNamespace(
        residual_over_noise=np.array([1.0, left]), segment_length=1.0, zeros=np.empty((0, 2))
    )
    return causes(Fitted([recording], ("arm.csv",), [predicted], estimate, estimate, 9.81))


@pytest.fixture(autouse=True)
def _without_defects_of_the_whole_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    """These need a fit: see test_defects."""
    monkeypatch.setattr(looked_for, "likely_defect", lambda *_: None)


def frozen(recording: Recording) -> Recording:
    position = recording.position.copy()
    position[1, 600:900] = position[1, 600]
    return replace(recording, position=position)


def silent(recording: Recording) -> Recording:
    torque = recording.torque.copy()
    torque[1, 800:1000] = 0.0
    return replace(recording, torque=torque)


def spiky(recording: Recording) -> Recording:
    position = recording.position.copy()
    position[0, 101::400] += 0.3
    return replace(recording, position=position)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (frozen, "The position of joint 2 stays at"),
        (frozen, "from 3.000 to 4.495 s"),
        (silent, "The torque of joint 2 stays at 0 N m from 4.000 to 4.995 s"),
        (
            spiky,
            "positions of joint 1 are far from their neighbours: 4 of 1600 samples, the first at 0.505, 2.505, 4.505 s",
        ),
    ],
)
def test_a_local_defect_is_named_with_its_time(spoil: Spoil, said: str) -> None:
    """The model is that of the healthy arm, but for the stretch in which it lacks the torque."""
    recording, predicted = spoil(healthy()), healthy().position + 1e-4
    if spoil is silent:
        predicted[1, 800:1000] += 0.2
    (named,) = found(recording, predicted)
    assert said in named
    assert found(recording, predicted, left=3.0) == ()


def test_a_stretch_without_a_visible_cause_is_named_too() -> None:
    predicted = healthy().position + 1e-3
    predicted[0, 400:600] += 0.3
    (named,) = found(healthy(), predicted)
    assert "residual of joint 1 is up to 301 times its usual value in 2 to 3 s" in named


def test_a_stop_is_named_with_its_angle() -> None:
    """A joint that rebounds at 0.6 rad from 4 s on, with a coefficient of restitution of a third."""
    time, step = np.arange(0.0, 12.0, 0.005), 2 * np.pi / 4096
    free = 0.9 * np.sin(2 * np.pi * 0.7 * time) + 0.2 * np.sin(2 * np.pi * 0.31 * time)
    beyond = np.where(time > 4.0, np.maximum(free - 0.6, 0.0), 0.0)
    position = np.round(np.stack((np.sin(3.0 * time), free - 1.3 * beyond)) / step) * step
    recording = Recording(time, np.stack((np.cos(time), np.sin(5.0 * time))), position, np.full(2, step), "held")
    (named,) = found(recording, position + 0.05 * np.sin(time))
    assert re.match(r"Joint 2 rebounds at 0\.(59|6)", named) and "and never moves past it" in named


@pytest.mark.parametrize(("joint", "side"), [(0, 1), (0, -1), (1, 1), (1, -1)])
def test_a_stop_that_yields_is_named_with_its_angle_and_stiffness(joint: int, side: int) -> None:
    """The motor moves the arm as if nothing were there, so it also presses against the stop."""
    recording = healthy()
    angle, stiffness = side * recording.filled()[joint], 6.0 * float(np.abs(recording.torque[joint]).max())
    at = float(np.quantile(angle, 0.85))
    torque = recording.torque.copy()
    torque[joint] += side * stiffness * np.maximum(angle - at, 0.0)
    (named,) = found(replace(recording, torque=torque), recording.position + 1e-4)
    where = re.match(
        rf"Joint {joint + 1} seems to press .* (above|below) about (\S+) rad: with a stiffness of (\S+) N m/rad", named
    )
    assert where and where[1] == ("above" if side > 0 else "below")
    assert float(where[2]) == pytest.approx(side * at, abs=0.1)
    assert float(where[3]) == pytest.approx(stiffness, rel=0.4)


@pytest.mark.parametrize("share", [0.5, 3.0])
def test_a_spring_a_clipped_torque_and_a_healthy_arm_are_no_stop(share: float) -> None:
    recording = healthy()
    largest = np.abs(recording.torque).max(axis=1)[:, None]
    sprung = replace(recording, torque=recording.torque + share * largest * recording.filled())
    clipped = healthy(0.75)
    assert [suspect_stop([each]) for each in (recording, sprung, clipped)] == [None] * 3


def drifting(recording: Recording) -> Recording:
    """The torque has times of a clock that is 4000 ppm slower."""
    at = recording.time * (1.0 - 4e-3)
    return replace(recording, torque=np.stack([np.interp(at, recording.time, row) for row in recording.torque]))


def test_clocks_that_drift_apart_are_named() -> None:
    (named,) = found(drifting(healthy()), healthy().position + 1e-4)
    drift = re.match(r"The delay of the torque drifts from .* \((-\d+) ppm\)", named)
    assert drift and float(drift[1]) == pytest.approx(-4000, rel=0.05) and "different clocks" in named


def test_a_torque_of_one_joint_that_is_late_is_named() -> None:
    recording = healthy()
    torque = np.stack((recording.torque[0], np.interp(recording.time - 0.02, recording.time, recording.torque[1])))
    (named,) = found(replace(recording, torque=torque), recording.position + 1e-4)
    assert "The torque of joint 2 seems to be logged about 20 ms too late" in named


def test_a_torque_that_the_drive_limits_is_named_with_the_limit() -> None:
    (named,) = found(healthy(0.75), healthy(0.75).position + 1e-4)
    limit = re.match(r"The torque of joint 1 seems to have been limited to about (\S+) N m", named)
    assert limit and float(limit[1]) == pytest.approx(0.75, rel=0.1) and "saturation" in named


def test_a_torque_without_its_sign_is_no_limit() -> None:
    """To a magnitude, a limit near zero fits much better."""
    named = found(replace(healthy(), torque=np.abs(healthy().torque)), healthy().position + 1e-4)
    assert named
    for each in named:
        assert re.match(r"The torque of joint \d never changes sign: its column may contain only magnitudes", each)


def test_no_limit_is_sought_among_torques_that_are_mostly_zero() -> None:
    """Two recordings in each of which one joint is driven: limited to zero, one of them would have no torque at all."""
    driven = [replace(healthy(), torque=healthy().torque * np.array(each)[:, None]) for each in ((1, 0), (0, 1))]
    assert suspect_clipped(driven) == ()


def test_a_healthy_recording_has_none() -> None:
    assert found(healthy(), healthy().position + 1e-4) == ()


def test_the_warning_refers_to_the_cause_and_not_to_units() -> None:
    estimate: Any = SimpleNamespace(
        **{"model": SimpleNamespace(joints=2, base_names=()), "names": (), "value": (), "std": ()},
        residual_rms=np.array([0.001, 1.0]),
        residual_over_noise=np.array([1.0, 20.0]),
    )
    for known in (True, False):
        found = doubts_of([healthy()], estimate, known)
        (fault,) = found.faults
        assert "of the motion of joint 2 unexplained" in found.reason
        assert ("the verdict names the cause" in fault) is known and ("check the units" in fault) is not known


@pytest.mark.parametrize(("left", "named"), [(20.0, True), (1.0, False)])
def test_a_command_that_stays_at_its_largest_value_is_named_where_the_motion_is_not_explained(
    left: float, named: bool
) -> None:
    estimate: Any = SimpleNamespace(
        **{"model": SimpleNamespace(joints=2, base_names=()), "names": (), "value": (), "std": ()},
        **{"residual_rms": np.full(2, 1e-3), "residual_over_noise": np.full(2, left)},
    )
    clipped = replace(healthy(), torque=np.clip(healthy().torque, -0.8, 0.8))
    said = " ".join(doubts_of([clipped], estimate).warnings)
    assert ("its torque stays at 0.8 N m" in said) is named


def test_turns_of_a_smooth_motion_are_not_wrong_samples() -> None:
    """Positions that were filtered have so little noise that a turn stands out against it."""
    recording = healthy()
    smooth = replace(recording, position=np.stack([0.5 * np.sin(9.4 * recording.time), recording.position[1]]))
    assert found(smooth, smooth.position + 1e-4) == ()
    (named,) = found(spiky(smooth), smooth.position + 1e-4)
    assert "4 of 1600 samples" in named


def test_missing_rows_are_named() -> None:
    """Every tenth row is missing; without equal time steps, nothing is known to be missing."""
    estimate: Any = SimpleNamespace(
        **{"model": SimpleNamespace(joints=2, base_names=()), "names": (), "value": (), "std": ()},
        **{"residual_rms": np.full(2, 1e-3), "residual_over_noise": np.ones(2)},
    )
    uneven = replace(healthy(), time=healthy().time + 0.001 * np.random.default_rng(1).uniform(size=1600))
    for recording, said in ((healthy(), False), (without_rows(healthy()), True), (without_rows(uneven), False)):
        warnings = doubts_of([recording], estimate).warnings
        assert any("10 % of the rows are missing" in each for each in warnings) is said


def without_rows(recording: Recording) -> Recording:
    kept = np.arange(recording.time.size) % 10 != 5
    time, torque, position = recording.time[kept], recording.torque[:, kept], recording.position[:, kept]
    return replace(recording, time=time, torque=torque, position=position)


def test_exact_positions_beside_gaps_are_not_wrong_samples() -> None:
    """The motion goes on during gaps of 0.1 to 1 s, so the positions before and after them are far apart."""
    smooth = replace(healthy(), position=0.5 * np.sin(9.4 * healthy().time + np.array([[0.0], [1.0]])))
    kept = np.ones(1600, dtype=bool)
    for first, count in ((300, 20), (322, 40), (364, 100), (700, 60), (761, 30), (1200, 200)):
        kept[first : first + count] = False

    def cut(recording: Recording) -> Recording:
        time, torque, position = recording.time[kept], recording.torque[:, kept], recording.position[:, kept]
        return replace(recording, time=time, torque=torque, position=position)

    predicted = cut(smooth).position + 1e-4
    assert not any("far from their neighbours" in each for each in found(cut(smooth), predicted))
    assert any("3 of 1150 samples" in each for each in found(cut(spiky(smooth)), predicted))


def test_without_gravity_its_torques_are_not_called_uncertain() -> None:
    estimate: Any = SimpleNamespace(
        model=SimpleNamespace(joints=2, base_names=("inertia_1", "gravity_1")),
        names=("inertia_1", "gravity_1"),
        value=np.array([0.01, 1e-4]),
        std=np.array([1e-4, 0.3]),
        residual_rms=np.full(2, 1e-3),
        residual_over_noise=np.ones(2),
    )
    for gravity in (True, False):
        assert ("gravity_1" in str(doubts_of([healthy()], estimate, False, gravity).warnings)) is gravity
        assert ("gravity_1" in relative_std([healthy()], estimate, gravity)) is gravity


@pytest.mark.parametrize(("repeats", "kind", "named"), [(True, "step", 0), (False, "step", 1), (True, "always", 1)])
def test_periods_that_are_alike_contain_no_change(
    repeats: bool, kind: str, named: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    course = SimpleNamespace(kind=kind, time=6.5, recording=0)
    hypothesis = SimpleNamespace(kind="torque", course=course, joints=(2,), unknowns=1)
    fit = SimpleNamespace(left=0.7, unknowns=np.array([-0.18]))
    defect = SimpleNamespace(hypothesis=hypothesis, fit=fit, given=SimpleNamespace(left=1.6))
    monkeypatch.setattr(looked_for, "likely_defect", lambda *_: defect)
    monkeypatch.setattr(looked_for, "disagreement", lambda *_: ())
    estimate: Any = SimpleNamespace(residual_over_noise=np.ones(2), segment_length=1.0, zeros=np.empty((0, 2)))
    fitted = Fitted([healthy()], ("arm.csv",), [healthy().position], estimate, estimate, 9.81, repeats)
    assert len(causes(fitted)) == named


@pytest.mark.parametrize("has_stop", [False, True])
def test_a_stop_within_the_motion_is_a_cause(has_stop: bool) -> None:
    arm = recorded_arm.servo_arm({"stops": (-1.75, 3.0), "stop_stiffness": 200.0} if has_stop else {}, joints=1)
    period = recorded_arm.record(arm, recorded_arm.wave(1, (0.3,))).rounded()
    validation = validate(period, identify(period, Model(joints=1, friction="coulomb")))
    said = cause_of_residual(load_config(CONFIGS / "fake_pendulum.toml"), period, validation)
    if not has_stop:
        assert said == ""
        return
    assert "Joint 1 seems to press against something that yields" in said
    assert abs(float(said.partition("below about ")[2].partition(" rad")[0]) + 1.75) < 0.05


@pytest.mark.parametrize(
    ("angle", "torque", "named"),
    [
        (1, 1, ""),
        (
            -1,
            -1,
            "The direction of shoulder or elbow is probably wrong: with the angle and torque of elbow",
        ),
        (1, -1, "The sign of the torque of elbow is reversed: with the sign changed"),
    ],
)
def test_a_joint_of_the_wrong_direction_is_a_cause(angle: int, torque: int, named: str) -> None:
    arm = recorded_arm.servo_arm({"viscous": 0.03, "coulomb": 0.05})
    period = recorded_arm.record(arm, recorded_arm.wave(1, (0.8, 0.42))).rounded()
    signs = np.array([[1], [angle]]), np.array([[1], [torque]])
    turned = replace(period, position=signs[0] * period.position, torque=signs[1] * period.torque)
    left: Any = SimpleNamespace(residual_over_floor=np.array([60.0, 40.0]))
    said = cause_of_residual(load_config(CONFIGS / "fake_two_link.toml"), turned, left)
    assert said.startswith(named) and bool(said) is bool(named)


@pytest.mark.parametrize(("brakes", "wider"), [((), 0.0), ((0.1, 0.2), 1e-3), ((0.1, None), 1e-3)])
def test_the_lag_of_a_back_emf_widens_the_inertias_of_voltage_driven_joints(
    brakes: tuple[float | None, ...], wider: float
) -> None:
    names = ("inertia_1", "coupling", "armature_2", "viscous_2")
    estimate: Any = Estimate(names, np.diag([1e-8] * 4), {"viscous_1": 0.3, "viscous_2": 0.4})
    found = np.diag(_with_late_back_emf(estimate, brakes).covariance) - 1e-8
    second = 0.4 if None in brakes else 0.2
    assert found == pytest.approx([(0.1 * wider) ** 2, 0.0, (second * wider) ** 2, 0.0], abs=1e-15)
