"""Lost samples, the limit of a pilot's torque, and doubtful verdicts are named."""

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.changes.diff import Difference
from hil.estimation.pilot_limit import torque_limit
from hil.estimator.selection.verdict import improvement_of
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
    assert "too late" in said and "cable" not in said


@pytest.mark.parametrize(("pilot", "expected"), [(True, "raise the velocity_limit of"), (False, "raise peak_torque")])
def test_after_a_pilot_the_advice_names_the_limit(pilot: bool, expected: str) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    config = config.model_copy(update={"experiment": config.experiment.model_copy(update={"pilot": pilot})})
    samples = some_samples()
    samples["position"] = config.arm.rest_pose
    samples["velocity"][5, 1] = 0.9 * config.joints[1].velocity_limit
    limit = torque_limit(config, samples)
    assert expected in improvement_of("gravity_1", limit)
    assert ("90 %" in limit) is pilot


def test_a_difference_repeats_doubtful_verdicts() -> None:
    (doubt,) = Difference("a", "b", (), (), (), trust=("yes", "with care")).doubts
    assert doubt.startswith("b: trust this model: with care")
    assert Difference("a", "b", (), (), ()).doubts == ()
