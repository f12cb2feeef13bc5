"""Complete studies on real workers: the results do not depend on their number, and failures become rows."""

from pathlib import Path

import pyarrow as pa
import pytest

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'hil[study]'")

from hil.errors import ConfigError, RunFolderError
from hil.study.dataset import Dataset
from hil.study.engine import workers
from hil.study.run import StudyProgress, run_study
from hil.study.schema import EngineTable, load_study
from hil.study.work import TIMINGS
from tests.support.command_line import hil
from tests.support.edits import QUICK, replaced
from tests.support.paths import CONFIGS

STUDY = """
[study]
task = "identify"
config = "arm.toml"
runs = 4
seed = 3

[vary]
"fake.seed" = { count = 10 }
"fake.arm.drives.0.coulomb" = { log_uniform = [0.03, 0.06] }
"safety.max_missing" = [5, 5, 5, 1]
"experiment.peak_torque.0" = { choice = [0.30, 0.31] }

[keep]
columns = ["parameters.*.value", "verdict.trust"]
"""


@pytest.fixture
def study_file(tmp_path: Path) -> Path:
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    text = replaced(text, ("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]"), *QUICK)
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    path = tmp_path / "study.toml"
    path.write_text(STUDY, encoding="utf-8")
    return path


def without_timings(dataset: Dataset) -> pa.Table:
    return dataset.table().drop_columns(list(TIMINGS))


@pytest.mark.slow
def test_one_worker_and_two_give_the_same_rows(study_file: Path, tmp_path: Path) -> None:
    study_file.write_text(STUDY.replace("runs = 4", "runs = 2"), encoding="utf-8")
    study = load_study(study_file)
    seen: list[StudyProgress] = []
    one = run_study(study, tmp_path / "one", worker_count=1)
    two = run_study(study, tmp_path / "two", worker_count=2, watch=seen.append)
    assert without_timings(one).equals(without_timings(two))
    table = one.table()
    assert table.column("run").to_pylist() == [0, 1]
    assert table.column("status").to_pylist() == ["done"] * 2
    friction = table.column("vary.fake.arm.drives.0.coulomb").to_pylist()
    for drawn, found in zip(friction, table.column("parameters.coulomb_1.value").to_pylist(), strict=True):
        assert found == pytest.approx(drawn, rel=0.05)
    assert [each.done for each in seen] == [1, 2]


def test_a_study_is_resumed_where_it_stopped(study_file: Path, tmp_path: Path, cluster: str) -> None:
    text = STUDY.replace('task = "identify"', 'task = "empty"').replace("runs = 4", "runs = 40")
    study_file.write_text(text, encoding="utf-8")
    study, out = load_study(study_file), tmp_path / "out"

    class Stopped(Exception):
        pass

    def stop(progress: StudyProgress) -> None:
        if progress.done == 7:
            raise Stopped

    with pytest.raises(Stopped):
        run_study(study, out, scheduler=cluster, watch=stop)
    assert len(Dataset(out / "rows").done()) == 7
    with pytest.raises(RunFolderError, match="--resume"):
        run_study(study, out, scheduler=cluster)
    dataset = run_study(study, out, resume=True, scheduler=cluster)
    assert dataset.table().column("run").to_pylist() == list(range(40))
    study_file.write_text(text.replace("seed = 3", "seed = 4"), encoding="utf-8")
    with pytest.raises(ConfigError, match="is not the study"):
        run_study(load_study(study_file), out, resume=True)


def test_the_command_makes_rows_and_a_page(
    study_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    cluster: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    # A run whose arm exceeds its limits becomes a failed row and does not end the study.
    text = STUDY.replace('"safety.max_missing" = [5, 5, 5, 1]', '"joints.0.velocity_limit" = [15.0, 0.5]')
    study_file.write_text(text.replace("runs = 4", "runs = 2"), encoding="utf-8")
    assert hil("study", study_file, "--out", "out", "--scheduler", cluster) == 0
    said = capsys.readouterr().out
    assert "1 of 2 runs succeeded" in said
    assert "1 failed: SafetyStop" in said
    page = (tmp_path / "out" / "study.html").read_text(encoding="utf-8")
    assert "SafetyStop" in page and "parameters.coulomb_1.value" in page
    assert "http://" not in page and "https://" not in page


def test_nobody_at_the_address(study_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.study.engine._CONNECT_S", 0.2)
    with pytest.raises(ConfigError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"):
        run_study(load_study(study_file), study_file.parent / "out", scheduler="tcp://127.0.0.1:9")


def test_other_versions_on_a_worker_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.study.engine.__version__", "99.0")  # here, not on the worker
    with pytest.raises(ConfigError, match=r"Worker .* has hil .* \(here 99\.0\)"), workers(EngineTable(), None, 1):
        pass
