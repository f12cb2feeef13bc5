"""False alarms: how many healthy but unusual arms are stopped.

    python benchmarks/safety/healthy.py [--arms 60] [--first 0] [--show] [--json]

Each arm is a bundled planar configuration at 100 or 400 Hz with ramps of only 0.3 s. Its masses, torque constants and
friction differ from the description by factors of up to 2.2, 1.5 and 2.5, respectively, and it may have play,
presliding, cogging and cables that the description does not mention. Each arm is recorded twice: with and without
`arm.link_lengths`. Limits are wide, so only a check that mistakes a healthy arm for a faulty one can stop the run.
"""

import argparse
import json
import sys
from collections import Counter
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.fault_campaign.arms import Setting, make_document, names
from benchmarks.fault_campaign.campaign import DoesNotRun, prepare
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant

RATES = (100, 400)
PERIOD_S = 1.2
MASSES, TORQUES, FRICTION = 2.2, 1.5, 2.5
WIDE_RAD, WIDE_RAD_S = 3.1, 25.0
RESTS_S = 5.0

_SKIPPED = frozenset({"fake_inverted", "paper_two_link"})
"""Arms that are left out: an inverted arm, which only a controller designed for its exact description keeps upright,
and the seed paper's arm, which moves by only a few degrees.
"""


def draw(seed: int, setting: Setting, period: float, *, described: bool) -> dict[str, Any]:
    """The configuration of a healthy arm that differs from what `setting` describes."""
    random = Random(f"healthy {seed}")
    document = make_document(setting, period)
    fake = document["fake"]["arm"]
    about = random.uniform(-1.0, 1.0)
    peaks, poses = document["experiment"]["peak_torque"], document["arm"]["rest_pose"]
    for link, drive, peak, rest in zip(fake["links"], fake["drives"], peaks, poses, strict=True):
        heavier = MASSES ** (0.7 * about + 0.3 * random.uniform(-1.0, 1.0))
        for name in ("mass", "inertia"):
            link[name] *= heavier
        drive["torque_constant"] *= TORQUES ** random.uniform(-1.0, 1.0)
        for name in ("coulomb", "viscous"):
            drive[name] = drive.get(name, 0.0) * FRICTION ** random.uniform(-1.0, 1.0)
        if random.random() < 0.4:
            drive["backlash"] = random.uniform(1e-3, 3e-3)
        if random.random() < 0.3:
            stiffness = random.uniform(20.0, 200.0) * max(drive["coulomb"], 0.01)
            drive |= {"presliding_stiffness": stiffness, "coulomb_width": 0.0}
        if random.random() < 0.4:
            drive |= {"cogging": 0.1 * random.random() * peak, "cogging_cycles": float(random.choice((1, 3, 7)))}
        if random.random() < 0.3:
            drive |= {"cable_stiffness": 0.1 * random.random() * peak, "cable_angle": rest + random.uniform(-0.1, 0.1)}
    for joint, rest in zip(document["joints"], poses, strict=True):
        joint |= {"position_limit": [rest - WIDE_RAD, rest + WIDE_RAD], "velocity_limit": WIDE_RAD_S}
    document["arm"].pop("link_lengths", None)
    document["arm"].pop("prior", None)
    if described:
        document["arm"]["link_lengths"] = [link["length"] for link in fake["links"]]
    fake["start"] = come_to_rest(fake)
    return document


def come_to_rest(fake: dict[str, Any]) -> list[float]:
    """Pose in which the arm comes to rest [rad]; cogging and cables may hold it away from the nominal rest pose."""
    plant = make_plant(Arm.model_validate(fake))
    plant.advance(RESTS_S, (0.0,) * plant.joints)
    return list(plant.position)


def stopped(seed: int, *, described: bool) -> tuple[str, str]:
    """Record one arm; return its setting, and the error message if the run did not end as planned."""
    random = Random(f"setting {seed}")
    setting = Setting(random.choice([name for name in names() if name not in _SKIPPED]), random.choice(RATES))
    try:
        prepare(setting, PERIOD_S, partial(draw_again, seed, described))
    except DoesNotRun as error:
        return f"{setting.name} {setting.rate} Hz", str(error)
    return f"{setting.name} {setting.rate} Hz", ""


def draw_again(seed: int, described: bool, setting: Setting, period: float) -> dict[str, Any]:
    """Call `draw` with the arguments in the order that `prepare` uses."""
    return draw(seed, setting, period, described=described)


def cause(said: str) -> str:
    """Return a few words that identify the reason why a run was stopped."""
    for words in ("position limit", "velocity limit", "any arm consistent", "does not repeat", "against its command"):
        if words in said:
            return words
    return "other" if said else "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--show", action="store_true", help="print what stopped each arm")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = []
    for described in (True, False):
        counted: Counter[str] = Counter()
        for seed in range(options.first, options.first + options.arms):
            setting, said = stopped(seed, described=described)
            counted[cause(said)] += 1
            if said and options.show:
                print(f"arm {seed}, {setting}: {' '.join(said.split())[:400]}", file=sys.stderr, flush=True)
        found.append({"link_lengths": described, **counted})
        if not options.json:
            stops = ", ".join(f"{number} {what}" for what, number in sorted(counted.items()))
            print(f"{'with' if described else 'without'} link lengths, stops: {stops}", flush=True)
    if options.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
