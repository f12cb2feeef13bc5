"""The uncertainty of torque constants that the file gives for no joint, for some, or for all."""

import re

import numpy as np
import pytest

from hil.config.schema import Config, parse_config
from hil.dry_run.chain_prior import prior_arms
from hil.dry_run.ensemble import scale_draws
from hil.plan.chain_model import known_chain, torque_constant_stds
from tests.support.paths import CONFIGS

LEG = CONFIGS / "leg.toml"


def leg(*kept: str) -> Config:
    """The leg, with one line, or none, for the standard deviation of each joint's torque constant."""
    lines = iter(kept)
    text = re.sub(r"(?m)^torque_constant_std = .*$", lambda _: next(lines), LEG.read_text(encoding="utf-8"))
    assert not list(lines)
    return parse_config(text, LEG)


def test_a_constant_without_uncertainty_is_not_exact_beside_others() -> None:
    config = leg("torque_constant_std = 0.18", "", "torque_constant_std = 0.0")
    first = 0.18 / config.joints[0].torque_per_goal
    assert torque_constant_stds(config) == pytest.approx([first, 0.1, 0.0])
    assert np.std(np.log(scale_draws(config, 2000)), axis=0) == pytest.approx([first, 0.1, 0.0], rel=0.1)
    known = known_chain(config)
    precision = known.prior.scale_precision
    assert precision is not None
    assert np.sqrt(np.diag(np.linalg.inv(precision))) == pytest.approx([np.hypot(first, 0.1), first], rel=0.01)
    assert np.std(prior_arms(config, known, 400).drive[:, 4], axis=0) == pytest.approx([first, 0.1, 0.0], rel=0.15)


def test_ratios_stay_out_of_the_model_if_no_uncertainty_is_given() -> None:
    config = leg("", "", "")
    assert not torque_constant_stds(config).any()
    assert known_chain(config).prior.scale_precision is None
