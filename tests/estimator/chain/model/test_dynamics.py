"""The chain's compiled dynamics compared with MuJoCo, pinocchio (if installed), each other and finite differences."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from hil.description.urdf import read_urdf
from hil.estimator.chain.model.dynamics import inverse_dynamics, mass_matrix, regressor, split
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.kernels import accelerate, differentiate, move, place, room
from hil.estimator.errors import ModelError, ShapeError
from tests.support.chains import random_chain, random_parameters, random_urdf

SIZES = (1, 2, 4, 6, 7)
SAMPLES = 20


def motion(joints: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((3, joints, SAMPLES)) * np.array([2.0, 3.0, 10.0])[:, None, None]


def torque_derivatives(
    chain: Chain, parameters: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the torques by angles and by velocities at one instant (joints, joints)."""
    link, armature = split(chain, parameters)
    work = room(chain.joints)
    rotation, translation, axis, gravity = chain.arrays
    q, v, a = map(np.ascontiguousarray, (q, v, a))
    place(rotation, translation, axis, q, work[0], work[1])
    move(link, armature, v, work)
    accelerate(armature, gravity, v, a, work)
    differentiate(gravity, work)
    return work[6], work[7]


def described(path: Path, joints: int) -> tuple[Chain, np.ndarray]:
    """Return the chain and all parameters of a random arm with zero armature."""
    path.write_text(random_urdf(joints, joints), encoding="utf-8")
    arm = read_urdf(path)
    parameters = np.column_stack((arm.parameters, np.zeros(joints))).reshape(-1)
    return Chain(*arm.geometry, np.array([0.0, 0.0, -9.81])), parameters


@pytest.mark.parametrize("joints", SIZES)
def test_torques_and_mass_matrix_are_mujocos(joints: int, tmp_path: Path) -> None:
    chain, parameters = described(tmp_path / "arm.urdf", joints)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.urdf"))
    model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # joint limits
    data = mujoco.MjData(model)
    q, v, a = motion(joints, 1)
    torque = inverse_dynamics(chain, parameters, q, v, a)
    for k in range(SAMPLES):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[:, k], v[:, k], a[:, k]
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(torque[:, k], data.qfrc_inverse, rtol=1e-9, atol=1e-9)
    M = np.empty((joints, joints))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    np.testing.assert_allclose(mass_matrix(chain, parameters, q[:, -1]), M, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("joints", SIZES)
def test_torques_derivatives_and_mass_matrix_are_pinocchios(joints: int, tmp_path: Path) -> None:
    pin = pytest.importorskip("pinocchio")
    chain, parameters = described(tmp_path / "arm.urdf", joints)
    model = pin.buildModelFromUrdf(str(tmp_path / "arm.urdf"))
    data = model.createData()
    q, v, a = motion(joints, 2)
    torque = inverse_dynamics(chain, parameters, q, v, a)
    for k in range(SAMPLES):
        state = q[:, k], v[:, k], a[:, k]
        right = pin.rnea(model, data, *state)
        size = 1.0 + np.abs(right).max()
        np.testing.assert_allclose(torque[:, k], right, rtol=0, atol=1e-12 * size)
        by_q, by_v, mass = (np.array(each) for each in pin.computeRNEADerivatives(model, data, *state))
        found_q, found_v = torque_derivatives(chain, parameters, *state)
        np.testing.assert_allclose(found_q, by_q, rtol=0, atol=1e-12 * (1.0 + np.abs(by_q).max()))
        np.testing.assert_allclose(found_v, by_v, rtol=0, atol=1e-12 * (1.0 + np.abs(by_v).max()))
        mass = np.triu(mass) + np.triu(mass, 1).T
        np.testing.assert_allclose(mass_matrix(chain, parameters, q[:, k]), mass, rtol=0, atol=1e-12)


@pytest.mark.parametrize("joints", SIZES)
def test_torque_is_the_regressor_times_all_parameters(joints: int) -> None:
    chain, parameters = random_chain(joints, joints), random_parameters(joints, joints)
    q, v, a = motion(joints, 3)
    Y = regressor(chain, q, v, a)
    np.testing.assert_allclose(Y @ parameters, inverse_dynamics(chain, parameters, q, v, a), rtol=1e-10, atol=1e-11)
    some = np.arange(0, Y.shape[2], 3)
    np.testing.assert_array_equal(regressor(chain, q, v, a, some), Y[:, :, some])


@pytest.mark.parametrize("joints", SIZES)
def test_derivatives_are_those_of_the_torque(joints: int) -> None:
    chain, parameters = random_chain(joints, joints), random_parameters(joints, joints)
    q, v, a = (each[:, :1] for each in motion(joints, 4))
    by_q, by_v = torque_derivatives(chain, parameters, q[:, 0], v[:, 0], a[:, 0])
    for joint in range(joints):
        nudge = np.zeros_like(q)
        nudge[joint] = 1e-6
        for found, moved in ((by_q, (nudge, 0.0)), (by_v, (0.0, nudge))):
            ends = [
                inverse_dynamics(chain, parameters, q + sign * moved[0], v + sign * moved[1], a)[:, 0]
                for sign in (1, -1)
            ]
            np.testing.assert_allclose(found[:, joint], (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=1e-6)


def test_the_torque_of_an_acceleration_is_the_mass_matrix_times_it() -> None:
    chain, parameters = random_chain(5, 5), random_parameters(5, 5)
    q, v, a = (each[:, :1] for each in motion(5, 5))
    more = inverse_dynamics(chain, parameters, q, v, a) - inverse_dynamics(chain, parameters, q, v, 0.0 * a)
    np.testing.assert_allclose(mass_matrix(chain, parameters, q[:, 0]) @ a, more, rtol=1e-9)


def test_what_is_no_chain_is_refused() -> None:
    good = random_chain(2, 1)
    with pytest.raises(ModelError, match="length 1"):
        Chain(good.rotation, good.translation, 2.0 * good.axis, good.gravity)
    with pytest.raises(ModelError, match="rotation"):
        Chain(-good.rotation, good.translation, good.axis, good.gravity)
    with pytest.raises(ShapeError):
        Chain(good.rotation, good.translation[:1], good.axis, good.gravity)
    with pytest.raises(ModelError, match="8 joints"):
        random_chain(8, 1)
    with pytest.raises(ShapeError):
        inverse_dynamics(good, random_parameters(2, 1), np.zeros((2, 4)), np.zeros((2, 4)), np.zeros((2, 3)))
