"""Friction that changes while a period is recorded: corrected for, and counted in the error bars where it is not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.data.fourier import cut_off, lines_of, motion_of
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.excitation.multisine import Multisine
from hil.estimator.identify import Estimate, identify
from hil.estimator.models.model import Model
from hil.estimator.selection.drift import Drift, drifting, friction_change
from hil.estimator.selection.settled import choose
from hil.estimator.selection.steadied import friction_torque, steadied
from hil.fakes.plants.arm import Arm, base_parameters

Recorder = Callable[[Arm, Multisine], SettledPeriod]
Wave = Callable[..., Multisine]
PLAIN = Model(2, "coulomb", "delay")
PEAKS = (0.8, 0.42)
COLD, TIME = 0.12, 60.0
SECONDS = 20.0
"""Time between the middles of two recordings that follow each other [s]."""


def warming(arm: Arm, since: float) -> Arm:
    """Return the arm whose friction falls, `since` [s] after it began to move."""
    cold = COLD * np.exp(-since / TIME)
    update = {"cold_coulomb": cold, "cold_viscous": cold, "warm_up_time": TIME}
    return arm.model_copy(update={"drives": tuple(drive.model_copy(update=update) for drive in arm.drives)})


@pytest.fixture(scope="module")
def periods(ideal_arm: Arm, recorded: Recorder, wave: Wave) -> tuple[SettledPeriod, SettledPeriod]:
    """Two periods, one after the other, while friction falls by several percent."""
    return recorded(warming(ideal_arm, 0.0), wave(1, PEAKS)), recorded(warming(ideal_arm, SECONDS), wave(2, PEAKS))


@pytest.fixture(scope="module")
def constant(periods: tuple[SettledPeriod, SettledPeriod]) -> Estimate:
    """The fit that assumes constant friction."""
    return identify(periods[0], PLAIN)


def residual(estimate: Estimate, period: SettledPeriod) -> float:
    return float(np.sqrt(np.nanmean(estimate.residual**2, axis=1)).max() / period.noise.max())


def true_in_the_middle(arm: Arm) -> dict[str, float]:
    """Parameters in the middle of the second period of 10 s, which is the recorded one."""
    return base_parameters(warming(arm, 0.0), 15.0)


def test_the_torque_that_constant_friction_lacks_is_taken_away(
    ideal_arm: Arm, periods: tuple[SettledPeriod, SettledPeriod], constant: Estimate
) -> None:
    period, later = periods
    drift = friction_change(later, constant, SECONDS)
    assert drift.is_seen and (drift.change < 0.0).all()
    corrected = steadied(period, constant, drift)
    again = identify(corrected, PLAIN)
    assert residual(constant, period) > 1.1
    assert residual(again, corrected) < 1.0 + 0.25 * (residual(constant, period) - 1.0)
    truth = true_in_the_middle(ideal_arm)
    for name in ("coulomb_1", "coulomb_2", "viscous_1", "viscous_2"):
        assert again.parameters[name] == pytest.approx(truth[name], rel=0.02), name


def test_friction_torque_is_that_of_the_model(constant: Estimate, periods: tuple[SettledPeriod, SettledPeriod]) -> None:
    friction = friction_torque(periods[0], constant)
    lines = lines_of(periods[0].position)
    velocity = motion_of(lines, cut_off(lines), periods[0].fundamental, periods[0].samples).velocity
    for joint, v in enumerate(velocity):
        viscous, coulomb = (constant.parameters[f"{name}_{joint + 1}"] for name in ("viscous", "coulomb"))
        fast = np.abs(v) > 0.5
        assert friction[joint][fast] == pytest.approx((viscous * v + coulomb * np.sign(v))[fast], rel=1e-3)


def test_a_period_without_change_stays_as_it_is(
    constant: Estimate, periods: tuple[SettledPeriod, SettledPeriod]
) -> None:
    still = steadied(periods[0], constant, Drift(np.zeros(2), np.ones(2), SECONDS))
    assert np.array_equal(still.torque, periods[0].torque)


def test_the_middle_of_the_period_is_left_alone_and_its_ends_are_opposite(
    constant: Estimate, periods: tuple[SettledPeriod, SettledPeriod]
) -> None:
    drift = Drift(np.array([-0.1, 0.0]), np.full(2, 1e-3), SECONDS)
    change = steadied(periods[0], constant, drift).torque - periods[0].torque
    friction = friction_torque(periods[0], constant)[0]
    assert np.abs(change[1]).max() == 0.0
    factor = change[0] / friction
    assert factor[len(factor) // 2] == pytest.approx(0.0, abs=1e-4)
    assert factor[0] == pytest.approx(-0.1 * 5.0 / SECONDS, rel=0.01) and factor[-1] == pytest.approx(
        -factor[0], rel=0.01
    )


@pytest.mark.slow
def test_choosing_a_model_corrects_for_a_change_of_friction_instead_of_adding_terms(
    periods: tuple[SettledPeriod, SettledPeriod], constant: Estimate
) -> None:
    period, later = periods
    choice = choose([period], later, "delay", seconds=SECONDS)
    assert choice.drift is not None and (choice.drift.change < 0.0).all()
    assert residual(choice.estimate, choice.period) - 1.0 < 0.4 * (residual(constant, period) - 1.0)
    assert not choice.estimate.model.options & {"asymmetry", "saturation", "cable", "encoder", "presliding", "ripple"}


def test_arms_whose_friction_stays_are_not_corrected(ideal_arm: Arm, recorded: Recorder, wave: Wave) -> None:
    period, later = recorded(ideal_arm, wave(1, PEAKS)), recorded(ideal_arm, wave(2, PEAKS))
    assert choose([period], later, "delay", seconds=SECONDS).drift is None


def test_error_bars_count_what_a_changing_friction_does_to_other_parameters(
    ideal_arm: Arm, periods: tuple[SettledPeriod, SettledPeriod], constant: Estimate
) -> None:
    drift = friction_change(periods[1], constant, SECONDS)
    wider = np.sqrt(np.diag(drifting(periods[0], constant, drift)))
    assert np.all(wider >= constant.std)
    truth = true_in_the_middle(ideal_arm)
    error = np.array([abs(constant.parameters[name] - truth[name]) for name in truth])
    assert (error / wider[: len(error)]).max() < 3.0
    nothing = replace(drift, change=np.zeros(2))
    assert drifting(periods[0], constant, nothing) == pytest.approx(constant.covariance)
    twice = replace(drift, change=2.0 * drift.change)
    more = np.diag(drifting(periods[0], constant, twice)) - np.diag(constant.covariance)
    assert more == pytest.approx(4.0 * (wider**2 - np.diag(constant.covariance)), rel=1e-6, abs=1e-20)


def test_after_a_correction_its_own_error_and_unevenness_remain() -> None:
    left = Drift(np.array([-0.08, 0.0]), np.array([0.0, 0.01]), SECONDS).after_correction()
    assert left.change == pytest.approx([0.02, 0.01])


def test_a_start_that_no_simulation_survives_gives_an_unknown_change(
    periods: tuple[SettledPeriod, SettledPeriod], constant: Estimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.estimator.selection.drift._first_state", lambda each: np.full((2, each.joints), np.nan))
    unknown = friction_change(periods[1], constant, SECONDS)
    assert not unknown.is_seen and np.isinf(unknown.std).all()


def test_a_start_that_is_far_off_gives_the_same_change(
    periods: tuple[SettledPeriod, SettledPeriod], constant: Estimate, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = friction_change(periods[1], constant, SECONDS)
    lines = lines_of(periods[1].position)
    motion = motion_of(lines, cut_off(lines), periods[1].fundamental, periods[1].samples)
    off = np.stack((motion.position[:, 0], motion.velocity[:, 0])) + 0.2
    monkeypatch.setattr("hil.estimator.selection.drift._first_state", lambda _: off)
    np.testing.assert_allclose(friction_change(periods[1], constant, SECONDS).change, usual.change, atol=5e-3)
