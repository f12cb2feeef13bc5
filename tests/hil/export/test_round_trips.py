"""Exported files read back without loss."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from hil import load_model
from hil.errors import ExportError
from hil.export.columns import columns
from hil.export.formats import export
from hil.export.source import Recorded
from hil.runs.run_folder import RunFolder


@pytest.fixture
def run(identified: Path) -> Path:
    """A run in which one servo missed replies."""
    path = identified / "samples.npy"
    samples = np.load(path)
    for name in ("position", "velocity", "current"):
        samples[name][100:103, 1] = np.nan
    samples["missing"][100:103, 1] = 1
    np.save(path, samples)
    return identified


@pytest.mark.parametrize("name", ["toml", "json"])
def test_parameters(run: Path, name: str) -> None:
    written = export(run, name)
    assert written.left_out == []
    assert load_model(written.path) == load_model(run)


def test_an_export_never_replaces_a_file_of_the_run(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (run / "result.json").read_bytes()
    with pytest.raises(ExportError, match=r"result\.json is one of the run's own files"):
        export(run, "json", run / "result.json")
    assert (run / "result.json").read_bytes() == before
    own = RunFolder(run).own_files()
    assert {"config.toml", "samples.npy", "result.json", "run.json"} <= own
    (run / "arm.urdf").write_text("the user's own", encoding="utf-8")
    monkeypatch.setattr(RunFolder, "own_files", lambda _: own | {"arm.urdf"})  # as if [arm] urdf named it
    assert export(run, "urdf").path == run / "identified_arm.urdf"
    assert (run / "arm.urdf").read_text(encoding="utf-8") == "the user's own"


def test_an_infinite_error_bar_stays_infinite(run: Path) -> None:
    path = run / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    result["parameters"]["offset_1"]["std"] = float("inf")
    path.write_text(json.dumps(result), encoding="utf-8")
    for name in ("toml", "json"):
        assert load_model(export(run, name).path).stds["offset_1"] == float("inf")


def test_csv(run: Path) -> None:
    written = export(run, "csv")
    with written.path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    expected = columns(Recorded.open(run))
    assert head == list(expected)
    for name, text in zip(head, zip(*rows, strict=True), strict=True):
        found = np.array(text, dtype=np.float64).astype(expected[name].dtype)
        np.testing.assert_array_equal(found, expected[name])
    assert "the identified parameters" in written.left_out[0]


def test_parquet(run: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed: pip install 'hil[export]'")
    table = parquet.read_table(export(run, "parquet").path)
    expected = columns(Recorded.open(run))
    assert table.column_names == list(expected)
    for name, column in expected.items():
        found = table[name].to_numpy()
        assert found.dtype == column.dtype
        np.testing.assert_array_equal(found, column)
    assert table.schema.field("position_1").metadata[b"unit"] == b"rad"
    kept = json.loads(table.schema.metadata[b"hil_result"])
    assert kept == json.loads((run / "result.json").read_text(encoding="utf-8"))


def test_mat(run: Path) -> None:
    from scipy.io import loadmat

    file = loadmat(export(run, "mat").path, squeeze_me=True, simplify_cells=True)
    expected = columns(Recorded.open(run))
    for name, column in expected.items():
        assert file["samples"][name].dtype == column.dtype
        np.testing.assert_array_equal(file["samples"][name], column)
    assert file["units"]["position_1"] == "rad"
    assert file["parameters"] == load_model(run).values
    assert json.loads(file["result_json"])["schema"] == 1


def test_mcap(run: Path) -> None:
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed: pip install 'hil[export]'")
    samples = Recorded.open(run).samples
    with export(run, "mcap").path.open("rb") as file:
        opened = reader.make_reader(file)
        found: dict[str, list[dict[str, float]]] = {"/shoulder": [], "/elbow": []}
        stamps = []
        for schema, channel, message in opened.iter_messages(["/shoulder", "/elbow"]):
            assert schema.name == "hil.Sample"
            found[channel.topic].append(json.loads(message.data))
            stamps.append(message.log_time)
        (attached,) = opened.iter_attachments()
    shared = ("deadline", "time_before_write", "time_after_read", "phase", "segment", "period")
    assert attached.data == json.dumps(json.loads((run / "result.json").read_text("utf-8")), indent=2).encode()
    for joint, topic in enumerate(("/shoulder", "/elbow")):
        for name in set(samples.dtype.names) - set(shared):
            values = np.array([message[name] for message in found[topic]], dtype=np.float64)  # null becomes NaN
            np.testing.assert_array_equal(values, samples[name][:, joint].astype(np.float64))
        for name in shared:
            np.testing.assert_array_equal([message[name] for message in found[topic]], samples[name])
    assert np.ptp(stamps) * 1e-9 == pytest.approx(np.ptp(samples["deadline"]), abs=1e-6)


@pytest.mark.parametrize("name", ["csv", "parquet", "mat", "mcap"])
def test_a_recording_is_exported_before_it_is_estimated(run: Path, name: str) -> None:
    (run / "result.json").unlink()
    assert export(run, name).path.stat().st_size > 10_000
