"""The spatial plant compared with the estimator's equations and MuJoCo; energy conservation and stiction."""

import re
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pydantic import ValidationError

from hil.estimator.chain.model.dynamics import inverse_dynamics, mass_matrix
from hil.estimator.chain.model.geometry import Chain
from hil.fakes.plants.arm import Drive, armature
from hil.fakes.plants.chain import SpatialChain
from hil.fakes.plants.chain_arm import ChainArm
from tests.support.paths import CONFIGS

VIPER = CONFIGS / "viperx_300_like.urdf"
NAMES = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
START = (0.1, -0.5, 0.6, 0.2, 0.3, 0.1)


def drive(**more: object) -> Drive:
    given = {"mass": 0.0, "rotor_inertia": 8e-8, "gear_ratio": 300.0, "torque_constant": 1.0, **more}
    return Drive.model_validate(given)


def arm(drives: Sequence[Drive], **more: object) -> ChainArm:
    return ChainArm(urdf=str(VIPER), joints=NAMES, start=START, drives=tuple(drives), **more)


def test_its_equations_are_the_estimators() -> None:
    """The plant's equations (Kane's, centres of mass) match the estimator's (spatial vectors in the base frame)."""
    scale = (1.0, 1.2, 0.8, 1.1, 0.9, 1.3)
    described = arm([drive()] * 6, mass_scale=scale, centre_shift=(0.01,) * 6, base=(0.3, -0.2, 0.1))
    plant = SpatialChain(described)
    links = np.stack([body.parameters for body in described.bodies])
    every = np.column_stack((links, np.zeros(6))).reshape(-1)
    chain = Chain(*described.description.geometry, described.gravity_vector)
    for q, v in np.random.default_rng(1).standard_normal((5, 2, 6)):
        M, bias = plant.equations(q, v)
        np.testing.assert_allclose(M, mass_matrix(chain, every, q), rtol=1e-12, atol=1e-14)
        right = inverse_dynamics(chain, every, q[:, None], v[:, None], np.zeros((6, 1)))[:, 0]
        np.testing.assert_allclose(bias, right, rtol=1e-10, atol=1e-12)


def test_it_moves_as_mujoco_does() -> None:
    described = arm([drive(viscous=0.1)] * 6)
    plant = SpatialChain(described)
    model = mujoco.MjModel.from_xml_path(str(VIPER))
    model.dof_damping[:], model.dof_armature[:] = 0.1, armature(drive())
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data = mujoco.MjData(model)
    data.qpos[:] = START
    torque = np.array([0.5, 6.0, 3.0, 0.1, 0.2, 0.05])
    data.qfrc_applied[:] = torque
    for step in range(1, 61):
        mujoco.mj_step(model, data, 100)
        plant.advance(0.01 * step, torque)
    assert np.ptp([START, data.qpos], axis=0).max() > 1.0
    np.testing.assert_allclose(plant.position, data.qpos, atol=5e-5)


def test_energy_is_kept_without_friction() -> None:
    plant = SpatialChain(arm([drive()] * 6, gravity=0.0))

    def kinetic() -> float:
        M, _ = plant.equations(plant.position, plant.velocity)
        M = M + np.diag([armature(drive())] * 6)
        return 0.5 * float(np.array(plant.velocity) @ M @ plant.velocity)

    plant.advance(0.1, [2.0, 3.0, -1.0, 0.4, 0.3, 0.2])
    before = kinetic()
    plant.advance(2.0, [0.0] * 6)
    assert before > 0.05
    assert kinetic() == pytest.approx(before, rel=1e-5)


def test_friction_holds_the_arm_exactly() -> None:
    plant = SpatialChain(arm([drive(coulomb=20.0)] * 6))
    plant.advance(1.0, [1.0] * 6)
    assert plant.position == list(START)
    assert plant.velocity == [0.0] * 6


