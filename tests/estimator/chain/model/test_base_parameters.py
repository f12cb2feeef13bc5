import numpy as np
import pytest

from hil.description.urdf import read_urdf
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import inverse_dynamics
from hil.estimator.chain.model.geometry import Chain
from tests.support.chains import random_chain, random_parameters
from tests.support.paths import CONFIGS


def bundled(name: str) -> Chain:
    return Chain(*read_urdf(CONFIGS / f"{name}.urdf").geometry, np.array([0.0, 0.0, -9.81]))


def planar() -> Chain:
    """Return two links in a vertical plane."""
    along = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    return Chain(np.stack([np.eye(3)] * 2), along, np.array([[0.0, 1.0, 0.0]] * 2), np.array([0.0, 0.0, -9.81]))


@pytest.mark.parametrize(
    "chain",
    [planar(), bundled("open_manipulator_x_like"), bundled("viperx_300_like"), random_chain(3, 3)],
    ids=["planar", "4 joints", "6 joints", "random"],
)
def test_base_parameters_move_like_all_parameters(chain: Chain) -> None:
    base = BaseParameters.of(chain)
    every = random_parameters(chain.joints, 1)
    q, v, a = np.random.default_rng(2).standard_normal((3, chain.joints, 30))
    right = inverse_dynamics(chain, every, q, v, a)
    found = base.as_all(base.of_all(every))
    np.testing.assert_allclose(inverse_dynamics(chain, found, q, v, a), right, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(base.regressor(q, v, a) @ base.of_all(every), right, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("name", "count"), [("open_manipulator_x_like", 24), ("viperx_300_like", 40)])
def test_there_are_as_many_as_the_literature_counts(name: str, count: int) -> None:
    base = BaseParameters.of(bundled(name))
    assert base.count == count
    q, v, a = (
        np.random.default_rng(3).standard_normal((3, base.chain.joints, 400)) * np.array([2, 3, 10])[:, None, None]
    )
    Y = base.regressor(q, v, a).reshape(-1, count)
    assert np.linalg.cond(Y / np.linalg.norm(Y, axis=0)) < 15  # far from none being redundant


def test_two_links_in_a_plane_have_those_of_the_planar_model() -> None:
    """Base parameters: both inertias, the second armature, and two moments each for coupling and gravity."""
    base = BaseParameters.of(planar())
    assert base.names == (
        *("moment_x_1", "moment_z_1", "inertia_yy_1"),
        *("moment_x_2", "moment_z_2", "inertia_yy_2", "armature_2"),
    )
    assert base.groups[0] == "moment_x_1 + 0.2 mass_2"
    assert base.groups[2] == "inertia_yy_1 + armature_1 + 0.04 mass_2"
    assert base.units[:3] == ("kg m", "kg m", "kg m^2")


def test_groups_are_readable() -> None:
    base = BaseParameters.of(bundled("open_manipulator_x_like"))
    assert "moment_x_3 + 0.124 mass_4" in base.groups
    assert "armature_3" in base.groups
