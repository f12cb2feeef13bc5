"""Multiple shooting on motions that never settle, and invalid recordings."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.data.recording import Recording
from hil.estimator.errors import RecordingError, ShapeError, StandstillError
from hil.estimator.fit.multiple_shooting import Shooting, estimate_by_shooting
from hil.estimator.fit.segmented_least_squares import Segmented
from hil.estimator.models.model import Model
from hil.estimator.options import SelectionOptions
from hil.estimator.selection import unsettled
from hil.estimator.selection.prediction import prediction_rms
from hil.estimator.selection.pruning import pruned_model
from hil.estimator.selection.segments import considered, held_out_errors, missing_terms
from hil.estimator.selection.unsettled import choose_by_shooting
from hil.fakes.plants.arm import Arm, base_parameters
from hil.fakes.plants.plant import make_plant

STEP = 2.0 * np.pi / 4096


def swing(arm: Arm, seconds: float, seed: int, late: float = 0.0) -> Recording:
    """Return an aperiodic motion: sines without a common period, from rest, sampled with jitter.

    late: delay of the last joint's torque [s], shorter than every interval.
    """
    random = np.random.default_rng(seed)
    joints = len(arm.links)
    time = np.cumsum(random.uniform(0.0015, 0.0035, round(seconds / 0.0025)))
    rate, phase = random.uniform(2.0, 9.0, (joints, 4)), random.uniform(0.0, 6.0, (joints, 4))
    peak = np.array([0.28, 0.15])[:joints, None]
    torque = peak * np.sin(rate[:, :, None] * time + phase[:, :, None]).sum(axis=1)
    constant = np.array([drive.torque_constant for drive in arm.drives])
    plant = make_plant(arm)
    position = np.empty_like(torque)
    for k, now in enumerate(time):
        if k and late:
            former = np.append(torque[:-1, k - 1], torque[-1, max(k - 2, 0)])
            plant.advance(time[k - 1] + late, former / constant)
        plant.advance(now, torque[:, k - 1] / constant if k else np.zeros(joints))
        position[:, k] = plant.position
    return Recording(time, torque, np.round(position / STEP) * STEP, np.full(joints, STEP), between="held")


@pytest.fixture(scope="module")
def recording(ideal_arm: Arm) -> Recording:
    return swing(ideal_arm, 8.0, 1)


def start(recording: Recording) -> np.ndarray:
    return fit_inverse_dynamics([recording], 8.0, 0.05).value


def errors(estimate: Any, arm: Arm) -> dict[str, float]:
    found = estimate.parameters
    return {
        name: found[name] / true - 1.0 for name, true in base_parameters(arm).items() if not name.startswith("offset")
    }


def test_a_motion_that_never_settles_gives_the_arm_and_honest_errors(ideal_arm: Arm, recording: Recording) -> None:
    estimate = estimate_by_shooting([recording], Model(2), start(recording))
    assert max(map(abs, errors(estimate, ideal_arm).values())) < 0.01
    truth = np.array(list(base_parameters(ideal_arm).values()))
    z = (estimate.value[:12] - truth) / estimate.std[:12]
    assert 0.1 < np.sqrt(np.mean(z**2)) < 3.5
    assert np.all(estimate.residual_rms < 0.32 * STEP)
    other = swing(ideal_arm, 3.0, 2)
    assert prediction_rms([other], estimate.parameters, 1.0, 2).max() < 0.01


def test_torque_constants_that_are_off_by_different_factors_are_told_apart(recording: Recording) -> None:
    believed = replace(recording, torque=recording.torque / np.array([[1.0], [1.1]]))
    estimate = estimate_by_shooting([believed], Model(2, options={"torque_scale"}), start(believed))
    assert estimate.parameters["torque_scale_2"] == pytest.approx(1.1, rel=2e-3)
    assert np.all(estimate.residual_rms < 0.32 * STEP)


def test_torques_of_two_joints_may_have_different_delays(ideal_arm: Arm, recording: Recording) -> None:
    late, own = swing(ideal_arm, 8.0, 1, late=1.2e-3), Model(2, options={"lags"})
    equal, different = (estimate_by_shooting([each], own, start(each)) for each in (recording, late))
    assert max(map(abs, errors(different, ideal_arm).values())) < 0.01
    index = different.names.index("lag_difference_2")
    assert different.value[index] == pytest.approx(1.2e-3, abs=3.5 * different.std[index])
    assert different.std[index] < 1e-4
    assert np.all(different.residual_rms < 0.32 * STEP)
    # Delays are kept only if they differ.
    kept, dropped = (pruned_model(own, e.names, e.value, e.covariance, 1e-3, None) for e in (different, equal))
    assert (kept, dropped) == (own, Model(2))


def test_a_difference_of_delays_that_is_not_fitted_is_found_and_widens_the_errors(ideal_arm: Arm) -> None:
    late = swing(ideal_arm, 4.0, 1, late=1.2e-3)
    estimate = estimate_by_shooting([late], Model(2), start(late))
    found = missing_terms([late], estimate)[0]
    assert found.part == "lags" and found.evidence > 1.0
    assert found.values["lag_difference_2"] == pytest.approx(1.2e-3, rel=0.2)
    assert np.all(considered([late], estimate).std >= estimate.std)


def test_a_step_changes_inertias_in_proportion(ideal_arm: Arm, recording: Recording) -> None:
    """In coordinates, a fit takes 80 iterations where only sums of inertias are determined, and this way 14."""
    problem = Shooting([recording], Model(2, options={"asymmetry"}), 1.0)
    coordinates = problem.coordinates(base_parameters(ideal_arm))
    value = np.array([base_parameters(ideal_arm).get(name, 0.01) for name in coordinates.names])
    x = coordinates.coordinates(value)
    value, change = coordinates.values(x), np.zeros(x.size)
    change[:4] = 0.4 * value[2] * np.array([1.0, -1.0, 1.0, -1.0])
    change[6:10] = 0.2 * value[6:10]
    step = np.linalg.solve(coordinates.slopes(x), change)
    there = coordinates.moved_in_proportion(np.append(x, 3.0), np.append(step, 0.5))
    assert coordinates.values(there[:-1])[:12] == pytest.approx((value + change)[:12], rel=1e-9) and there[-1] == 3.5
    assert np.all(coordinates.values(coordinates.moved_in_proportion(x, np.full(x.size, -9.0)))[[0, 2, 3]] > 0.0)


def test_recordings_are_used_together_each_with_its_own_encoder_zeros(ideal_arm: Arm, recording: Recording) -> None:
    zeros = np.array([[-0.05, 0.03], [0.04, 0.02]])
    shifted = [
        replace(each, position=each.position - zero[:, None])
        for each, zero in zip((recording, swing(ideal_arm, 4.0, 3)), zeros, strict=True)
    ]
    estimate = estimate_by_shooting(shifted, Model(2), start(shifted[0]), zeros=True)
    assert estimate.segments == 12
    assert estimate.zeros == pytest.approx(zeros, abs=0.002)
    assert np.all(np.abs(estimate.zeros - zeros) < 4.0 * estimate.zeros_std)
    assert max(map(abs, errors(estimate, ideal_arm).values())) < 0.01
    known = prediction_rms(shifted, estimate.parameters, 1.0, 2, estimate.zeros)
    assert known.max() < 0.01 < prediction_rms(shifted, estimate.parameters, 1.0, 2).max()


def test_friction_is_chosen_by_segments_left_out(pendulum: Arm) -> None:
    rising = {"coulomb_width": 0.03, "stribeck_rise": 0.6, "stribeck_velocity": 0.4}
    drives = tuple(drive.model_copy(update=rising) for drive in pendulum.drives)
    recorded = swing(pendulum.model_copy(update={"drives": drives}), 6.0, 5)
    choice = choose_by_shooting([recorded], "delay", start(recorded))
    assert choice.chosen.model.friction == "stribeck" and choice.gained > 1.5
    assert choice.estimate.parameters["stribeck_rise_1"] == pytest.approx(0.6, rel=0.1)
    assert {trial.model.friction for trial in choice.trials} == {"coulomb", "stribeck"}
    with pytest.raises(
        RecordingError, match=r"two segments of 6 s, .*; the longest recording lasts \S+ s: record for longer"
    ):
        choose_by_shooting([recorded], "delay", start(recorded), length=6.0)
    with pytest.raises(RecordingError, match=r"no segment of \S+ s holds 8 samples: the median rate is \S+ Hz; record"):
        choose_by_shooting([recorded], "delay", start(recorded), length=0.02)


def test_a_segment_with_a_gap_is_left_out(pendulum: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = swing(pendulum, 5.0, 4)
    kept = (whole.time < 2.2) | (whole.time > 2.6)
    holed = replace(whole, time=whole.time[kept], torque=whole.torque[:, kept], position=whole.position[:, kept])
    estimate = estimate_by_shooting([holed], Model(1), start(holed))
    assert estimate.segments == 4
    assert max(map(abs, errors(estimate, pendulum).values())) < 0.01
    assert held_out_errors([holed], estimate)[1] < 0.02
    exact = Shooting.derivative_by_values

    def diverging(self: Shooting, *given: Any) -> tuple[np.ndarray, ...]:
        return tuple(np.full_like(each, np.nan) for each in exact(self, *given))

    monkeypatch.setattr(Shooting, "derivative_by_values", diverging)
    error = held_out_errors([holed], estimate)[1]
    assert error == pytest.approx(np.pi / np.std(holed.position), rel=0.05)


def test_a_pendulum_with_lost_samples(pendulum: Arm) -> None:
    whole = swing(pendulum, 5.0, 4)
    position = whole.position.copy()
    position[0, 100:115] = np.nan
    holed = replace(whole, position=position)
    estimate = estimate_by_shooting([holed], Model(1), start(holed))
    assert max(map(abs, errors(estimate, pendulum).values())) < 0.01


def test_mean_torque_is_the_integral_of_what_was_held_or_drawn() -> None:
    time = np.array([0.0, 0.1, 0.25, 0.3, 0.5, *(0.5 + 0.01 * np.arange(1, 40))])
    torque = np.sin(9.0 * time)[None]
    position = np.sin(time)[None]
    edges = np.array([-0.1, 0.05, 0.12, 0.26, 0.6])
    fine = np.linspace(edges[:-1], edges[1:], 200_001)
    for between in ("held", "linear"):
        recording = Recording(time, torque, position, np.array([1e-3]), between=between)  # type: ignore[arg-type]
        late = fine - 0.02
        at = np.clip(np.searchsorted(time, late, side="right") - 1, 0, None)
        drawn = torque[0, at] if between == "held" else np.interp(late, time, torque[0])
        assert recording.mean_torque(edges, 0.02)[0] == pytest.approx(drawn.mean(axis=0), abs=2e-5)


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda r: {"time": r.time[::-1]}, RecordingError, "it must increase"),
        (lambda r: {"time": 1000.0 * r.time}, RecordingError, r"Is time in seconds\? .* columns\.time_unit"),
        (lambda r: {"time": r.time + 30.0 * (r.time > 1.0)}, RecordingError, "split the recording there"),
        (lambda r: {"time": np.where(r.time > 1.0, np.nan, r.time)}, RecordingError, "time of sample"),
        (lambda r: {"position": 4096.0 * r.position}, RecordingError, "are these degrees or encoder"),
        (lambda r: {"position": r.position + 2.0 * np.pi * (r.time > 1.0)}, RecordingError, "unwrap the angle"),
        (lambda r: {"position": r.position + 2.0 * np.pi * (r.time == r.time[99])}, RecordingError, "unwrap the angle"),
        (
            lambda r: {"position": r.position + 20.0 * (r.time == r.time[99])},
            RecordingError,
            r"joint 1: sample 100 at \S+ s is \S+ rad away from both its neighbours: it is an outlier",
        ),
        (lambda r: {"position": np.full_like(r.position, np.nan)}, RecordingError, "0 % of"),
        (lambda r: {"position": np.zeros_like(r.position)}, StandstillError, "joint 1 is always 0 rad"),
        (
            lambda r: {
                "position": np.where(r.time == r.time[9], 1e300, r.position),
                "position_step": np.full(2, 1e300),
            },
            RecordingError,
            r"joint 1: sample 10 at \S+ s is 1e\+300 rad away from both its neighbours: it is an outlier",
        ),
        (lambda r: {"torque": np.where(r.time > 1.0, np.nan, r.torque)}, RecordingError, "torques are not finite"),
        (lambda r: {"torque": 0.0 * r.torque}, RecordingError, "all torques are 0"),
        (lambda r: {"torque": 1e6 * r.torque}, RecordingError, "check its unit"),
        (lambda r: {"torque": r.torque[:, :-1]}, ShapeError, "must be"),
        (lambda r: {"position_step": np.zeros(2)}, RecordingError, "must be positive"),
    ],
)
def test_what_is_no_recording_is_named(
    recording: Recording, change: Callable[[Recording], dict[str, Any]], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        replace(recording, **change(recording))


def test_too_short_is_refused(recording: Recording) -> None:
    few = slice(0, 20)
    with pytest.raises(RecordingError, match="at least 32"):
        replace(
            recording, time=recording.time[few], torque=recording.torque[:, few], position=recording.position[:, few]
        )
    with pytest.raises(RecordingError, match="record for longer, or at a higher"):
        fit_inverse_dynamics([recording], 0.05, 0.05)


def test_what_changes_together_and_leaves_no_trace_is_not_known() -> None:
    """Of three coordinates, the motion reveals the first and the sum of the others."""
    information = np.array([[4.0, 0.0, 0.0], [0.0, 9.0, 9.0], [0.0, 9.0, 9.0]])
    scores = np.array([[1.0, 0.5, 0.5], [-0.5, 1.0, 1.0]])
    found = Segmented(np.zeros(3), np.zeros((2, 4)), 1.0, information, scores, 1, 0.0)
    std = np.sqrt(np.diag(found.covariance()))
    assert np.isfinite(std[0]) and std[0] > 0.0
    assert np.isinf(std[1:]).all()


@pytest.mark.parametrize("segments", [4, 40])
def test_scores_that_the_fit_has_made_small_do_not_make_it_certain(segments: int) -> None:
    """Errors are at least those of white noise; larger scores, as of correlated residuals, still increase them."""
    scores = np.random.default_rng(3).normal(size=(segments, 2)) * np.array([0.1, 1.0]) * np.sqrt(8.0 / segments)
    scores[:, 1] *= 5.0
    information = np.diag([4.0, 9.0])
    least = Segmented(np.zeros(2), np.zeros((segments, 4)), 1.0, information, 0.01 * scores, 1, 1.2).covariance()
    assert np.diag(least) == pytest.approx([1.2 / 4.0, 1.2 / 9.0])
    usual = Segmented(np.zeros(2), np.zeros((segments, 4)), 1.0, information, scores, 1, 1.2).covariance()
    assert usual[0, 0] >= 1.2 / 4.0 and usual[1, 1] > 5.0 * 1.2 / 9.0


def test_recordings_that_disagree_make_all_less_certain() -> None:
    """Twelve segments of three recordings: first with independent noise, then with one common error per recording."""
    random = np.random.default_rng(1)
    groups = np.repeat([0, 1, 2], 4)
    noise = random.normal(size=(12, 2))
    repeated = np.repeat([[3.0, -1.0], [-2.0, 2.0], [-1.0, -1.0]], 4, axis=0)
    alone, alike = (
        Segmented(np.zeros(2), np.zeros((12, 4)), 1.0, np.eye(2), scores, 1, 0.0) for scores in (noise, repeated)
    )
    grown = [np.diag(found.covariance(groups) / found.covariance()) for found in (alone, alike)]
    assert grown[0].max() < 2.5
    assert grown[1].min() > 4.0


def test_a_richer_model_without_standard_errors_is_not_kept(pendulum: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = swing(pendulum, 6.0, 5)
    plain = estimate_by_shooting([recorded], Model(1), start(recorded))
    nothing = replace(plain, model=plain.model.having("presliding"), covariance=np.full_like(plain.covariance, np.inf))
    search = unsettled._Search([recorded], start(recorded), 1.0, False, SelectionOptions(), None)
    monkeypatch.setattr(search, "fit", lambda model, _: plain if model == plain.model else None)
    assert search._with_standard_errors(nothing, plain) is plain
    assert search._with_standard_errors(plain, nothing) is plain
    monkeypatch.setattr(search, "fit", lambda *_: None)
    assert search._with_standard_errors(nothing, plain) is nothing, "better than no estimate"
