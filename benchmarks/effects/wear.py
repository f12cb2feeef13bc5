"""`hil diff` on pairs of runs of one fake arm: how many changes it finds, and how many false alarms it raises.

    python -m benchmarks.effects.wear --runs 6

The arm is identified `--runs` times unchanged, and twice after each friction term of each joint has changed by 10 %.
With --other-motion every run uses a different excitation; without it, runs of the noiseless fake arms are identical.
Every changed run is compared with every unchanged one, and the unchanged runs with each other.
"""

import argparse
import itertools
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import hil
from hil.config.schema import Config, load_config
from hil.errors import SafetyStop
from hil.estimation.changes.diff import Difference, diff_runs
from tests.support.paths import CONFIGS

TERMS = ("viscous", "coulomb", "stribeck_rise")
FACTOR = 1.1


@dataclass(frozen=True)
class Identified:
    """One run. changed: the term that was changed, such as "viscous_1"; empty for the unchanged arm."""

    changed: str
    path: Path


def main() -> None:
    """Identify, compare all pairs, and print shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arm", type=Path, default=CONFIGS / "fake_two_link.toml")
    parser.add_argument("--runs", type=int, default=6, help="runs of the unchanged arm")
    parser.add_argument("--other-motion", action="store_true", help="a different excitation in every run")
    parser.add_argument("--out", type=Path, help="folder for the runs; existing ones are reused")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    folder = chosen.out or Path(tempfile.mkdtemp(prefix="wear-"))
    found = list(identify_all(load_config(chosen.arm), chosen.runs, chosen.other_motion, folder))
    unchanged = [run for run in found if not run.changed]
    alarms = [diff_runs(a.path, b.path) for a, b in itertools.permutations(unchanged, 2)]
    false = [each for each in alarms if each.changed]
    figures: dict[str, dict[str, float]] = {"unchanged": {"pairs": len(alarms), "false_alarms": len(false)}}
    if not chosen.json:
        print(f"unchanged: {len(false)} of {len(alarms)} pairs show a change")
        for each in false:
            print("   ", ", ".join(f"{change.name} {change.z:+.1f}" for change in each.changed))
    for name in sorted({run.changed for run in found} - {""}):
        pairs = [diff_runs(a.path, b.path) for a in unchanged for b in found if b.changed == name]
        seen = sum(in_its_joint(each, name) for each in pairs)
        least = sorted(each.detectable.get(name, float("nan")) for each in pairs)[len(pairs) // 2]
        figures[name] = {"pairs": len(pairs), "found": seen, "detectable_percent": least}
        if not chosen.json:
            print(f"{name:16s} {seen} of {len(pairs)} found; detectable from {least:.2g} %")
    if chosen.json:
        print(json.dumps(figures))


def identify_all(config: Config, runs: int, other_motion: bool, folder: Path) -> Iterator[Identified]:
    """Identify the unchanged arm `runs` times, and every changed arm twice. config: configuration of a fake arm with
    two joints.
    """
    seed = 0
    wanted = [""] * runs + [f"{term}_{joint}" for term in TERMS for joint in (1, 2) for _ in range(2)]
    for changed in wanted:
        seed += 1
        path = folder / f"{seed:02d}-{changed or 'same'}"
        if not (path / "result.json").is_file():
            seed = _identify(config, changed, seed, other_motion, folder, path)
        yield Identified(changed, path)


def _identify(config: Config, changed: str, seed: int, other_motion: bool, folder: Path, path: Path) -> int:
    """Identify with this seed or, if its motion exceeds limits, with the next suitable one; return the seed used."""
    for tried in range(seed, seed + 20):
        try:
            hil.identify(arm_after(config, changed, tried, other_motion, folder), out=path)
        except SafetyStop:
            shutil.rmtree(path)
        else:
            return tried
    raise SystemExit(f"no motion within the limits from seed {seed} on")


def arm_after(config: Config, changed: str, seed: int, other_motion: bool, folder: Path) -> Path:
    """Write the arm's file with one term changed, and return the path of that file."""
    lines = config.path.read_text(encoding="utf-8").splitlines()
    term, _, joint = changed.rpartition("_")
    drive, table = 0, ""
    for number, line in enumerate(lines):
        if line.startswith("["):
            table = line.strip()
            drive += table == "[[fake.arm.drives]]"
        key = line.split("=")[0].strip()
        if table == "[[fake.arm.drives]]" and key == term and str(drive) == joint:
            value = float(line.split("=")[1].split("#")[0])
            lines[number] = f"{key} = {FACTOR * value!r}"
        if key == "seed" and (table == "[fake]" or (table == "[experiment]" and other_motion)):
            lines[number] = f"seed = {seed}"
    path = folder / f"{seed:02d}.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def in_its_joint(found: Difference, changed: str) -> bool:
    """Whether a significant change concerns friction of the joint that was changed."""
    joint = changed[-1]
    terms = ("viscous", "coulomb", "stribeck", "friction", "load")
    return any(
        change.name.startswith(terms) and change.name.split(":")[0].rpartition("_")[2] == joint
        for change in found.changed
    )


if __name__ == "__main__":
    main()
