"""Steps of a chain's coordinates."""

import numpy as np

from hil.estimator.chain.fit.coordinates import ChainCoordinates

NAMES = (
    *("inertia_zz_1", "moment_x_2", "armature_3", "viscous_2", "coulomb_3", "offset_3"),
    *("coulomb_width_1", "coulomb_width_2", "coulomb_width_3", "torque_scale_2", "torque_scale_3"),
)
VALUE = np.array([0.01, -0.3, 0.02, 0.05, 0.1, -0.02, 0.01, 0.02, 0.03, 1.1, 0.9])
COORDINATES = ChainCoordinates(NAMES, np.full(len(NAMES), 0.1), np.array([1e-3, 0.015, 1e-3]))


def test_links_follow_a_common_factor_of_their_torques_exactly() -> None:
    x = COORDINATES.coordinates(VALUE)
    wanted = np.array([name.partition("_")[0] not in ("inertia",) and "width" not in name for name in NAMES])
    step = np.where(wanted, 0.2 * VALUE / COORDINATES.slopes(x), 0.0)
    moved = COORDINATES.values(COORDINATES.moved(x, step))
    np.testing.assert_allclose(moved[wanted] / VALUE[wanted], np.exp(0.2))
    np.testing.assert_allclose(moved[~wanted], VALUE[~wanted])


def test_other_steps_are_straight() -> None:
    x, step = COORDINATES.coordinates(VALUE), np.zeros(len(NAMES) + 6)
    step[[0, 1, 2, 5]] = 0.1, -0.2, 0.3, 0.05
    beyond = np.concatenate((x, np.ones(6)))
    np.testing.assert_allclose(COORDINATES.moved(beyond, step), beyond + step)


def test_no_width_falls_below_what_the_simulation_resolves() -> None:
    x = COORDINATES.coordinates(np.where(["width" in name for name in NAMES], 1e-6, VALUE))
    np.testing.assert_allclose(COORDINATES.values(x)[6:9], [1e-3, 0.015, 1e-3])
    least, most = np.zeros(len(NAMES)), np.zeros(len(NAMES))
    COORDINATES.limit(x, 1.0, least, most)
    np.testing.assert_allclose(least[6:9], 0.0, atol=1e-12)
    lower = x.copy()
    lower[6:9] -= 1.0
    np.testing.assert_allclose(COORDINATES.raised(lower), x)
