"""The fault campaign: random faults in every bundled configuration and a mixed arm at 20, 100, 400 and 1,000 Hz.

    python benchmarks/faults.py [--json] [--injections N] [--jobs N] [--show] [--only NAME] [--rate HZ]

Each injection is one `hil record` in virtual time with one or two faults: of the fake bus, of the computer, by other
programs on the bus, or by a man in the middle who changes, delays, repeats, forges and drops bytes between program and
servos. It is judged from the emulated servos' own record of every millisecond (fault_campaign/judge.py):

unsafe          current flowed for more than 100 ms after the first permanent failure (for more than the watchdog's
                timeout if the program cannot reach the servo), or still flowed after the end of the program
alike           current flowed for too long, but a healthy arm would have sent the same replies until shortly before
                the current ended. The fault could therefore not be detected earlier, and the run does not count as
                unsafe (fault_campaign/twin.py)
beyond_limit    a joint overshot its limit by more than `hil dry-run` predicts
unreadable      an unexpected exception, no message, or a recording that cannot be read
unnamed         the message does not name the cause, as judged by lists of words for each cause
misleading      the message names only other causes
not_restored    a register differs from its value before the run, even after the next start
worst_ms_with_current   longest time for which current flowed after the first permanent failure [ms]
"""

import argparse
import json
import os
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.fault_campaign.arms import PERIOD_S, Setting, settings
from benchmarks.fault_campaign.campaign import Outcome
from benchmarks.fault_campaign.shares import in_own_process, in_this_process
from hil.study import jobs as study_jobs

INJECTIONS = 5000

_CHEAPNESS = {20: 9, 100: 6, 400: 3, 1000: 1}
"""Relative number of runs per unit of processor time, by rate [Hz]: a run takes 0.25 s, 0.4 s, 0.7 s and 2.5 s."""


def campaign(
    chosen: Sequence[Setting],
    injections: int,
    jobs: int,
    first: int = 0,
    period: float = PERIOD_S,
    *,
    even: bool = True,
) -> tuple[list[Outcome], list[str]]:
    """Distribute the injections among the settings; return the outcomes, and the reasons why settings could not be run.

    even: give every setting the same number; otherwise, give fewer to high rates, whose runs take longest.
    """
    shares = _shares([1 if even else _CHEAPNESS[each.rate] for each in chosen], injections)
    parts = [(setting, share, first, period) for setting, share in zip(chosen, shares, strict=True)]
    done = (
        study_jobs.each(in_this_process, parts, count=0)
        if jobs == 1
        else study_jobs.each(in_own_process, parts, count=jobs)
    )
    return [outcome for part, _ in done for outcome in part], [why for _, why in done if why]


def _shares(weights: Sequence[int], total: int) -> list[int]:
    """Divide `total` in proportion to the weights."""
    ends = [round(total * sum(weights[: number + 1]) / sum(weights)) for number in range(len(weights))]
    return [end - start for start, end in zip([0, *ends], ends, strict=False)]


def figures(outcomes: Iterable[Outcome]) -> dict[str, Any]:
    """Summary figures of these outcomes."""
    every = list(outcomes)
    stopped = [each for each in every if each.verdict.named is not None]
    late = [each.verdict.late_ms for each in every if each.verdict.owed]
    return {
        "injections": len(every),
        "unsafe": sum(each.verdict.unsafe for each in every),
        "beyond_limit": sum(each.beyond_limit for each in every),
        "unreadable": sum(each.unreadable for each in every),
        "alike": sum(each.verdict.unseen for each in every),
        "stopped": len(stopped),
        "unnamed": sum(not each.verdict.named for each in stopped),
        "misleading": sum(each.verdict.misleading for each in stopped),
        "not_restored": sum(bool(each.not_restored) for each in every),
        "worst_ms_with_current": round(max(late, default=0.0), 1),
    }


def by_setting(outcomes: Iterable[Outcome]) -> dict[str, dict[str, Any]]:
    """Summary figures per configuration and rate."""
    groups: dict[str, list[Outcome]] = defaultdict(list)
    for each in outcomes:
        groups[f"{each.setting.name} {each.setting.rate} Hz"].append(each)
    return {name: figures(group) for name, group in groups.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--injections", type=int, default=INJECTIONS)
    parser.add_argument("--first", type=int, default=0, help="seed of the first injection of each setting")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--only", help="only this bundled configuration")
    parser.add_argument("--rate", type=int, help="only this rate [Hz]")
    parser.add_argument("--show", action="store_true", help="print every outcome with a problem")
    options = parser.parse_args()
    chosen = [each for each in settings() if options.only in (None, each.name) and options.rate in (None, each.rate)]
    outcomes, left_out = campaign(chosen, options.injections, options.jobs, options.first)
    if options.show:
        for each in outcomes:
            if not each.is_good:
                print(each)
    told = {**figures(outcomes), "left_out": left_out, "by_setting": by_setting(outcomes)}
    if options.json:
        print(json.dumps(told))
        return
    print_table(told)


def print_table(told: dict[str, Any]) -> None:
    """Print one line per configuration and rate, then the totals."""
    names = [name for name, value in told.items() if not isinstance(value, list | dict)]
    print(f"{'':28s}" + "".join(f"{name.split('_ms')[0]:>14s}" for name in names))
    for setting, row in [*told["by_setting"].items(), ("all", told)]:
        print(f"{setting:28s}" + "".join(f"{row[name]:14}" for name in names))
    for why in told["left_out"]:
        print(f"left out: {' '.join(why.split())[:200]}")


if __name__ == "__main__":
    main()
