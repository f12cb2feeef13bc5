"""The prior ensemble of spatial arms."""

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.dry_run import chain_prior
from hil.dry_run.chain_prior import prior_arms
from hil.estimator.chain.model.dynamics import TERMS
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


def test_voltage_driven_joints_move_like_lighter_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the estimator: their back-EMF lags. Koch drives its first two joints by voltage, the others by current."""
    config = load_config(CONFIGS / "koch.toml")
    known = known_chain(config)
    arms = prior_arms(config, known, 50)
    monkeypatch.setattr(chain_prior, "MOST_LOST", 0.0)
    plain = prior_arms(config, known, 50)
    np.testing.assert_array_equal(arms.drive, plain.drive)
    rotors = known.base.grouping[:, TERMS - 1 :: TERMS]
    lost = np.linalg.lstsq(rotors, (plain.rigid - arms.rigid).T, rcond=None)[0].T
    np.testing.assert_allclose(lost[:, 2:], 0.0, atol=1e-12)
    delayed = arms.drive[:, 0] * arms.drive[:, 5]  # what is lost if all viscous friction is back-EMF
    assert np.all(lost[:, :2] > 0.0)
    share = np.median(lost[:, :2] / delayed[:, :2], axis=0)
    assert np.all((share > 0.5) & (share < 1.0))
