"""Physics engines read the exported URDF and MJCF: the torques agree, and nothing is dropped silently."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hil import load_model
from hil.arm_model import UNKNOWN_SERVO, ArmModel
from hil.errors import ExportError
from hil.export.formats import export
from hil.export.mass_distribution import distribute
from hil.export.source import Source

NEEDS_MUJOCO = "mujoco is not installed: pip install mujoco"
NEEDS_PINOCCHIO = "pinocchio is not installed: pip install pin"


def motions(joints: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(5)
    return tuple(random.normal(size=(200, joints)) * scale for scale in (1.0, 4.0, 30.0))


def with_values(model: ArmModel, **changes: float) -> ArmModel:
    stds = {**dict.fromkeys(changes, 1e-6), **model.stds}
    return dataclasses.replace(model, values={**model.values, **changes}, stds=stds)


def write(model: ArmModel, run: Path, name: str, length: float | None = None) -> tuple[Path, list[str]]:
    from hil.export.formats import FORMATS

    path = run / f"test.{name}"
    return path, FORMATS[name].write(Source(run, {}, model, length), path)


def pendulum_of(model: ArmModel) -> ArmModel:
    kept = {name: value for name, value in model.values.items() if name.endswith("_1") or name in ("lag", "delay")}
    return ArmModel(kept, model.stds, model.gravity, model.rest_pose[:1], model.joints[:1])


def arms(model: ArmModel) -> Mapping[str, tuple[ArmModel, float | None]]:
    heavy = with_values(model, inertia_1=1.02 * model.values["coupling"] ** 2 / model.values["inertia_2"])
    flat = dataclasses.replace(with_values(model, gravity_1=0.0, gravity_2=0.0), gravity=0.0)
    return {
        "as identified": (model, None),
        "barely physical": (heavy, None),
        "elbow counterweight": (with_values(model, gravity_2=-0.1, coupling=-0.0015, gravity_1=-0.02), None),
        "horizontal": (flat, 0.15),
        "pendulum": (pendulum_of(model), None),
        "pendulum, horizontal": (dataclasses.replace(pendulum_of(flat), gravity=0.0), None),
    }


ARMS = ["as identified", "barely physical", "elbow counterweight", "horizontal", "pendulum", "pendulum, horizontal"]


@pytest.mark.parametrize("name", ARMS)
def test_mujoco_has_the_same_inverse_dynamics(identified: Path, name: str) -> None:
    mujoco = pytest.importorskip("mujoco", reason=NEEDS_MUJOCO)
    model, length = arms(load_model(identified))[name]
    path, _ = write(model, identified, "mjcf", length)
    engine = mujoco.MjModel.from_xml_path(str(path))
    # In MuJoCo, dry friction and limits are constraints, which affect the next state.
    engine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(engine)
    q, dq, ddq = motions(len(model.joints))
    viscous = dq * [model.values[f"viscous_{joint + 1}"] for joint in range(len(model.joints))]
    ours = model.rigid_body_torque(q, dq, ddq) + viscous
    theirs = np.empty_like(ours)
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], dq[row], ddq[row]
        mujoco.mj_inverse(engine, data)
        theirs[row] = data.qfrc_inverse
    assert np.abs(theirs - ours).max() < 1e-6 * np.abs(ours).max()


def test_mujoco_carries_friction_offset_and_the_drive(identified: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason=NEEDS_MUJOCO)
    model = with_values(load_model(identified), lag=1.5e-3)
    path, _ = write(model, identified, "mjcf")
    engine = mujoco.MjModel.from_xml_path(str(path))
    assert engine.dof_frictionloss == pytest.approx([model.values["coulomb_1"], model.values["coulomb_2"]])
    assert engine.actuator_ctrlrange[1] == pytest.approx([-0.8, 0.8])
    data = mujoco.MjData(engine)
    data.qpos[:] = model.rest_pose
    data.ctrl[:] = 0.1, -0.05
    for _ in range(100):
        mujoco.mj_step(engine, data)
    expected = np.array([0.1, -0.05]) * 1.8 - [model.values["offset_1"], model.values["offset_2"]]
    assert data.qfrc_actuator == pytest.approx(expected, rel=1e-6)


def test_a_recording_gives_no_limits(identified: Path) -> None:
    """Its extremes are not the joints' stops, and what was recorded as torque is commanded as torque."""
    mujoco = pytest.importorskip("mujoco", reason=NEEDS_MUJOCO)
    model = load_model(identified)
    joints = tuple(dataclasses.replace(each, servo=UNKNOWN_SERVO, torque_per_goal=1.0) for each in model.joints)
    model = dataclasses.replace(model, joints=joints)
    path, _ = write(model, identified, "mjcf")
    engine = mujoco.MjModel.from_xml_path(str(path))
    assert not engine.jnt_limited.any() and not engine.actuator_ctrllimited.any()
    assert "no joint or drive limits" in path.read_text() and "elbow [N m]" in path.read_text()
    path, left = write(model, identified, "urdf")
    assert [joint.get("type") for joint in ET.parse(path).getroot().iter("joint")] == ["continuous", "continuous"]
    assert "<limit" not in path.read_text()
    assert not any("torque per goal" in each for each in left)