def test_half_the_step_gives_the_same_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    """The motion with stiction and Stribeck friction does not depend on the plant's step."""
    drives = [drive(viscous=0.05, coulomb=0.05, stribeck_rise=0.4, stribeck_velocity=0.15, current_lag=1e-3)] * 6

    def moved() -> np.ndarray:
        plant = SpatialChain(arm(drives, gravity=2.0))
        positions = []
        for k in range(1, 401):
            plant.advance(0.0025 * k, 0.8 * np.sin(0.02 * k * np.arange(1, 7)))
            positions.append(plant.position)
        return np.array(positions)

    coarse = moved()
    monkeypatch.setattr("hil.fakes.plants.chain.LONGEST_STEP", 1e-4)
    assert np.abs(moved() - coarse).max() < 2 * np.pi / 4096


def test_a_jammed_joint_stays_where_it_is() -> None:
    plant = SpatialChain(arm([drive(viscous=0.1)] * 6))
    plant.jam(2, True)
    plant.advance(0.5, [0.0] * 6)
    assert plant.position[2] == pytest.approx(START[2], abs=1e-9)
    assert abs(plant.position[1] - START[1]) > 0.01
    plant.jam(2, False)
    plant.advance(1.0, [0.0] * 6)
    assert abs(plant.position[2] - START[2]) > 0.01


def test_stops_hold_and_ripple_and_load_act() -> None:
    stops = drive(viscous=0.2, stops=(-1.0, 1.0))
    plant = SpatialChain(arm([stops] * 6))
    plant.advance(3.0, [0.0] * 6)
    assert max(map(abs, plant.position)) < 1.2
    plain, shaped = (
        SpatialChain(arm([drive(viscous=0.2, coulomb=0.02, **more)] * 6)) for more in ({}, {"ripple": 0.2, "load": 0.1})
    )
    for each in (plain, shaped):
        each.advance(0.2, [0.5] * 6)
    assert np.abs(np.subtract(plain.position, shaped.position)).max() > 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": (0.0,)}, "start has 1 entries"),
        ({"joints": ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "hand")}, 'no joint "hand"'),
        ({"drives": (drive(backlash=0.01),) * 6}, "backlash"),
        ({"urdf": "none.urdf"}, "cannot be read"),
    ],
)
def test_what_is_wrong_with_a_description_is_named(change: dict[str, object], message: str) -> None:
    given = {"urdf": str(VIPER), "joints": NAMES, "start": START, "drives": (drive(),) * 6, **change}
    with pytest.raises(ValidationError, match=message):
        ChainArm.model_validate(given)


def test_an_inertia_that_cannot_be_simulated_is_named(tmp_path: Path) -> None:
    """A product of inertia that is too large makes a principal moment negative, and the motion not a number."""
    text = re.sub('ixy="[^"]*"', 'ixy="0.5"', VIPER.read_text(encoding="utf-8"), count=2)
    (tmp_path / "arm.urdf").write_text(text, encoding="utf-8")
    given = {"urdf": str(tmp_path / "arm.urdf"), "joints": NAMES, "start": START, "drives": (drive(),) * 6}
    with pytest.raises(ValidationError, match=r'the inertia of link ".*" has a negative principal moment'):
        ChainArm.model_validate(given)


def test_the_fake_table_finds_its_urdf_beside_the_file(tmp_path: Path) -> None:
    from hil.fakes.description import load_fake

    (tmp_path / "arm.urdf").write_bytes(VIPER.read_bytes())
    servos = "".join(f'[[fake.servos]]\nid = {i}\nmodel = "XM430-W350"\nzero_ticks = 2048\n' for i in range(1, 7))
    drives = "[[fake.chain.drives]]\nmass = 0.0\nrotor_inertia = 8e-8\ngear_ratio = 353.5\ntorque_constant = 1.8\n" * 6
    chain = f'[fake.chain]\nurdf = "elsewhere/arm.urdf"\njoints = {list(NAMES)}\nstart = {list(START)}\n'
    text = f"[fake]\n{servos}{chain}{drives}"
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    plant = load_fake(tmp_path / "arm.toml").make_plant()
    assert plant.joints == 6
    assert plant.position == list(START)
