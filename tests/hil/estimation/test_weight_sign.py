"""A negative gravity parameter contradicts the configuration unless the rest pose implies it."""

from math import pi
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.estimation.plausibility import _weight
from tests.support.paths import CONFIGS


@pytest.mark.parametrize(("rest", "is_named"), [((-pi / 2, 0.0), True), ((-pi / 2, pi), False)])
def test_a_counterweight_is_implied_by_the_rest_pose_or_named(rest: tuple[float, float], is_named: bool) -> None:
    config = load_config(CONFIGS / "fake_two_link.toml")
    config = config.model_copy(update={"arm": config.arm.model_copy(update={"rest_pose": rest})})
    names = ["gravity_1", "gravity_2"]
    estimate: Any = SimpleNamespace(
        model=SimpleNamespace(joints=2),
        names=names,
        parameters={"gravity_1": 0.7, "gravity_2": -0.15},
        std=np.array([1e-3, 1e-3]),
    )
    said = _weight(config, estimate, 0.5)
    assert [("gravity_2" in each and "counterweight" in each) for each in said] == [True] * is_named
