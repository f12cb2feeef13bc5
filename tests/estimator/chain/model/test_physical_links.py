import numpy as np
import pytest

from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.physical_links import nearest_links
from tests.support.chains import random_chain, random_parameters


def described(joints: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    table = random_parameters(joints, seed).reshape(joints, 11)
    return table[:, :-1], table[:, -1]


@pytest.mark.parametrize("joints", [2, 4, 6])
def test_links_move_as_identified_and_are_physical(joints: int) -> None:
    base = BaseParameters.of(random_chain(joints, joints))
    truth = random_parameters(joints, 1)
    value = base.of_all(truth)
    std = 1e-3 * np.abs(value) + 1e-6
    found = nearest_links(base, value, std, *described(joints, 2))
    assert found.misfit < 0.2
    assert np.all(found.armature > 0.0)
    for mass, mx, my, mz, *inertia in found.links:
        centre = np.array([mx, my, mz]) / mass
        about = np.zeros((3, 3))
        about[np.triu_indices(3)] = inertia
        about += np.triu(about, 1).T
        about -= mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        moments = np.linalg.eigvalsh(about)
        assert mass > 0.0
        assert moments[0] > 0.0
        assert moments[2] <= moments[0] + moments[1] + 1e-12


def test_what_fits_already_stays() -> None:
    base = BaseParameters.of(random_chain(3, 3))
    links, armature = described(3, 4)
    value = base.of_all(np.column_stack((links, armature)).reshape(-1))
    found = nearest_links(base, value, 1e-3 * np.abs(value) + 1e-6, links, armature)
    np.testing.assert_allclose(found.links, links, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.armature, armature, rtol=1e-6)


def test_parameters_of_no_real_arm_are_said_to_be_far() -> None:
    base = BaseParameters.of(random_chain(2, 5))
    links, armature = described(2, 6)
    value = base.of_all(np.column_stack((links, armature)).reshape(-1))
    last = base.names.index("armature_2")
    value[last] = -1.0
    assert nearest_links(base, value, np.full(value.size, 1e-3), links, armature).misfit > 3.0
