"""What a refusal of a spatial arm's motion says to change, and by how much."""

import re
from statistics import NormalDist

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.dry_run.prediction import QUANTITIES, Prediction, limits_of
from hil.pilot.chain_shares import limit_remedy
from tests.support.paths import CONFIGS

LEG = load_config(CONFIGS / "leg.toml")
LIMITS = limits_of(LEG)
STIFF = np.ones(3)
REST = np.array(LEG.arm.rest_pose)


def peaks(quantity: str, joint: int, typical: float, reached: float, *, torque: float = 0.5) -> Prediction:
    """100 arms, of which a few reach `reached` and the others `typical`, as fractions of the limit of this joint."""
    values = np.tile(0.1 * np.abs(LIMITS), (100, 1, 1))
    values[:, 0] = REST
    values[:, 1] = REST
    values[:, QUANTITIES.index("torque"), joint] = torque * LIMITS[QUANTITIES.index("torque"), joint]
    row = QUANTITIES.index(quantity)
    values[:, row, joint] = typical * LIMITS[row, joint]
    values[-3:, row, joint] = reached * LIMITS[row, joint]
    shares = np.abs(values / LIMITS)
    return Prediction(values, shares, LIMITS, np.ones(100, dtype=np.int64), np.empty((0, 0, 0)), REST, 400.0, REST)


def test_a_joint_that_sags_beyond_its_range_needs_a_wider_one_or_better_known_masses() -> None:
    said = limit_remedy(LEG, peaks("highest position", 2, 0.6, 1.4), STIFF)
    high = LEG.joints[2].position_limit[1]
    assert f"a position_limit for {LEG.joints[2].name!r} with its upper end at {1.48 * high:.2f} rad" in said
    assert f"rest_pose {0.48 * high:.2f} rad farther from that end" in said
    assert said.endswith("([arm.prior] spread = 0.15 instead of 0.3)")
    assert "current_limit" not in said and "Hz" not in said


def test_a_limit_that_only_rare_arms_exceed_is_widened_too() -> None:
    """99 of 100 arms stay within it, but more arms exceed it than limit_chance allows."""
    arms = peaks("highest position", 2, 0.8, 0.8)
    row, high = QUANTITIES.index("highest position"), LEG.joints[2].position_limit[1]
    arms.values[:, row, 2] = high * np.array([NormalDist(0.76, 0.09).inv_cdf((arm + 0.5) / 100) for arm in range(100)])
    arms.shares[:, row, 2] = arms.values[:, row, 2] / high
    assert arms.quantile[row, 2] < high and arms.stop_chance > LEG.safety.limit_chance
    (wanted,) = re.findall(r"upper end at ([\d.]+) rad", limit_remedy(LEG, arms, STIFF))
    assert high < float(wanted) < 1.2 * high


def test_masses_do_not_help_where_a_typical_arm_exceeds_the_limit_nor_torque_that_is_not_used() -> None:
    said = limit_remedy(LEG, peaks("velocity", 1, 1.1, 1.5, torque=1.0), STIFF)
    assert f"a velocity_limit of at least {1.6 * LEG.joints[1].velocity_limit:.2g} rad/s" in said
    assert "masses" not in said
    assert f"a larger current_limit for {LEG.joints[1].name!r}" in said


@pytest.mark.parametrize(("stiffness", "times"), [(0.2, 2.4), (0.8, 1.25)])
def test_a_higher_rate_helps_where_the_stabiliser_is_soft(stiffness: float, times: float) -> None:
    """As much as the arms sag too far, but no more than makes the stabiliser as stiff as it gets."""
    said = limit_remedy(LEG, peaks("highest position", 2, 0.6, 1.4), np.array([1.0, 1.0, stiffness]))
    wanted = float(f"{times * LEG.experiment.rate:.2g}")
    rate = f"a rate of about {wanted:g} Hz instead of {LEG.experiment.rate:g}"
    assert f"These changes help, alone or together: {rate}" in said
    assert f"{100 * stiffness:.0f} % of its stiffness" in said