def test_mujoco_carries_a_cable_that_pulls_and_one_that_pushes(identified: Path) -> None:
    mujoco = pytest.importorskip("mujoco", reason=NEEDS_MUJOCO)
    model = with_values(
        load_model(identified), cable_stiffness_1=0.3, cable_stiffness_2=-0.2, offset_1=0.004, offset_2=0.01
    )
    path, left = write(model, identified, "mjcf")
    assert not any("cable" in each for each in left)
    engine = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(engine)
    data.qpos[:] = -0.7, 0.5
    mujoco.mj_forward(engine, data)
    assert [engine.actuator(number).name for number in range(2)] == [joint.name for joint in model.joints]
    sum_of_both = data.qfrc_passive + data.qfrc_actuator
    assert sum_of_both == pytest.approx([-0.3 * -0.7 - 0.004, 0.2 * 0.5 - 0.01], rel=1e-9)


@pytest.mark.parametrize("name", ARMS)
def test_pinocchio_has_the_same_inverse_dynamics(identified: Path, name: str) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason=NEEDS_PINOCCHIO)
    model, length = arms(load_model(identified))[name]
    path, _ = write(model, identified, "urdf", length)
    engine = pinocchio.buildModelFromUrdf(str(path))
    data = engine.createData()
    q, dq, ddq = motions(len(model.joints))
    ours = model.rigid_body_torque(q, dq, ddq)
    # URDF cannot represent the armature: it is listed, and the user has to add it.
    ours[:, -1] -= model.values.get("armature_2", 0.0) * ddq[:, -1]
    theirs = np.array([pinocchio.rnea(engine, data, *row) for row in zip(q, dq, ddq, strict=True)])
    assert np.abs(theirs - ours).max() < 1e-6 * np.abs(ours).max()


def test_link_1_has_the_length_that_a_ruler_measures(identified: Path) -> None:
    first, second = distribute(load_model(identified))
    assert first.length == pytest.approx(0.147, rel=0.02)
    assert min(first.mass, first.inertia, second.mass, second.inertia) > 0
    assert abs(first.centre) <= first.length


@pytest.mark.parametrize(
    ("changes", "length", "said"),
    [
        ({"inertia_2": -1e-3}, None, "inertia_2 = -0.001 kg m"),
        ({"coupling": 0.02}, None, "no links of positive mass"),
        ({"gravity_2": -0.2}, None, "both must have the same sign"),
        ({}, 0.15, "--link-length = 0.15 m is not needed"),
    ],
)
def test_an_arm_that_no_masses_make_is_refused(
    identified: Path, changes: dict[str, float], length: float | None, said: str
) -> None:
    with pytest.raises(ExportError, match=said):
        distribute(with_values(load_model(identified), **changes), length)


def test_a_horizontal_arm_asks_for_its_link_length(identified: Path) -> None:
    flat, _ = arms(load_model(identified))["horizontal"]
    with pytest.raises(ExportError, match="--link-length METRES"):
        distribute(flat)


@pytest.mark.parametrize("name", ["urdf", "mjcf"])
def test_what_has_no_place_is_said_and_written_down(identified: Path, name: str) -> None:
    more = {"stribeck_rise_1": 0.4, "stribeck_velocity_1": 0.15, "load_2": 0.05, "delay": 1e-3, "ripple_sin_1": 0.02}
    more |= {"presliding_stiffness_1": 15.0, "viscous_asymmetry_2": 0.001, "zero_1": 0.01}
    model = with_values(load_model(identified), **more)
    path, left = write(model, identified, name)
    said = "\n".join(left)
    terms = ("stribeck_rise_1 = 0.4", "load_2 = 0.05", "delay = 0.001 s", "coulomb_width_1", "ripple_sin_1 = 0.02")
    for term in (*terms, "presliding_stiffness_1 = 15 N m/rad", "viscous_asymmetry_2 = 0.001", "zero_1 = 0.01 rad"):
        assert term in said
    if name == "urdf":
        assert "armature_2" in said and "offset_1" in said and "torque per goal of elbow = 1.8 N m/A" in said
    text = path.read_text(encoding="utf-8")
    assert all(f"Not representable in this format: {sentence}" in text for sentence in left)


def test_names_that_xml_does_not_like(identified: Path) -> None:
    model = load_model(identified)
    odd = dataclasses.replace(model.joints[0], name='a<b&"c--d')
    for name in ("urdf", "mjcf"):
        path, _ = write(dataclasses.replace(model, joints=(odd, model.joints[1])), identified, name)
        names = [element.get("name") for element in ET.parse(path).iter("joint")]
        assert odd.name in names


def test_a_format_that_does_not_exist(identified: Path) -> None:
    with pytest.raises(ExportError, match=r"'step' is not a format of hil export\. Available: urdf, mjcf, toml"):
        export(identified, "step")


def test_a_full_disk_is_a_message(identified: Path, capsys: Any) -> None:
    from hil.errors import RunFolderError

    for name in ("urdf", "toml", "csv", "parquet", "mcap", "mat"):
        with pytest.raises(RunFolderError, match=r"no_such_folder.* cannot be written"):
            export(identified, name, identified / "no_such_folder" / "file")
