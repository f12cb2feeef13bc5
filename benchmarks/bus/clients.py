"""Run independent clients on the fake bus over a pseudo-terminal, and check the result of every call.

    python benchmarks/bus/clients.py                                    the clients installed in this environment
    python benchmarks/bus/clients.py --python /path/to/venv/bin/python  also the clients in that environment (LeRobot)
    python benchmarks/bus/clients.py --write                            update the table in docs/fake-bus.md
    python benchmarks/bus/clients.py --json                             one JSON object, with every call

The clients' calls are in `client_calls.py`, which does not import hil.
"""

import argparse
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.bus.client_calls import CLIENTS

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "fake-bus.md"
BEGIN, END = "<!-- clients: made by benchmarks/bus/clients.py -->\n", "<!-- clients: end -->\n"
PATIENCE_S = 180.0
ARMS = {
    "dynamixel_sdk": "fake_two_link",
    "rustypot": "fake_two_link",
    "dxl2": "fake_two_link",
    "pypot": "xl320",
    "lerobot_shadows": "viperx_300",
}
"""Fake arms of the clients that do not use `koch`."""

XL320 = """[fake]
plant = "hil.fakes.plants.independent:make_plant"
[[fake.servos]]
id = 1
model = "XL320"
zero_ticks = 512
[[fake.servos]]
id = 2
model = "XL320"
zero_ticks = 512
[[fake.plant_options.joints]]
gravity = 0.0
start = [0.0]
links = [{ length = 0.1, mass = 0.02, centre = 0.05, inertia = 1e-5 }]
drives = [{ mass = 0.017, rotor_inertia = 1e-8, gear_ratio = 238.0, torque_constant = 0.35 }]
[[fake.plant_options.joints]]
gravity = 0.0
start = [0.0]
links = [{ length = 0.1, mass = 0.02, centre = 0.05, inertia = 1e-5 }]
drives = [{ mass = 0.017, rotor_inertia = 1e-8, gear_ratio = 238.0, torque_constant = 0.35 }]
"""


@contextmanager
def served(arm: str) -> Iterator[str]:
    """Serve this arm on a pseudo-terminal; yields the terminal's path."""
    with tempfile.TemporaryDirectory() as folder:
        if arm == "xl320":
            arm = str(Path(folder) / "xl320.toml")
            Path(arm).write_text(XL320, encoding="utf-8")
        link = Path(folder) / "arm"
        command = [sys.executable, "-m", "hil", "fake", arm, "--pty", "--link", str(link), "--quiet"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
            assert process.stdout is not None
            ready, _, _ = select.select([process.stdout], [], [], 60.0)
            if not ready or not process.stdout.readline():
                raise RuntimeError(f"hil fake {arm} did not start")
            try:
                yield str(link)
            finally:
                process.send_signal(signal.SIGTERM)


def run(name: str, pythons: Sequence[str]) -> dict[str, Any]:
    """Run one client in the first of these Python environments in which it is installed."""
    outcome: dict[str, Any] = {"client": name, "missing": CLIENTS[name][1]}
    hil = [sys.executable, "-m", "hil"]
    environment = {**os.environ, "HIL": json.dumps(["env", f"PYTHONPATH={ROOT}", *hil])}
    environment.pop("PYTHONPATH", None)
    for python in pythons:
        with served(ARMS.get(name, "koch")) as device:
            command = [python, str(ROOT / "benchmarks" / "bus" / "client_calls.py"), name, device]
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=PATIENCE_S, env=environment, check=False
            )
        lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
        if not lines:
            return {"client": name, "results": [{"call": "(client)", "wrong": done.stderr[-300:]}], "version": "?"}
        outcome = json.loads(lines[-1])
        if "missing" not in outcome:
            break
    return outcome


def table(outcomes: Sequence[dict[str, Any]]) -> str:
    """The outcomes as a Markdown table."""
    lines = ["| client | version | arm | calls right | wrong |", "|---|---|---|---|---|"]
    for outcome in outcomes:
        name = outcome["client"]
        arm = ARMS.get(name, "koch")
        if "missing" in outcome:
            lines.append(f"| {name} | | {arm} | not run: {outcome['missing']} was not installed | |")
            continue
        wrong = [f"{each['call']} ({each['wrong'][:80]})" for each in outcome["results"] if each["wrong"]]
        count = len(outcome["results"])
        lines.append(
            f"| {name} | {outcome['version']} | {arm} | {count - len(wrong)} of {count} | {'; '.join(wrong)} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", default=[], help="another environment's interpreter")
    parser.add_argument("--only", action="append", choices=sorted(CLIENTS), help="this client; may be repeated")
    parser.add_argument("--write", action="store_true", help="update the table in docs/fake-bus.md")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    pythons = [sys.executable, *options.python]
    outcomes = [run(name, pythons) for name in options.only or CLIENTS]
    made = table(outcomes)
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        before, _, rest = text.partition(BEGIN)
        _, _, after = rest.partition(END)
        PAGE.write_text(before + BEGIN + made + END + after, encoding="utf-8")
    print(json.dumps(outcomes) if options.json else made)


if __name__ == "__main__":
    main()
