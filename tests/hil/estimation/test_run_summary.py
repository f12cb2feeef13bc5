"""Lost samples, the limit of a pilot's torque, and doubtful verdicts are named."""

import math

import numpy as np
import pytest

from hil.cli.views.result_table import _shown
from hil.config.schema import Config, load_config
from hil.estimation.changes.diff import Difference
from hil.estimation.pilot_limit import torque_limit
from hil.estimation.settled_period import scatter
from hil.estimator.selection.verdict import improvement_of, percent
from hil.plan.supply_speed import within_supply
from hil.results.parts import ModelChoice, Quantity, TriedModel
from hil.runs.recording import sample_type
from hil.runs.timing import lost_samples
from tests.support.paths import CONFIGS


def some_samples(count: int = 1000) -> np.ndarray:
    samples = np.zeros(count, dtype=sample_type(2))
    samples["time_after_read"] = samples["time_before_write"] + 1e-3
    return samples


def test_lost_samples_are_named_by_joint_and_cause() -> None:
    samples = some_samples()
    samples["missing"][:4, 0] = True
    assert lost_samples(samples, ("a", "b")) == "", "0.4 % is usual"
    samples["missing"][:30, 0] = True
    said = lost_samples(samples, ("a", "b"))
    assert "3.0 % of a, 0.0 % of b" in said and "cable" in said
    samples["missing"] = False
    samples["time_after_read"][:30] = samples["time_before_write"][:30]
    said = lost_samples(samples, ("a", "b"))
    assert "computer was late" in said and "cable" not in said


@pytest.mark.parametrize(("pilot", "expected"), [(True, "raise the velocity_limit of"), (False, "raise peak_torque")])
def test_after_a_pilot_the_advice_names_the_limit(pilot: bool, expected: str) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    config = config.model_copy(update={"experiment": config.experiment.model_copy(update={"pilot": pilot})})
    samples = some_samples()
    samples["position"] = config.arm.rest_pose
    samples["velocity"][5, 1] = 0.9 * config.joints[1].velocity_limit
    limit = torque_limit(config, samples)
    assert expected in improvement_of("gravity_1", limit)
    assert ("90 %" in str(limit)) is pilot
    assert ("band" in improvement_of("inertia_1", limit)) is not pilot, "beyond a limit, faster waves must be smaller"


def test_nobody_is_told_to_raise_a_limit_that_the_supply_lowers() -> None:
    config = with_high_velocity_limits(load_config(CONFIGS / "xm430_two_link.toml"))
    samples = some_samples()
    samples["position"] = config.arm.rest_pose
    samples["velocity"][5, 1] = 0.9 * within_supply(config).joints[1].velocity_limit
    limit = torque_limit(config, samples)
    assert limit is not None and not limit.can_be_raised and "90 %" in limit.said
    for name in ("inertia_2", "armature_2", "viscous_1", "gravity_1", "coupling"):
        said = improvement_of(name, limit)
        assert "raise experiment.period" in said and "velocity_limit" not in said and "band" not in said


def with_high_velocity_limits(config: Config) -> Config:
    joints = [joint.model_copy(update={"velocity_limit": 9.0}) for joint in config.joints]
    experiment = config.experiment.model_copy(update={"pilot": True})
    return config.model_copy(update={"joints": joints, "experiment": experiment})


def test_a_limit_that_was_far_away_did_not_limit_the_torque() -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    config = config.model_copy(update={"experiment": config.experiment.model_copy(update={"pilot": True})})
    samples = some_samples()
    samples["position"] = config.arm.rest_pose
    samples["velocity"][5, 1] = 0.25 * config.joints[1].velocity_limit
    limit = torque_limit(config, samples)
    assert limit is not None and not limit.can_be_raised
    assert "at most 25 % of any limit" in limit.said and "velocity_limit" not in limit.said


def test_large_percentages_and_undetermined_values_are_readable() -> None:
    assert [percent(each) for each in (0.00123, 0.25, 0.996, 12.3)] == ["0.12 %", "25 %", "100 %", "1230 %"]
    assert _shown(Quantity(1.0769e-26, math.inf, "s")) == ["undetermined", "-"]
    assert _shown(Quantity(0.0021, 1.2e-4, "s")) == ["0.0021", "1.2e-04"]


def test_a_difference_repeats_doubtful_verdicts() -> None:
    (doubt,) = Difference("a", "b", (), (), (), trust=("yes", "with care")).doubts
    assert doubt.startswith('The report of b says "trust this model: with care"')
    assert Difference("a", "b", (), (), ()).doubts == ()
    other = Difference("a", "b", (), (), (), other_joints=("Joint 1 was ...",))
    assert other.doubts == ("Joint 1 was ...",)


def test_a_choice_is_compared_with_the_plainest_model_that_could_be_judged() -> None:
    tried = tuple(
        TriedModel(model=name, parameters=count, held_out_rms=None, score=score, seconds=1.0)
        for name, count, score in (("full", 14, 0.1), ("plain", 10, 0.3), ("failed", 8, None))
    )
    choice = ModelChoice(chosen="full", error_divided_by=3.0, tried=tried)
    assert choice.plainest == "plain"
    assert ModelChoice(chosen="full", error_divided_by=1.0, tried=tried[2:]).plainest == "full"


def test_scatter_of_samples_that_most_periods_lack(recwarn: pytest.WarningsRecorder) -> None:
    """Samples missing at the same place in every period, or in all but one, tell nothing and warn of nothing."""
    position = np.random.default_rng(1).normal(0.0, 0.01, (5, 2, 4000))
    whole = scatter(position)
    position[:, 0, :3] = np.nan
    position[1:, 1, 5] = np.nan
    assert whole is not None and whole == pytest.approx(0.01 / np.sqrt(5), rel=0.05)
    assert scatter(position) == pytest.approx(whole, rel=1e-2)
    assert not recwarn.list
