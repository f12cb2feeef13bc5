"""Which silences a spatial arm survives: one servo does not answer for a while, or another master polls.

    python benchmarks/safety/lowered.py [--draws N] [--json]

`fake_open_manipulator_x` is stopped in mid-motion, in virtual time, at 100 to 400 Hz; time and servo are drawn at
random.
Printed per rate and duration: how many of the arms were lowered to their rest pose, of those that were stopped.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from hil.config.schema import load_config
from hil.drivers.errors import DriverError
from hil.errors import ExperimentError
from hil.experiment.run import run_experiment
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

NAME, URDF = "fake_open_manipulator_x.toml", "open_manipulator_x_like.urdf"
RATES = (100, 133, 200, 250, 400)
SILENT_MS = (16, 20, 24, 28, 50)
POLLS_MS = (2, 4, 10)
"""Time between two packets of the other master [ms]."""


def outcome(rate: int, fault: str) -> str:
    """Run the arm with this fault; return "lowered", "fell" or "went on"."""
    text = replaced(
        (CONFIGS / NAME).read_text(encoding="utf-8"),
        ("period = 10.0", "period = 5.0"),
        ("rate = 400.0", f"rate = {rate}.0"),
        ("[fake.chain]\n", f"[[fake.faults]]\n{fault}\n[fake.chain]\n"),
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / URDF).write_bytes((CONFIGS / URDF).read_bytes())
        (folder / NAME).write_text(text, encoding="utf-8")
        config = load_config(folder / NAME)
        try:
            run_experiment(config, RunFolder.create(folder / "run", config), config.path, lambda _: None)
        except (ExperimentError, DriverError) as stop:
            notes = " ".join(getattr(stop, "__notes__", ()))
            return "lowered" if "was lowered to its rest pose" in notes else "fell"
    return "went on"


def count(rate: int, kind: str, lasts_ms: int, draws: int) -> tuple[int, int]:
    """Numbers of arms that were lowered and that were stopped."""
    random = Random(f"{kind} {rate} {lasts_ms}")
    outcomes = []
    for _ in range(draws):
        fault = f'kind = "{kind}"\nservo = {random.randint(1, 4)}\nat = {random.uniform(3.2, 4.2):.4f}\n'
        fault += f"duration = {lasts_ms / 1e3}\n" if kind == "silent_servo" else f"amount = {lasts_ms / 1e3}\n"
        outcomes.append(outcome(rate, fault))
    return outcomes.count("lowered"), draws - outcomes.count("went on")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    if not options.json:
        print(machine())
    for kind, lasts in (("silent_servo", SILENT_MS), ("other_master", POLLS_MS)):
        for rate in RATES:
            found = {each: count(rate, kind, each, options.draws) for each in lasts}
            if options.json:
                print(json.dumps({"kind": kind, "rate": rate, "lowered_of_stopped": found}))
                continue
            cells = ", ".join(f"{each} ms: {lowered} of {stopped}" for each, (lowered, stopped) in found.items())
            print(f"{kind} {rate} Hz: {cells}", flush=True)


if __name__ == "__main__":
    main()
