"""SIGKILL at random moments of an experiment on a pty, with the fake servos in another process.

    python benchmarks/safety/kills.py [--kills N] [--json]

The servos are read over the same terminal 105 ms after each kill: each Bus Watchdog must have tripped and each Goal
Current must be 0. The 5 ms allow for this computer's scheduling; an earlier read would restart the watchdog.

Each kill uses a new arm that hangs at rest, because after a kill in motion, friction may hold an arm so far from its
rest pose that the next experiment refuses to start. A kill does not count if the experiment had already ended by itself
(because a busy computer missed its deadlines) or if the servos answered later than 120 ms after the kill. Such a kill
is repeated; the campaign fails if there are too many of them. The fake arm gets real-time priority if permitted: real
servos do not wait for this computer's other programs.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.machine import machine
from tests.support.stops.kills import ANSWERED_BEFORE_S, kill_campaign


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        done = kill_campaign(options.kills, Path(folder))
    counted = [kill for kill in done if kill.counts()]
    measured = {
        "kills": len(counted),
        "not_stopped": sum(not kill.safe for kill in done),
        "torque_on": sum(all(kill.torque) for kill in counted),
        "answered_after_ms": round(1e3 * max(kill.answered_after for kill in counted), 1),
        "ended_by_itself": sum(bool(kill.ended) for kill in done),
        "answered_late": sum(kill.answered_after > ANSWERED_BEFORE_S for kill in done),
    }
    if options.json:
        print(json.dumps(measured))
        return
    print(machine())
    for name, value in measured.items():
        print(f"{name:16s} {value}")


if __name__ == "__main__":
    main()
