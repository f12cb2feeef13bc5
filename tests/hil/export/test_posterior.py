"""Arms drawn from the posterior: correct spread, physical, loadable, and reproducible by seed."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.errors import ExportError
from hil.export.posterior import draw_arms, export_samples
from hil.export.source import Source
from hil.results.parts import Covariance
from tests.support.command_line import hil


@pytest.fixture
def source(identified_once: Path) -> Source:
    return Source.open(identified_once)


def wider(source: Source, factor: float) -> Source:
    """The same result with its error bars scaled by this factor."""
    matrix = source.result.covariance.array() * factor**2
    covariance = Covariance(source.result.covariance.names, tuple(map(tuple, matrix.tolist())))
    return replace(source, result=replace(source.result, covariance=covariance))


def test_the_spread_is_the_covariance(source: Source) -> None:
    source = wider(source, 0.1)  # the error bars of a short experiment include impossible arms
    drawn = draw_arms(source, 100, torque_constants=False)
    assert drawn.redrawn == 0
    stated = source.result.covariance.array()
    found = np.cov(drawn.values.T)
    std = np.sqrt(np.diag(stated))
    assert np.allclose(found / np.outer(std, std), stated / np.outer(std, std), atol=1e-6)
    mean = np.array([source.result.quantities[name].value for name in drawn.names])
    assert np.all(np.abs(drawn.values.mean(axis=0) - mean) < 1e-6 * std)


def test_the_torque_constant_scales_torques_and_what_a_goal_gives_alike(source: Source) -> None:
    source = wider(source, 0.01)
    drawn = draw_arms(source, 50)
    facts = source.model.joints
    expected = min(joint.torque_per_goal_std / joint.torque_per_goal for joint in facts)
    assert np.std(np.log(drawn.torque_factor), ddof=1) == pytest.approx(expected, rel=0.01)
    ratio = [model.values["gravity_1"] / model.joints[0].torque_per_goal for model in drawn.models]
    assert np.std(ratio) / np.mean(ratio) < 1e-3
    assert np.std([model.values["lag"] for model in drawn.models if "lag" in model.values] or [0.0]) < 1e-3


def test_the_same_seed_gives_the_same_arms(source: Source) -> None:
    assert np.array_equal(draw_arms(source, 10, 4).values, draw_arms(source, 10, 4).values)
    assert not np.array_equal(draw_arms(source, 10, 4).values, draw_arms(source, 10, 5).values)


def test_wide_error_bars_still_give_physical_arms(source: Source) -> None:
    relative = [each.std / abs(each.value) for name, each in source.result.parameters.items() if "offset" not in name]
    drawn = draw_arms(wider(source, 0.6 / max(relative)), 60)
    for model in drawn.models:
        assert model.values["coulomb_1"] >= 0.0
        assert model.values["coupling"] ** 2 < model.values["inertia_1"] * model.values["inertia_2"]


def test_a_parameter_that_nothing_is_known_of_is_named(source: Source) -> None:
    names = source.result.covariance.names
    matrix = source.result.covariance.array()
    matrix[2, 2] = math.inf
    covariance = Covariance(names, tuple(map(tuple, matrix.tolist())))
    with pytest.raises(ExportError, match=names[2]):
        draw_arms(replace(source, result=replace(source.result, covariance=covariance)), 10)


def test_files_load_where_they_are_used(identified: Path, tmp_path: Path) -> None:
    mujoco = pytest.importorskip("mujoco")
    parquet = pytest.importorskip("pyarrow.parquet")
    out = tmp_path / "arms"
    drawn = export_samples(identified, ["mjcf", "urdf", "parquet"], out, 5)
    table = parquet.read_table(out / "arms.parquet")
    assert table.num_rows == 5
    for number in range(5):
        loaded = mujoco.MjModel.from_xml_path(str(out / f"arm_{number:04d}.xml"))
        assert loaded.dof_damping[0] == pytest.approx(drawn.models[number].values["viscous_1"], rel=1e-12)
        assert loaded.dof_frictionloss[0] == pytest.approx(table.column("coulomb_1")[number].as_py(), rel=1e-12)
    assert len(list(out.glob("*.urdf"))) == 5


def test_the_command(identified: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "arms"
    assert hil("export", identified, "--format", "mjcf", "--samples", "3", "--out", out) == 0
    assert "3 arms in" in capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == [f"arm_{number:04d}.xml" for number in range(3)]
    assert hil("export", identified, "--format", "mjcf", "--samples", "2", "--out", out) == 2
    assert "3 arms from an earlier draw, and 1 of them would remain" in capsys.readouterr().err
    assert hil("export", identified, "--format", "csv", "--samples", "3") == 2
    assert "not 'csv'" in capsys.readouterr().err
