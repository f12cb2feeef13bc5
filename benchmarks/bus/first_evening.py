"""Run the commands of docs/first_evening.md one by one on a fake arm, on a pseudo-terminal or in virtual time.

    python -m benchmarks.bus.first_evening --out /tmp/evening

Every command is taken from the page. The script answers the questions of `hil init` and moves the joints with
`hil hand`; in virtual time, the joints are not moved, which `hil init` accepts. The script fails if a command fails,
shows a traceback, or does not name the next command, or if the arm moves for more than twelve minutes.
"""

import argparse
import contextlib
import json
import shlex
import sys
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.first_evening import Person, Typed, arm_seconds, commands_of, evening, fake_arm, faults_of
from tests.support.paths import CONFIGS

MOST_ARM_S = 720.0


def main() -> None:
    """Run the page's commands and print the outcome."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", type=Path, default=CONFIGS / "first_time.toml", help="the fake arm's file")
    parser.add_argument("--out", type=Path, help="folder in which to run the commands; it must be new")
    parser.add_argument("--virtual", action="store_true", help="in virtual time, independent of the computer's load")
    parser.add_argument(
        "--patient", action="store_true", help="after init, tolerate 90 ms without replies, for a busy computer"
    )
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    folder = chosen.out or Path(tempfile.mkdtemp(prefix="evening-"))
    folder.mkdir(parents=True, exist_ok=chosen.out is None)
    commands = commands_of()
    link = folder / "port"
    with contextlib.nullcontext() if chosen.virtual else fake_arm(chosen.arm, link):
        person = Person(folder, f"fake://{chosen.arm.resolve()}" if chosen.virtual else str(link))
        done = evening(person, commands, _edited(folder) if chosen.patient else _noted if chosen.json else _tell)
    faults = faults_of(done, commands)
    moved = None
    if (folder / "first_run").is_dir():
        rate = tomllib.loads((folder / "my_arm.toml").read_text(encoding="utf-8"))["experiment"]["rate"]
        moved = arm_seconds(folder / "first_run", rate)
        if not chosen.json:
            print(f"arm time {moved:.0f} s at {rate:g} Hz")
        if moved > MOST_ARM_S:
            faults.append(f"the arm moved for {moved:.0f} s; at most {MOST_ARM_S:.0f} s is allowed")
    if chosen.json:
        print(json.dumps({"commands": len(done), "faults": faults, "arm_seconds": moved}))
    else:
        print("\n".join(faults) or f"All {len(done)} commands worked, and each named the next.")
    raise SystemExit(bool(faults))


def _edited(folder: Path) -> Callable[[Typed], None]:
    """Return a function that reports each command and edits the file once `hil init` has written it."""

    def tell(typed: Typed) -> None:
        _tell(typed)
        if typed.words[1] == "init" and not typed.code:
            file = folder / "my_arm.toml"
            file.write_text(file.read_text(encoding="utf-8") + "missing_time = 0.09\n", encoding="utf-8")

    return tell


def _noted(_: Typed) -> None:
    """Report nothing: with --json, only the final figures are printed."""


def _tell(typed: Typed) -> None:
    named = "-" if typed.next is None else shlex.join(typed.next)
    print(f"{typed.seconds:6.0f} s  exit {typed.code}  {shlex.join(typed.words)}  -> {named}", flush=True)
    if typed.code:
        print(typed.text[-3000:])


if __name__ == "__main__":
    main()
