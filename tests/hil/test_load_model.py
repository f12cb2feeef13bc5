"""The identified arm as a model: agreement with the estimator's equations, speed, and damaged files."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil import load_model
from hil.arm_model import ArmModel
from hil.errors import ResultError
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names
from hil.export.parameters import export_toml
from hil.export.source import Source
from hil.model_file import read_result
from hil.runs.run_folder import RunFolder


def motions(shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(3)
    return tuple(random.normal(size=shape) * scale for scale in (1.0, 3.0, 20.0))


def test_it_has_the_estimators_equations(identified: Path) -> None:
    model = load_model(identified)
    names = base_names(2)
    sharp = dataclasses.replace(model, values={name: model.values[name] for name in names})
    q, dq, ddq = motions((500, 2))
    theta = np.array([model.values[name] for name in names])
    expected = (regressor(q.T, dq.T, ddq.T) @ theta).T
    np.testing.assert_allclose(sharp.inverse_dynamics(q, dq, ddq), expected, atol=1e-13)


def test_it_is_shown_in_one_line(identified: Path) -> None:
    model = load_model(identified)
    assert repr(model) == f"<ArmModel of 2 joints (shoulder, elbow), {len(model.values)} parameters>"


def full(model: ArmModel) -> ArmModel:
    """The model with every friction term, ripple, cogging and a cable."""
    more = {"coulomb_width": 0.01, "stribeck_rise": 0.4, "stribeck_velocity": 0.15, "load": 0.05, "ripple_cos": 0.02}
    more |= {"ripple_cycles": 7.0, "cogging_sin": 0.004, "cogging_cycles": 5.0, "cable_stiffness": 0.03}
    terms = {f"{term}_{joint}": value for term, value in more.items() for joint in (1, 2)}
    return dataclasses.replace(model, values={**model.values, **terms})


def test_forward_is_the_inverse_of_inverse(identified: Path) -> None:
    model = full(load_model(identified))
    q, dq, ddq = motions((300, 2))
    torque = model.inverse_dynamics(q, dq, ddq)
    np.testing.assert_allclose(model.forward_dynamics(q, dq, torque), ddq, atol=1e-9)
    # At rest, against the offset alone, cogging drives the joint and the cable holds it.
    still = np.zeros(2)
    moved = dataclasses.replace(model, values={**model.values, "cogging_sin_1": 0.005, "cable_stiffness_1": 0.04})
    less = model.inverse_dynamics([0.1, 0.0], still, still) - moved.inverse_dynamics([0.1, 0.0], still, still)
    ripple = 1.0 + 0.02 * np.cos(0.7)
    np.testing.assert_allclose(less, [(0.001 * np.sin(0.5) - 0.01 * 0.1) / ripple, 0.0], atol=1e-12)


def test_a_torque_constant_found_wrong_changes_goals_and_no_torque(identified: Path) -> None:
    model = load_model(identified)
    weaker = dataclasses.replace(model, values={**model.values, "torque_scale_2": 0.8})
    q, dq, ddq = motions((50, 2))
    torque = model.inverse_dynamics(q, dq, ddq)
    np.testing.assert_array_equal(weaker.inverse_dynamics(q, dq, ddq), torque)
    np.testing.assert_allclose(weaker.goal(torque), model.goal(torque) / [1.0, 0.8])


def test_any_shape_and_its_parts_add_up(identified: Path) -> None:
    model = load_model(identified)
    q, dq, ddq = motions((4, 5, 2))
    torque = model.inverse_dynamics(q, dq, ddq)
    assert torque.shape == (4, 5, 2)
    np.testing.assert_allclose(torque[2, 3], model.inverse_dynamics(q[2, 3], dq[2, 3], ddq[2, 3]))
    offset = [model.values["offset_1"], model.values["offset_2"]]
    np.testing.assert_allclose(torque, model.rigid_body_torque(q, dq, ddq) + model.friction_torque(dq) + offset)
    zero = np.zeros_like(q)
    np.testing.assert_allclose(model.gravity_torque(q), model.rigid_body_torque(q, zero, zero))
    np.testing.assert_allclose(
        (model.mass_matrix(q) @ ddq[..., None])[..., 0],
        model.rigid_body_torque(q, zero, ddq) - model.gravity_torque(q),
        atol=1e-12,
    )
    np.testing.assert_allclose(model.goal(torque), torque / 1.8)


def test_a_pendulum_is_an_arm_too(identified: Path) -> None:
    two = load_model(identified)
    values = {name: value for name, value in two.values.items() if name.endswith("_1")}
    one = ArmModel(values, two.stds, two.gravity, two.rest_pose[:1], two.joints[:1])
    q, dq, ddq = motions((50, 1))
    torque = one.inverse_dynamics(q, dq, ddq)
    expected = values["inertia_1"] * ddq + values["gravity_1"] * np.cos(q) + values["offset_1"]
    np.testing.assert_allclose(torque, expected + one.friction_torque(dq))
    np.testing.assert_allclose(one.forward_dynamics(q, dq, torque), ddq, atol=1e-9)


def test_shapes_that_do_not_fit_are_named(identified: Path) -> None:
    model = load_model(identified)
    with pytest.raises(
        ValueError, match=r"q \(3, 2\), dq \(3, 2\), ddq \(2,\): all must have the same shape \(\.\.\., 2\)"
    ):
        model.inverse_dynamics(np.zeros((3, 2)), np.zeros((3, 2)), np.zeros(2))
    with pytest.raises(ValueError, match=r"q \(3,\)"):
        model.gravity_torque(np.zeros(3))


def damage(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def test_files_that_hold_no_model_are_refused_with_their_name(identified: Path, tmp_path: Path) -> None:
    path = identified / "result.json"
    good = path.read_text(encoding="utf-8")
    result = json.loads(good)
    del result["arm"]
    cases = {
        good[: len(good) // 2]: "incomplete or damaged",
        "[]": "it has no schema",
        json.dumps({**json.loads(good), "schema": 2}): "schema is 2, but .* a newer version",
        json.dumps(result): "it has no 'arm'",
        good.replace('"gravity_2"', '"gravity_9"'): "lacks gravity_2",
        good.replace(
            '"extra": {', '"extra": {"backlash_1": {"value": 1, "std": 0, "unit": "rad"},'
        ): "backlash_1, which",
    }
    for text, said in cases.items():
        damage(path, text)
        with pytest.raises(ResultError, match=rf"result\.json.* {said}"):
            load_model(identified)
    path.unlink()
    with pytest.raises(ResultError, match=r"has no result\.json.* hil estimate"):
        load_model(identified)
    with pytest.raises(ResultError, match=r"nowhere cannot be read: No such file"):
        load_model(tmp_path / "nowhere")
    urdf = tmp_path / "arm.urdf"
    urdf.write_text("<robot/>", encoding="utf-8")
    with pytest.raises(ResultError, match=r"arm\.urdf is not a hil model file\. Give a run folder"):
        load_model(urdf)


def test_a_damaged_toml_file_is_read_like_any_other_toml(identified: Path, tmp_path: Path) -> None:
    path = tmp_path / "arm.TOML"
    export_toml(Source.open(identified), path)
    assert load_model(path).values == load_model(identified).values
    path.write_text("schema = 1\nschema = 1\n", encoding="utf-8")
    with pytest.raises(
        ResultError,
        match=r"schema is given twice, on lines 1 and 2\. Delete one of them\.\nRecreate it with hil export",
    ):
        load_model(path)
    path.write_bytes("# Länge\nschema = 1\n".encode("latin-1"))
    with pytest.raises(ResultError, match="not UTF-8 text, from line 1 on"):
        load_model(path)


def test_it_needs_numpy_only_and_hil_itself_not_even_that(identified: Path) -> None:
    code = (
        "import sys, hil; assert 'numpy' not in sys.modules\n"
        f"hil.load_model({str(identified)!r}).gravity_torque([0.0, 0.0])\n"
        "heavy = {'scipy', 'numba', 'pydantic', 'typer', 'rich', 'serial', 'estimator', 'drivers'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_infinite_error_bar_is_null_on_file_and_infinite_again_when_read(identified: Path) -> None:
    result = read_result(identified)
    unseen = dataclasses.replace(result.parameters["offset_1"], std=math.inf)
    first, *others = result.covariance.matrix
    result = dataclasses.replace(
        result,
        parameters={**result.parameters, "offset_1": unseen},
        covariance=dataclasses.replace(result.covariance, matrix=((math.inf, *first[1:]), *others)),
    )
    RunFolder.open(identified).write_result(result)

    def refuse(constant: str) -> float:
        raise AssertionError(f"{constant} is not JSON")

    on_file = json.loads((identified / "result.json").read_text(encoding="utf-8"), parse_constant=refuse)
    assert on_file["parameters"]["offset_1"]["std"] is None
    assert read_result(identified) == result
    assert load_model(identified).stds["offset_1"] == math.inf
