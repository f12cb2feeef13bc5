"""Benchmark figures for the report, the exports, the model in Python and the package.

    python benchmarks/effects/takeaway.py [--json]

Identifies the realistic fake arm once, then takes the measurements from its run folder. Some figures need mujoco, pin
(pinocchio), hatchling or Chromium; if one of them is not installed, the output says so.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np

from benchmarks.machine import machine
from hil import load_model
from hil.arm_model import ArmModel
from hil.config.schema import load_config
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.export.formats import export
from hil.report.page import write_report
from hil.report.run_data import RunData
from hil.runs.run_folder import RunFolder

ROOT = Path(__file__).parents[2]
SAMPLES = 1_000_000


def best_seconds(task: Callable[[], object], repeats: int = 5) -> float:
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        task()
        times.append(time.perf_counter() - started)
    return min(times)


def identified(folder: Path) -> Path:
    config = load_config(Path("fake_two_link"))
    run = RunFolder.create(folder / "run", config)
    run_experiment(config, run, config.path, lambda _: None)
    estimate_run(run)
    return run.path


def report(run: Path) -> dict[str, Any]:
    page = run / "report.html"
    code = f"import sys; sys.argv = ['hil', 'report', {str(run)!r}]; from hil.cli.app import main; main()"
    return {
        "writing the report, new process [s]": best_seconds(
            lambda: subprocess.run([sys.executable, "-c", code], check=True, capture_output=True), 3
        ),
        "writing the report, within identify [s]": best_seconds(lambda: write_report(RunData.load(run), page)),
        "report size [MB]": page.stat().st_size / 1e6,
        "report opens in Chromium [s]": opening(page),
    }


def opening(page: Path) -> float | str:
    """Time until the page's load event [s], as measured by the page itself."""
    browser = shutil.which("chromium")
    if browser is None:
        return "chromium is not installed"
    note = (
        "<script>addEventListener('load', () => { document.title = 'loaded ' + performance.now(); });</script></body>"
    )
    watched = page.with_name("watched.html")
    watched.write_text(page.read_text(encoding="utf-8").replace("</body>", note), encoding="utf-8")
    command = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", watched.as_uri()]
    dom = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = re.search(r"loaded ([\d.]+)", dom)
    return float(found[1]) / 1e3 if found else "did not load"


def model(run: Path) -> dict[str, Any]:
    arm = load_model(run)
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, SAMPLES, 2))
    return {"inverse dynamics of 10^6 samples [s]": best_seconds(lambda: arm.inverse_dynamics(q, dq, ddq))}


def engines(run: Path) -> dict[str, Any]:
    arm = load_model(run)
    q, dq, ddq = (np.random.default_rng(1).normal(size=(500, 2)) * scale for scale in (1.0, 4.0, 30.0))
    found: dict[str, Any] = {}
    for name, theirs in (("MuJoCo", in_mujoco), ("pinocchio", in_pinocchio)):
        try:
            torque, left_to_us = theirs(run, arm, q, dq, ddq)
        except ImportError as error:
            found[f"{name} against ours"] = f"{error.name} is not installed"
            continue
        ours = arm.rigid_body_torque(q, dq, ddq)
        found[f"{name} against ours, of peak torque"] = float(
            np.abs(torque + left_to_us - ours).max() / np.abs(ours).max()
        )
    return found


def in_mujoco(run: Path, arm: ArmModel, q: Any, dq: Any, ddq: Any) -> tuple[Any, Any]:
    import mujoco

    engine = mujoco.MjModel.from_xml_path(str(export(run, "mjcf").path))
    engine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(engine)
    torque = np.empty_like(q)
    for row in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[row], dq[row], ddq[row]
        mujoco.mj_inverse(engine, data)
        torque[row] = data.qfrc_inverse
    return torque, -dq * [arm.values["viscous_1"], arm.values["viscous_2"]]


def in_pinocchio(run: Path, arm: ArmModel, q: Any, dq: Any, ddq: Any) -> tuple[Any, Any]:
    import pinocchio

    engine = pinocchio.buildModelFromUrdf(str(export(run, "urdf").path))
    data = engine.createData()
    torque = np.array([pinocchio.rnea(engine, data, *row) for row in zip(q, dq, ddq, strict=True)])
    return torque, ddq * [0.0, arm.values["armature_2"]]


def examples(run: Path) -> dict[str, Any]:
    found = {}
    for name in ("feed_forward", "gravity_compensation"):
        command = [sys.executable, str(ROOT / "examples" / f"{name}.py"), str(run)]
        printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        times = [float(number) for number in re.findall(r"([\d.]+) times smaller", printed)]
        found[f"{name}: error reduction factor, worst joint"] = min(times)
    return found


def package(folder: Path) -> dict[str, Any]:
    import_code = "import time; start = time.perf_counter(); import hil; print(time.perf_counter() - start)"
    found: dict[str, Any] = {
        "import hil [s]": min(float(subprocess.check_output([sys.executable, "-c", import_code])) for _ in range(5))
    }
    build = f"import hatchling.build; hatchling.build.build_wheel({str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=ROOT, capture_output=True, check=False)
    wheels = list(folder.glob("*.whl"))
    found["wheel [MB]"] = (
        wheels[0].stat().st_size / 1e6 if wheels and not done.returncode else "hatchling is not installed"
    )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run = identified(folder)
        measured = {**report(run), **model(run), **engines(run), **examples(run), **package(folder)}
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for what, value in measured.items():
        print(f"  {what:46s} {value if isinstance(value, str) else f'{value:.3g}'}")


if __name__ == "__main__":
    main()
