"""Studies in trouble: workers and schedulers that die, runs without end, folders that change, arms that would move."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="Dask is not installed: pip install 'hil[study]'")

from hil.errors import ConfigError, MissingExtra, RunFolderError, SchedulerLost
from hil.study import engine
from hil.study.checks import check_study
from hil.study.dataset import Dataset
from hil.study.folder import opened
from hil.study.jobs import each
from hil.study.run import StudyProgress, run_study
from hil.study.schema import Study, load_study
from hil.study.work import Spec, lost_row, work
from tests.support.paths import CONFIGS

EMPTY = '[study]\ntask = "empty"\nruns = {runs}\n'
FAULT = """[study]
task = "fault"
config = "fake_two_link_ideal"
[vary]
"fake.faults.0.kind" = ["stuck_joint", "silent_servo"]
"fake.faults.0.servo" = [2]
"fake.faults.0.at" = [3.0]
"experiment.period" = [2.0]
"experiment.rate" = [200.0]
"experiment.band.0" = [0.5]
"""


def study(tmp_path: Path, text: str) -> Study:
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    return load_study(path)


def double(value: int) -> int:
    if value == 7:
        raise ValueError("seven")
    return 2 * value


def die_at(value: int) -> int:
    if value == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def test_each_gives_results_in_order_and_raises_what_was_raised(cluster: str) -> None:
    assert each(double, range(5), scheduler=cluster) == [0, 2, 4, 6, 8]
    with pytest.raises(ValueError, match="seven"):
        each(double, range(9), scheduler=cluster)


def test_a_job_that_kills_every_worker_is_given_up_and_the_others_are_done(monkeypatch: pytest.MonkeyPatch) -> None:
    from hil.study.engine import workers
    from hil.study.jobs import run_jobs
    from hil.study.schema import EngineTable

    monkeypatch.setattr("hil.study.engine._MOST_DEATHS", 0)
    with workers(EngineTable(), None, 1) as client:
        ended = {each.number: each for each in run_jobs(client, die_at, enumerate(range(6)))}
    # If no death is allowed, a run that waited on the same worker fails with it.
    given_up = {number for number, each in ended.items() if each.error is not None}
    assert 3 in given_up and len(given_up) <= 2
    assert all(each.result == number for number, each in ended.items() if number not in given_up)
    assert set(ended) == set(range(6))
    row = lost_row(Spec(3, "empty", "", {}, ("*",)), ended[3].error)
    assert row["status"] == "failed"
    assert "worker_memory_gib" in str(row["message"])


def test_a_run_without_end_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def endless(*_: object) -> None:
        while True:
            pass

    monkeypatch.setattr("hil.study.work._done", endless)
    row = work(Spec(1, "empty", "", {}, ("*",), seconds=0.1))
    assert row["status"] == "failed"
    assert row["message"] == "OutOfTime: took more than 0.1 s of processor time (engine.run_seconds)"


def test_a_worker_that_joined_later_with_other_versions_is_named() -> None:
    row = work(Spec(1, "empty", "", {}, ("*",), versions={"numpy": "0.1"}))
    assert row["status"] == "failed"
    assert "has numpy" in str(row["message"]) and "not 0.1" in str(row["message"])


def test_a_second_process_is_kept_out(tmp_path: Path) -> None:
    made, out = study(tmp_path, EMPTY.format(runs=2)), tmp_path / "out"
    with (
        opened(made, out, 2, resume=False),
        pytest.raises(RunFolderError, match="Another process"),
        opened(made, out, 2, resume=True),
    ):
        pass


def test_what_a_study_was_begun_with_must_be_there_still(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = tmp_path / "arm.toml"
    arm.write_bytes((CONFIGS / "fake_two_link_ideal.toml").read_bytes())
    made, out = study(tmp_path, '[study]\ntask = "dry_run"\nconfig = "arm.toml"\nruns = 2\n'), tmp_path / "out"
    with opened(made, out, 2, resume=False):
        pass
    with monkeypatch.context() as patched, pytest.raises(ConfigError, match="started with hil 0"):
        patched.setattr("hil.study.engine.__version__", "99.0")
        with opened(made, out, 2, resume=True):
            pass
    arm.write_bytes(arm.read_bytes() + b"\n# changed\n")
    with pytest.raises(ConfigError, match="the arm's file has changed"), opened(made, out, 2, resume=True):
        pass


def test_no_real_arm_is_moved(tmp_path: Path) -> None:
    text = '[study]\ntask = "{task}"\nconfig = "fake_two_link"\n[vary]\n"port.url" = ["/dev/ttyUSB0"]\n'
    for task in ("identify", "fault"):
        with pytest.raises(ConfigError, match="a study never moves a real arm"):
            check_study(study(tmp_path, text.format(task=task)), tmp_path / "out")
    check_study(study(tmp_path, text.format(task="dry_run")), tmp_path / "out")


def test_a_run_of_an_arm_in_space_finds_its_urdf(tmp_path: Path) -> None:
    from hil.study.checks import arm_toml

    made = study(tmp_path, '[study]\ntask = "identify"\nconfig = "fake_open_manipulator_x"\nruns = 1\n')
    check_study(made, tmp_path / "out")
    text = arm_toml(made, 0)
    assert f'urdf = "{CONFIGS / "open_manipulator_x_like.urdf"}"' in text


def test_faults_are_rows_that_say_how_it_ended(tmp_path: Path, cluster: str) -> None:
    rows = run_study(study(tmp_path, FAULT), tmp_path / "out", scheduler=cluster).table().to_pylist()
    assert [row["status"] for row in rows] == ["done", "done"], [row["message"] for row in rows]
    assert [row["fault.outcome"] for row in rows] == ["stopped", "stopped"]
    assert rows[1]["fault.cause"] == "missing replies"
    assert all(0.0 < row["fault.stopped_after_s"] < 1.0 for row in rows)
    assert rows[0]["fault.torque_off_confirmed"] and not rows[1]["fault.torque_off_confirmed"]
    assert not any("hil-study-" in str(value) for row in rows for value in row.values())


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[str, "subprocess.Popen[bytes]"]]:
    """A Dask scheduler and a worker as a user would start them, with several threads; yields the address."""
    port_file = tmp_path / "scheduler.json"
    python, quiet = [sys.executable, "-m"], {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(port_file)]
    first = subprocess.Popen([*python, "distributed.cli.dask_scheduler", *words], **quiet)  # type: ignore[call-overload]
    words = ["--scheduler-file", str(port_file), "--nthreads", "2", "--no-dashboard", "--no-nanny"]
    words += ["--local-directory", str(tmp_path)]
    second = subprocess.Popen([*python, "distributed.cli.dask_worker", *words], **quiet)  # type: ignore[call-overload]
    try:
        import json

        while not port_file.exists() or not port_file.read_text(encoding="utf-8").strip():
            assert first.poll() is None
            time.sleep(0.05)
        yield json.loads(port_file.read_text(encoding="utf-8"))["address"], first
    finally:
        for process in (second, first):
            process.kill()
            process.wait()


def test_a_scheduler_that_dies_is_told_and_the_study_resumed(
    tmp_path: Path, scheduler: tuple[str, "subprocess.Popen[bytes]"], cluster: str
) -> None:
    address, process = scheduler
    made, out = study(tmp_path, EMPTY.format(runs=1000)), tmp_path / "out"

    def kill(progress: StudyProgress) -> None:
        if progress.done == 100:
            process.kill()

    with pytest.raises(SchedulerLost, match="--resume"):
        run_study(made, out, scheduler=address, watch=kill)
    kept = Dataset(out / "rows").done()
    assert 100 <= len(kept) < 1000
    dataset = run_study(made, out, resume=True, scheduler=cluster)
    assert dataset.table().column("run").to_pylist() == list(range(1000))


@pytest.fixture
def queue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A queue of one machine: an sbatch that starts each job at once, and the scancel that ends it."""
    pytest.importorskip("dask_jobqueue", reason="pip install 'hil[slurm]'")
    folder = tmp_path / "bin"
    folder.mkdir()
    scripts = {
        "sbatch": f'setsid bash "$1" > {tmp_path}/job.$$.out 2>&1 < /dev/null &\n'
        f'echo $! > {tmp_path}/job.$$.pid\necho "Submitted batch job $$"\n',
        "scancel": f'for n in "$@"; do kill -TERM -- -$(cat {tmp_path}/job.$n.pid); done\n',
    }
    for name, text in scripts.items():
        (folder / name).write_text(f"#!/bin/bash\n{text}", encoding="utf-8")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")
    return folder


