"""Studies on a distributed engine: speed-up with two workers, overhead per run, and robustness against killed workers.

    python benchmarks/study.py [--runs 200] [--empty 10000] [--killed 50] [--only PART ...] [--json]

The parts are speed (one, two and four workers), empty and killed; together, they take a quarter of an hour on two idle
cores.

speedup_2         wall time with one worker divided by that with two, for the same short identifications
overhead_ms       wall time of an empty run with one worker, scheduler and writer included [ms]
same              whether 1, 2 and 4 workers, and the study that was killed, give exactly the same rows,
                  except for timings
lost_after_kill   rows missing or duplicated after a worker is killed five times and the engine once (then --resume)
bytes_a_run       Parquet size per identification with the default columns
worker_mb         largest memory of a worker in the empty runs; scheduler_mb: of the process with scheduler and
                  writer; *_growth: increase from the first tenth of the runs to the end
rows              number of rows of the empty runs; -1 if rows are missing or duplicated
seconds_a_run     processor time of a short identification, and wall time per identification with 1, 2 and 4 workers
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.machine import machine
from hil.study.dataset import Dataset
from hil.study.run import StudyProgress, run_study
from hil.study.schema import load_study
from hil.study.work import TIMINGS

CONFIGS = Path(__file__).parents[1] / "configs"
IDENTIFY = """[study]
task = "identify"
config = "arm.toml"
runs = {runs}
[vary]
"fake.seed" = {{ count = 1 }}
"fake.arm.drives.0.coulomb" = {{ log_uniform = [0.03, 0.08] }}
"""
EMPTY = '[study]\ntask = "empty"\nruns = {runs}\n[vary]\n"x" = {{ uniform = [0.0, 1.0] }}\n'
KILLS = 5


def study_file(folder: Path, text: str) -> Path:
    """Write the study's file next to the file of an arm with short periods."""
    arm = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    for old, new in (("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]")):
        arm = arm.replace(old, new)
    (folder / "arm.toml").write_text(arm, encoding="utf-8")
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def timed(path: Path, out: Path, workers: int) -> tuple[float, Dataset]:
    """Return the wall time per run [s], without each worker's first run, which includes compilation, and the rows."""
    seen: list[float] = []
    dataset = run_study(load_study(path), out, worker_count=workers, watch=lambda _: seen.append(time.perf_counter()))
    first = min(2 * workers, len(seen) - 1) - 1
    return (seen[-1] - seen[first]) / (len(seen) - 1 - first), dataset


def rows_of(dataset: Dataset) -> Any:
    return dataset.table().drop_columns(list(TIMINGS))


