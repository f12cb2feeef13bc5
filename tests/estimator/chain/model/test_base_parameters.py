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


def turned(axes: np.ndarray) -> Chain:
    """Three links of 0.15 m along z with these axes, normalised, and turned about z between them."""
    yaw = np.array([-2.81, -1.385, 1.225])
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(3), np.ones(3)
    rotation = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), 2, 0)
    translation = np.array([[0.0, 0.0, 0.07], [0.0, 0.0, 0.164], [0.0, 0.0, 0.09]])
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    return Chain(rotation, translation, axes, np.array([1.0, -2.0, -9.5]))


@pytest.mark.parametrize("off", [1e-3, 3e-3, 0.01, 0.03])
def test_an_axis_slightly_off_does_not_make_the_sums_nearly_cancel(off: float) -> None:
    """The moment along an axis has hardly any effect, so that another parameter has to stand for it."""
    chain = turned(np.array([[-0.2, -0.3, 0.9], [0.065, 1.0, -off], [-0.06, 1.0, off]]))
    base = BaseParameters.of(chain)
    kg, gyration = 0.2, 0.05
    link = np.array([kg, *(0.05 * kg,) * 3, *(gyration**2 * kg,) * 6, 0.01])
    values = base.of_all(np.tile(link, 3))
    assert np.abs(values).max() < 20 * 0.05 * kg


def test_rounded_angles_of_a_description_add_no_base_parameters() -> None:
    axes = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    exact, rounded = turned(axes), turned(axes + np.array([[1e-5, 0.0, 0.0], [0.0, 0.0, 7e-6], [4e-6, 0.0, -7e-6]]))
    one, other = BaseParameters.of(exact), BaseParameters.of(rounded)
    assert one.names == other.names
    q, v, a = np.random.default_rng(2).standard_normal((3, 3, 50))
    every = np.abs(np.random.default_rng(3).standard_normal(33))
    right = inverse_dynamics(rounded, every, q, v, a)
    found = other.regressor(q, v, a) @ other.of_all(every)
    assert np.abs(found - right).max() < 1e-3 * np.abs(right).max()


@pytest.mark.parametrize("angle", [1.5708, 1.57])
def test_right_angles_written_with_few_digits_are_right_angles(angle: float) -> None:
    def chain(angle: float) -> Chain:
        c, s = np.cos(angle), np.sin(angle)
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        rotation = np.stack([np.eye(3), about_x, about_x.T, about_x])
        along = np.array([[0.0, 0.0, 0.05], [0.0, 0.0, 0.06], [0.15, 0.0, 0.0], [0.1, 0.02, 0.0]])
        return Chain(rotation, along, np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([0.0, 0.0, -9.81]))

    assert BaseParameters.of(chain(angle)).names == BaseParameters.of(chain(np.pi / 2)).names


@pytest.mark.parametrize("roll", [1.5708, 1.5707, 1.57])
def test_a_first_axis_that_is_vertical_up_to_rounding_is_not_one_that_gravity_turns(roll: float) -> None:
    """Its moments could not be identified: they change the torque by less than a thousandth."""

    def chain(roll: float) -> Chain:
        c, s = np.cos(roll), np.sin(roll)
        rotation = np.stack([np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), np.eye(3), np.eye(3)])
        axis = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        along = np.array([[0.0, 0.0, 0.05], [0.0, 0.06, 0.0], [0.15, 0.0, 0.0]])
        return Chain(rotation, along, axis, np.array([0.0, 0.0, -9.81]))

    exact, rounded = BaseParameters.of(chain(np.pi / 2)), BaseParameters.of(chain(roll))
    assert rounded.names == exact.names
    assert not {"moment_x_1", "moment_z_1"} & set(rounded.names)
    assert {"moment_x_1", "moment_z_1"} <= set(BaseParameters.of(chain(roll), tilts=True).names)
