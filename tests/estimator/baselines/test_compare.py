"""The other methods reach their known accuracy: a comparison with poor implementations would prove nothing."""

from itertools import islice

import numpy as np
import pytest

from hil.estimator.baselines import compare
from hil.estimator.baselines.compare import joined
from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.baselines.kalman import Filter, fit_by_kalman
from hil.estimator.baselines.paper_lines import fit_linearised
from hil.estimator.baselines.rls import fit_recursively
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import ConvergenceError, ModelError, UnidentifiableError
from hil.estimator.selection.prediction import settled_prediction_error
from hil.fakes.plants.arm import Arm, base_parameters


def worst(names: tuple[str, ...], value: np.ndarray, arm: Arm, *kinds: str) -> float:
    truth = base_parameters(arm)
    found = zip(names, value, strict=True)
    return max(abs(v / truth[name] - 1.0) for name, v in found if name.startswith(kinds))


def test_filtered_inverse_dynamics_is_within_percents(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    found = fit_inverse_dynamics([joined(ideal_period, 1)], 20.0, 0.05)
    assert worst(found.names, found.value, ideal_arm, "inertia", "coupling", "armature", "gravity") < 0.03
    assert worst(found.names, found.value, ideal_arm, "viscous", "coulomb") < 0.03
    assert found.relative_residual.max() < 0.1


def test_rows_and_positions_may_be_filtered_apart(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    recording = joined(ideal_period, 1)
    alike, same, apart = (
        fit_inverse_dynamics([recording], 4.0, 0.05, position_cutoff=cutoff) for cutoff in (None, 4, 20)
    )
    assert np.array_equal(alike.value, same.value)
    kinds = ("inertia", "coupling", "gravity")
    assert worst(apart.names, apart.value, ideal_arm, *kinds) < 0.5 * worst(alike.names, alike.value, ideal_arm, *kinds)


def test_recursive_least_squares_gets_near_it(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    found = fit_recursively([joined(ideal_period, 1)], 15.0, 0.05)
    assert worst(found.names, found.value, ideal_arm, "inertia", "coupling", "armature", "gravity") < 0.03
    assert worst(found.names, found.value, ideal_arm, "viscous", "coulomb") < 0.04, "0.011 to 0.033 in eight multisines"


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_kalman_filters_recover_from_a_start_that_is_off(
    ideal_arm: Arm, ideal_period: SettledPeriod, kind: Filter
) -> None:
    truth = np.array(list(base_parameters(ideal_arm).values()))
    start = truth * (1.0 + 0.15 * np.array([1, -1] * 6))
    found = fit_by_kalman(joined(ideal_period, 2), start, kind, 0.05, 1e-3)
    assert worst(found.names, found.value, ideal_arm, "inertia", "coupling", "armature", "gravity") < 0.01
    assert worst(found.names, found.value, ideal_arm, "viscous", "coulomb") < 0.02


def test_a_filter_that_diverges_says_so(ideal_period: SettledPeriod) -> None:
    nonsense = np.full(12, -1.0)  # no arm has negative inertia
    with pytest.raises(ConvergenceError, match="EKF diverged"):
        fit_by_kalman(joined(ideal_period, 1), nonsense, "ekf", 0.05, 1e-3)


def test_linear_lines_are_right_for_small_swings_of_an_arm_without_dry_friction() -> None:
    """For a linear arm's exact response, for which it was designed, the corrected method must be exact."""
    rate, samples = 200.0, 2000
    theta = {"inertia_1": 0.02, "coupling": 0.003, "inertia_2": 0.004, "armature_2": 0.01, "gravity_1": 0.6}
    theta |= {"gravity_2": 0.2, "viscous_1": 0.05, "viscous_2": 0.04}
    a, b, d = theta["inertia_1"], theta["coupling"], theta["inertia_2"]
    D = np.array([[a + d + 2 * b, d + b], [d + b, d + theta["armature_2"]]])
    K = np.array([[theta["gravity_1"] + theta["gravity_2"], theta["gravity_2"]], [theta["gravity_2"]] * 2])
    F = np.diag([theta["viscous_1"], theta["viscous_2"]])
    time = np.arange(samples) / rate
    torque, position = np.zeros((2, samples)), np.zeros((2, samples))
    for line in range(2, 41):
        s = 2j * np.pi * line * rate / samples
        u = np.array([0.02, 0.0]) if line % 2 else np.array([0.0, 0.02])
        turn = np.exp(s * time + 1j * line**2)
        held = u * np.sinc(line / samples) * np.exp(-0.5 * s / rate)
        torque += (u[:, None] * turn).real
        position += (np.linalg.solve(s * s * D + s * F + K, held)[:, None] * turn).real
    position += np.array([[-np.pi / 2], [0.0]])
    period = SettledPeriod(rate, torque, position, 0.0, np.full(2, 1e-9))
    length = 9.81 * theta["coupling"] / theta["gravity_2"]
    found = fit_linearised(period, length, 9.81)
    for name, true in theta.items():
        assert found.parameters[name] == pytest.approx(true, rel=1e-3)
    with pytest.raises(ModelError, match="length of link 1"):
        fit_linearised(period, None, 9.81)
    with pytest.raises(ModelError, match="requires gravity"):
        fit_linearised(period, length, 0.0)


@pytest.mark.parametrize(("thinned", "tried"), [(8, 3), (20, 1)])
def test_filters_are_tried_up_to_what_the_rate_allows(
    ideal_period: SettledPeriod, monkeypatch: pytest.MonkeyPatch, thinned: int, tried: int
) -> None:
    """At 50 Hz, a cut-off frequency of 25 Hz is half the rate, which no filter allows."""
    monkeypatch.setattr(compare, "WIDTHS", (0.05,))
    torque, position = ideal_period.torque[:, ::thinned], ideal_period.position[:, ::thinned]
    rate = ideal_period.rate / thinned
    period = SettledPeriod(rate, torque, position, ideal_period.command_to_sample, ideal_period.position_step)
    peers = list(islice(compare.compare_peers(period, None, 9.81), 2))
    assert [(peer.name, peer.tried) for peer in peers] == [("idim_ls", tried), ("rls", tried)]


def test_prediction_of_a_settled_period_knows_good_from_bad(ideal_arm: Arm, ideal_period: SettledPeriod) -> None:
    true = base_parameters(ideal_arm) | {"coulomb_width_1": 0.05, "coulomb_width_2": 0.05}
    assert settled_prediction_error(ideal_period, true).max() < 0.001
    off = true | {"gravity_1": 1.1 * true["gravity_1"]}
    assert settled_prediction_error(ideal_period, off).max() > 0.02


def test_one_joint_that_moves_alone_is_not_enough(ideal_period: SettledPeriod) -> None:
    still = ideal_period.position.copy()
    still[1] = 1e-2 * np.sin(np.arange(still.shape[1]) * 2.0 * np.pi / still.shape[1])
    still[0] = still[1]
    period = SettledPeriod(400.0, ideal_period.torque, still, 0.0, np.full(2, 1e-4))
    with pytest.raises(UnidentifiableError, match="separate the parameters"):
        fit_inverse_dynamics([joined(period, 1)], 10.0, 1e-9)
