"""Recordings of other tools end to end: the same numbers from every format, and a folder like a run's."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import hil as api
from hil.fakes.plants.arm import base_parameters
from tests.support.command_line import hil
from tests.support.recorded_motion import Motion, two_joints


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)


def as_csv(motion: Motion, path: str = "arm.csv", offset: float = 0.0) -> None:
    table = np.column_stack((motion.time, motion.position[0] + offset, motion.position[1], motion.torque.T))
    head = "time,q1,q2,tau1,tau2"
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")


def as_parquet(motion: Motion) -> None:
    pa, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = zip(("time", "q1", "q2", "tau1", "tau2"), (motion.time, *motion.position, *motion.torque), strict=True)
    parquet.write_table(pa.table(dict(columns)), "arm.parquet")


def held(**columns: object) -> str:
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in columns.items())
    Path("held.toml").write_text(f'[columns]\nbetween = "held"\n{lines}', encoding="utf-8")
    return "held.toml"


def test_a_short_recording_has_all_that_a_run_has(capsys: pytest.CaptureFixture[str]) -> None:
    """Eight seconds of angles measured from the hanging pose, which the file does not say."""
    as_csv(two_joints(8.0), offset=np.pi / 2)
    assert hil("estimate", "arm.csv", "--config", held(), "--out", "run") == 0
    out = capsys.readouterr().out
    assert "zero = [-1.571, 0] rad was added" in out and "hil export run --format mjcf" in out
    result = json.loads(Path("run/result.json").read_text(encoding="utf-8"))
    truth = base_parameters(two_joints(8.0).arm)
    assert truth is not None
    for name in ("inertia_1", "inertia_2", "coupling", "gravity_1", "gravity_2"):
        assert result["parameters"][name]["value"] == pytest.approx(truth[name], rel=0.02)
    assert result["verdict"]["trust"] in {"yes", "with care"} and result["validation"]["held_out_rms"]
    page = Path("run/report.html").read_text(encoding="utf-8")
    assert "What next" in page and "position_1" in page
    for command in (("export", "run", "--format", "mjcf"), ("report", "run"), ("runs", "."), ("diff", "run", "run")):
        assert hil(*command) == 0
    assert Path("run/arm.xml").is_file() and "No significant changes" in capsys.readouterr().out
    assert hil("export", "run", "--format", "csv") != 0 and "another tool" in capsys.readouterr().err
    assert hil("compare", "run") != 0 and "another tool" in capsys.readouterr().err
    assert api.load_model("run").joints[0].name == "joint_1"


@pytest.mark.slow
def test_the_same_arm_gives_the_same_numbers_from_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    motion = two_joints(40.0)
    truth = base_parameters(motion.arm)
    assert truth is not None
    as_csv(motion)
    as_parquet(motion)
    found = []
    for name in ("arm.csv", "arm.parquet"):
        assert hil("estimate", name, "--config", held(), "--out", f"run_{name[4:]}", "--json") == 0
        found.append(json.loads(capsys.readouterr().out))
    first, second = found
    assert first["verdict"]["trust"] == second["verdict"]["trust"] == "yes"
    for name, value in truth.items():
        entry = first["parameters"][name]
        assert second["parameters"][name]["value"] == pytest.approx(entry["value"], rel=1e-6)
        assert abs(entry["value"] - value) < max(0.02 * abs(value), 3.0 * entry["std"])