def workers_of(parent: int) -> list[int]:
    """Process IDs of the Dask workers below `parent`, in order of decreasing memory use."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and parent in _ancestors(int(entry.name)):
            command = (entry / "cmdline").read_bytes() if (entry / "cmdline").exists() else b""
            if b"spawn_main" in command or b"forkserver" in command:
                found.append(int(entry.name))
    return sorted(found, key=memory_mb, reverse=True)


def _ancestors(pid: int) -> set[int]:
    found: set[int] = set()
    while pid > 1:
        try:
            pid = int((Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, ValueError, IndexError):
            break
        found.add(pid)
    return found


def memory_mb(pid: int) -> float:
    try:
        return int((Path("/proc") / str(pid) / "statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    except (OSError, ValueError):
        return 0.0


def speed(folder: Path, runs: int) -> dict[str, Any]:
    """Compare the same identifications with 1, 2 and 4 workers."""
    path = study_file(folder, IDENTIFY.format(runs=runs))
    seconds, tables, cpu = {}, {}, 0.0
    for workers in (1, 2, 4):
        seconds[workers], dataset = timed(path, folder / f"out_{workers}", workers)
        tables[workers] = rows_of(dataset)
        cpu = cpu or statistics.median(dataset.table().column("cpu_seconds").to_pylist())
    size = sum(each.stat().st_size for each in (folder / "out_1" / "rows").iterdir())
    return {
        "speedup_2": round(seconds[1] / seconds[2], 2),
        "same": tables[1].equals(tables[2]) and tables[1].equals(tables[4]),
        "bytes_a_run": round(size / runs),
        "seconds_a_run": {"processor": cpu, **{str(workers): each for workers, each in seconds.items()}},
    }


def empty_runs(folder: Path, runs: int) -> dict[str, Any]:
    """Measure time and memory of runs that do nothing."""
    path = study_file(folder, EMPTY.format(runs=runs))
    memory: list[tuple[float, float]] = []
    seen: list[float] = []

    def watch(progress: StudyProgress) -> None:
        seen.append(time.perf_counter())
        if progress.done % max(1, runs // 10) == 0:
            largest = max([memory_mb(pid) for pid in workers_of(os.getpid())], default=0.0)
            memory.append((largest, memory_mb(os.getpid())))

    dataset = run_study(load_study(path), folder / "out", worker_count=1, watch=watch)
    rows = dataset.table().column("run").to_pylist()
    worker, scheduler = zip(*memory, strict=True)
    return {
        "overhead_ms": round(1000 * (seen[-1] - seen[0]) / (len(seen) - 1), 2),
        "rows": len(rows) if rows == list(range(runs)) else -1,
        "worker_mb": round(max(worker), 1),
        "worker_mb_growth": round(worker[-1] - worker[0], 1),
        "scheduler_mb": round(max(scheduler), 1),
        "scheduler_mb_growth": round(scheduler[-1] - scheduler[0], 1),
    }


def killed(folder: Path, runs: int) -> dict[str, Any]:
    """Count the rows that are lost or duplicated if workers are killed `KILLS` times, the engine is then killed, and
    the study is resumed.
    """
    path = study_file(folder, IDENTIFY.format(runs=runs))
    out = folder / "out"
    command = [sys.executable, "-m", "hil", "study", str(path), "--out", str(out), "--workers", "2", "--quiet"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    done = 0
    for _ in range(KILLS):
        done = _after(out, done + 1, process)
        os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    _after(out, done + 1, process)
    process.kill()
    process.wait()
    kept = len(Dataset(out / "rows").done())
    assert kept < runs, f"all {runs} runs were done before the engine was killed: increase --killed"
    subprocess.run([*command, "--resume"], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    dataset = Dataset(out / "rows")
    rows = dataset.table().column("run").to_pylist()
    undisturbed = run_study(load_study(path), folder / "undisturbed", worker_count=2)
    return {
        "lost_after_kill": abs(len(rows) - runs) + len(set(range(runs)) ^ set(rows)),
        "same": rows_of(dataset).equals(rows_of(undisturbed)),
        "rows_before_kill": kept,
    }


def _after(out: Path, rows: int, process: "subprocess.Popen[bytes]") -> int:
    """Wait until there are at least `rows` rows; return their number."""
    while process.poll() is None:
        found = len(Dataset(out / "rows").done()) if (out / "rows").is_dir() else 0
        if found >= rows:
            return found
        time.sleep(0.2)
    return rows


PARTS = ("speed", "empty", "killed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--empty", type=int, default=10_000)
    parser.add_argument("--killed", type=int, default=50, help="runs of the study that is killed")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found: dict[str, Any] = {"machine": machine()}
    with tempfile.TemporaryDirectory() as name:
        folders = {part: Path(name) / part for part in options.only}
        for folder in folders.values():
            folder.mkdir()
        if "speed" in folders:
            found |= speed(folders["speed"], options.runs)
        if "empty" in folders:
            found |= empty_runs(folders["empty"], options.empty)
        if "killed" in folders:
            after = killed(folders["killed"], options.killed)
            found |= {**after, "same": after["same"] and found.get("same", True)}
    if options.json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"{key:20s} {value}")


if __name__ == "__main__":
    main()