def test_workers_are_jobs_of_a_slurm_queue(tmp_path: Path, queue: Path) -> None:
    dataset = run_study(study(tmp_path, EMPTY.format(runs=20)), tmp_path / "out", scheduler="slurm", worker_count=1)
    assert dataset.table().column("run").to_pylist() == list(range(20))
    jobs = list(tmp_path.glob("job.*.out"))
    assert len(jobs) == 1
    assert os.getpid() not in dataset.table().column("worker").to_pylist()


def test_a_queue_that_refuses_is_quoted_and_nothing_is_left(tmp_path: Path, queue: Path) -> None:
    (queue / "sbatch").write_text("#!/bin/bash\necho 'invalid partition: gpu' >&2\nexit 1\n", encoding="utf-8")
    made, out = study(tmp_path, EMPTY.format(runs=20)), tmp_path / "out"
    with pytest.raises(ConfigError, match="rejected the workers: invalid partition: gpu"):
        run_study(made, out, scheduler="slurm", worker_count=1)
    assert not out.exists()


def test_an_address_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give its address"):
        run_study(study(tmp_path, EMPTY.format(runs=2)), tmp_path / "out", scheduler="somewhere")


def test_half_an_extra_is_a_missing_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(engine, "version", gone)
    with pytest.raises(MissingExtra, match=r"pip install 'hil\[study\]'"):
        engine._package_versions.__wrapped__()
