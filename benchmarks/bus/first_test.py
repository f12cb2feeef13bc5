"""Time from an empty environment to the first passing test of a third party's driver.

    python benchmarks/bus/first_test.py [--from wheel|clone|git] [--json]

The script installs hil in a fresh environment and runs a test of a few lines. ROBOTIS' own SDK stands in for the third
party's driver. `pip` uses the package index that it is configured for. The test runs twice, because the first run after
installation also compiles Python's bytecode.

lines             number of lines of the test, excluding imports of the driver
install_seconds   time for creating the environment and installing hil and pytest, limited by index and disk
first_seconds     time of the first run of pytest
seconds           sum of both: the wait until the first passing test
wheel_seconds     time for building the wheel, not included in `seconds`, because users download the wheel
again_seconds     time of the second run of pytest
passed            whether the test passed
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
TEST = """from dynamixel_sdk import PacketHandler, PortHandler


def test_ping(fake_pty):
    port = PortHandler(fake_pty("koch").path)
    assert port.openPort() and port.setBaudRate(1_000_000)
    assert PacketHandler(2.0).ping(port, 3)[:2] == (1200, 0)
"""


def timed(*command: str | Path, cwd: Path) -> tuple[float, "subprocess.CompletedProcess[str]"]:
    began = time.perf_counter()
    done = subprocess.run(list(map(str, command)), cwd=cwd, capture_output=True, text=True, check=False)
    return time.perf_counter() - began, done


def source(kind: str, folder: Path) -> tuple[str, float]:
    """The argument of `pip install` that selects hil, and the time for building its wheel [s]."""
    if kind == "clone":
        return str(ROOT), 0.0
    if kind == "git":
        return f"git+file://{ROOT}", 0.0
    seconds, done = timed(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT, cwd=folder)
    if done.returncode:
        sys.exit(done.stderr)
    return str(next(folder.glob("hil-*.whl"))), seconds


def measure(kind: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "test_driver.py").write_text(TEST, encoding="utf-8")
        what, wheel = source(kind, folder)
        made, _ = timed(sys.executable, "-m", "venv", "env", cwd=folder)
        python = folder / "env" / "bin" / "python"
        install, done = timed(python, "-m", "pip", "install", "-q", what, "pytest", cwd=folder)
        if done.returncode:
            sys.exit(done.stderr)
        first, run = timed(python, "-m", "pytest", "-q", "test_driver.py", cwd=folder)
        again, _ = timed(python, "-m", "pytest", "-q", "test_driver.py", cwd=folder)
    return {
        "lines": len(TEST.split("\n\n\n")[1].splitlines()),
        "install_seconds": round(made + install, 1),
        "first_seconds": round(first, 1),
        "seconds": round(made + install + first, 1),
        "wheel_seconds": round(wheel, 1),
        "again_seconds": round(again, 1),
        "passed": run.returncode == 0,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--from", dest="kind", choices=("wheel", "clone", "git"), default="wheel")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    measured = measure(options.kind)
    if options.json:
        print(json.dumps(measured))
        return
    for key, value in measured.items():
        print(f"{key:18s} {value}")


if __name__ == "__main__":
    main()
