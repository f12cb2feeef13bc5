"""A stop that an arm runs into during an experiment is named in the verdict."""

import pytest

from hil.config.schema import load_config
from hil.estimation.settled_estimate import _cause
from hil.estimator.identify import identify
from hil.estimator.models.model import Model
from hil.estimator.selection.validation import validate
from tests.support import recorded_arm
from tests.support.paths import CONFIGS


@pytest.mark.parametrize("has_stop", [False, True])
def test_a_stop_within_the_motion_is_a_cause(has_stop: bool) -> None:
    arm = recorded_arm.servo_arm({"stops": (-1.75, 3.0), "stop_stiffness": 200.0} if has_stop else {}, joints=1)  # type: ignore[dict-item]
    period = recorded_arm.record(arm, recorded_arm.wave(1, (0.3,))).rounded()
    validation = validate(period, identify(period, Model(joints=1, friction="coulomb")))
    said = _cause(load_config(CONFIGS / "fake_pendulum.toml"), period, validation)
    if not has_stop:
        assert said == ""
        return
    assert "Joint 1 seems to press against something that yields" in said
    assert abs(float(said.partition("below about ")[2].partition(" rad")[0]) + 1.75) < 0.05
