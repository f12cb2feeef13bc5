"""Studies on a distributed engine: speed-up with two workers, overhead per run, and robustness against killed workers.

    python benchmarks/study.py [--runs 200] [--empty 10000] [--json]

speedup_2         wall time with one worker over that with two, for the same short identifications
overhead_ms       wall time of an empty run with one worker, scheduler and writer included [ms]
same              whether 1, 2 and 4 workers give exactly the same rows, except for timings
lost_after_kill   rows missing or duplicated after killing a worker five times and the whole engine once (then --resume)
bytes_a_run       Parquet size per identification with the default columns
worker_mb         largest memory of a worker during the empty runs; worker_mb_growth: its growth after the first tenth
rows              number of rows of the empty runs
"""

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import machine

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
    """Write the study next to an arm with short periods."""
    arm = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    for old, new in (("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]")):
        arm = arm.replace(old, new)
    (folder / "arm.toml").write_text(arm, encoding="utf-8")
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path


def timed(path: Path, out: Path, workers: int) -> tuple[float, Dataset]:
    """Wall time from the first row to the last [s], which excludes starting the workers; and the dataset."""
    seen: list[float] = []
    dataset = run_study(load_study(path), out, worker_count=workers, watch=lambda _: seen.append(time.perf_counter()))
    return seen[-1] - seen[min(workers, len(seen) - 1) - 1], dataset


def workers_of(parent: int) -> list[int]:
    """Process IDs of the Dask workers below `parent`, by decreasing memory size."""
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


def empty_runs(folder: Path, runs: int) -> dict[str, Any]:
    """Time and memory of runs that do nothing."""
    path = study_file(folder, EMPTY.format(runs=runs))
    memory: list[float] = []

    def look(progress: StudyProgress) -> None:
        if progress.done % max(1, runs // 10) == 0:
            memory.append(max([memory_mb(pid) for pid in workers_of(os.getpid())], default=0.0))

    seen: list[float] = []

    def watch(progress: StudyProgress) -> None:
        seen.append(time.perf_counter())
        look(progress)

    dataset = run_study(load_study(path), folder / "out", worker_count=1, watch=watch)
    return {
        "overhead_ms": round(1000 * (seen[-1] - seen[0]) / (len(seen) - 1), 2),
        "rows": dataset.table().num_rows,
        "worker_mb": round(max(memory), 1),
        "worker_mb_growth": round(memory[-1] - memory[0], 1),
    }


def killed(folder: Path, runs: int) -> int:
    """Rows lost or duplicated after killing workers `KILLS` times, then the engine, and resuming the study."""
    path = study_file(folder, IDENTIFY.format(runs=runs))
    out = folder / "out"
    command = [sys.executable, "-m", "hil", "study", str(path), "--out", str(out), "--workers", "2", "--quiet"]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    done = 0
    for _ in range(KILLS):
        done = _after(out, done + 1, process)
        for worker in workers_of(process.pid)[:1]:
            os.kill(worker, signal.SIGKILL)
    _after(out, done + 1, process)
    process.kill()
    process.wait()
    subprocess.run([*command, "--resume"], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rows = Dataset(out / "rows").table().column("run").to_pylist()
    return abs(len(rows) - runs) + len(set(range(runs)) ^ set(rows))


def _after(out: Path, rows: int, process: "subprocess.Popen[bytes]") -> int:
    """Wait until there are at least `rows` rows; return their number."""
    while process.poll() is None:
        found = len(Dataset(out / "rows").done()) if (out / "rows").is_dir() else 0
        if found >= rows:
            return found
        time.sleep(0.2)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--empty", type=int, default=10_000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = study_file(folder, IDENTIFY.format(runs=options.runs))
        seconds, rows = {}, {}
        for workers in (1, 2, 4):
            seconds[workers], dataset = timed(path, folder / f"out_{workers}", workers)
            rows[workers] = dataset.table().drop_columns(list(TIMINGS))
        size = sum(each.stat().st_size for each in (folder / "out_1" / "rows").iterdir())
        found: dict[str, Any] = {
            "machine": machine(),
            "speedup_2": round(seconds[1] / seconds[2], 2),
            "same": rows[1].equals(rows[2]) and rows[1].equals(rows[4]),
            "bytes_a_run": round(size / options.runs),
        }
        for part in ("empty", "killed"):
            shutil.rmtree(folder / part, ignore_errors=True)
            (folder / part).mkdir()
        found |= empty_runs(folder / "empty", options.empty)
        found["lost_after_kill"] = killed(folder / "killed", max(20, options.runs // 4))
    if options.json:
        print(json.dumps(found))
    else:
        for key, value in found.items():
            print(f"{key:18s} {value}")


if __name__ == "__main__":
    main()
