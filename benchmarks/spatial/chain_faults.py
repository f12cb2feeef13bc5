"""Random faults in runs of spatial arms with four and six joints: which stops lower the arm, and which may drop it.

    python benchmarks/spatial/chain_faults.py [--injections 100] [--first 0] [--only NAME] [--rate 400] [--show]

The faults are those of benchmarks/faults.py, injected while the complete command runs on the fake arms
`fake_open_manipulator_x` and `fake_viperx_300`, with paths of a few seconds. A spatial arm falls when torque is cut, so
the rule "current must end within 100 ms" applies only if the servos can no longer be commanded. Runs are judged from
the emulated servos' own record, which the program never sees:

can command     the faults are of kinds that leave commands and readings intact (`COMMANDABLE`), the record shows no
                servo that was silent, disobeyed or reported something false, and nothing held the arm by force
unsafe          at least one of these happened:
                - A motor carried a current that was not commanded for more than 100 ms, even while the arm was being
                  lowered. If a servo receives nothing, only its watchdog can stop it, so the limit is the watchdog's.
                - Current flowed for longer than this limit after a servo fell silent or the cable was unplugged. After
                  any other failure, servos may be driven for as long as lowering the arm takes.
                - While motors drove the arm, links touched that had not been as close in the undisturbed run. Contacts
                  in the rest pose do not count; a joint held by force is taken to be in its rest pose, since nothing
                  could have brought it there.
                - A joint overshot its limits by more than lowering the arm may cause.
                Nothing can end the current after a kill while another program feeds the watchdogs, so this time does
                not count (`judge.fed_by_another`).
lying           of the runs stopped while the arm could still be commanded, the number in which current was switched
                off only once the arm was in its rest pose
"""

import argparse
import json
import sys
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
from numpy.typing import NDArray

from benchmarks.fault_campaign import arms
from benchmarks.fault_campaign.arms import Setting
from benchmarks.fault_campaign.attack import Kind
from benchmarks.fault_campaign.campaign import DoesNotRun, Ready, play, prepare
from benchmarks.fault_campaign.draw import UNHEARD, Drawn, draw
from benchmarks.fault_campaign.judge import (
    BOUND_MS,
    TRIP_MS,
    Reason,
    Story,
    Told,
    judge_words,
    overruled_ms,
    reasons_of,
)
from hil.clearance.space import Space
from hil.config.schema import Config
from hil.estimator.arrays import Array
from hil.plan.way_home import WayHome

NAMES = ("fake_open_manipulator_x", "fake_viperx_300")
RATES = (200, 400)
PERIOD_S = 2.0
RAMP_S = 1.5
SWING = 0.4
SAME_M = 2e-3
"""Tolerated difference between two runs' least clearances [m]: at rest, an arm touches what it rests on."""

INJECTIONS = 100

CANNOT = (
    *("is not where the program was told", "is not as fast as told", "was not heard", "does not do as told"),
    "the cable was unplugged",
)
"""Reasons after which the arm cannot be commanded reliably."""

UNREACHED = ("was not heard", "the cable was unplugged")
"""Reasons after which a servo cannot be commanded at all."""

MOST_BEYOND_RAD = 0.2

_BY_FORCE = frozenset({Kind.PUSHED, Kind.GRIPPED, Kind.OBSTACLE, Kind.SNAG, Kind.LOAD_CHANGED})
_SIGNALS = frozenset({Kind.SIGINT, Kind.SIGTERM, Kind.SIGHUP})
COMMANDABLE = _BY_FORCE | {
    *(Kind.SIGINT, Kind.SIGTERM, Kind.SIGHUP, Kind.DISK_FULL, Kind.CLOCK_SET, Kind.CLOCK_WRAP),
    *(Kind.RAISED_LIMIT, Kind.WATCHDOG_OFF, Kind.WATCHDOG_LONG),
}
"""Kinds after which every servo still receives, obeys and reports true values."""

WEAKER = 0.3
"""Force that a motor can overcome in any pose on the path home, relative to the largest motor torque of the run."""

SETTLES_S = 1.0
"""Time that a stop may take beyond the predicted duration of lowering [s]."""

LIES_RAD = 0.1
LOOKED_AT_MS = 5


@dataclass(frozen=True)
class ChainOutcome:
    """The outcome of one injection.

    owed: why the run had to end; "" if there was no reason. can_command: whether the arm could still be commanded, as
    described at the top of this file. lies: whether the arm was in its rest pose when current ended. late_ms: how long
    current flowed after the failure. clearance: least distance while motors drove the arm [m], plus `SAME_M`; if links
    overlapped in the undisturbed run, that overlap is allowed and added. beyond: largest overshoot of a position limit
    while motors drove the arm [rad]. overruled_ms: longest time for which a motor carried a current that was not
    commanded; at most `cut_ms` is allowed.
    """

    setting: Setting
    drawn: Drawn
    owed: str
    late_ms: float
    bound_ms: float
    lower_ms: float
    cut_ms: float
    clearance: float
    beyond: float
    overruled_ms: float
    stopped: bool
    can_command: bool
    lies: bool
    named: bool
    misleading: bool
    unreadable: bool
    not_restored: tuple[str, ...]
    text: str

    @property
    def unsafe(self) -> bool:
        is_late = self.late_ms > (self.lower_ms if self.lies else self.bound_ms)
        return is_late or self.overruled_ms > self.cut_ms or self.clearance < 0.0 or self.beyond > MOST_BEYOND_RAD

    @property
    def dropped(self) -> bool:
        return self.stopped and self.can_command and not self.lies

    def __str__(self) -> str:
        flags = [word for word in ("unsafe", "dropped", "misleading", "unreadable") if getattr(self, word)]
        flags += [f"not restored {', '.join(self.not_restored)}"] * bool(self.not_restored)
        flags += ["unnamed"] * (self.stopped and not self.named)
        return (
            f"{self.setting.name} {self.setting.rate} Hz: {self.drawn}: {self.owed or 'nothing owed'}, current for "
            f"{self.late_ms:.0f} ms of {self.bound_ms:.0f}, overruled {self.overruled_ms:.0f} of {self.cut_ms:.0f}, "
            f"clearance {1e3 * self.clearance:.0f} mm, {', '.join(flags) or 'good'}\n    {self.text.strip()[-600:]}"
        )


def make_document(setting: Setting, period: float) -> dict[str, Any]:
    """The bundled configuration with a short path at this rate, connected through the campaign's port."""
    document: dict[str, Any] = tomllib.loads((arms.CONFIGS / f"{setting.name}.toml").read_text(encoding="utf-8"))
    urdf = str(arms.CONFIGS / document["arm"]["urdf"])
    document["arm"]["urdf"] = document["fake"]["chain"]["urdf"] = urdf
    document["experiment"] |= {
        "rate": float(setting.rate),
        "period": period,
        "ramp": RAMP_S,
        "periods": 1,
        "settle_within": 0.9,
        "held_out": False,
    }
    document["port"] |= {"url": f"{arms.SCHEME}arm"}
    # Few harmonics in a short period: the path has another shape than the bundled one, for which the swing was chosen.
    document["joint_path"]["swing"] = [SWING * each for each in document["joint_path"]["swing"]]
    return document


def inject(setting: Setting, seed: int) -> ChainOutcome:
    """Draw faults and inject them into one run. Every second seed draws only from `COMMANDABLE`. Raises DoesNotRun."""
    ready = prepare(setting, PERIOD_S, make_document)
    ids = [joint.id for joint in ready.config.joints]
    for attempt in count():
        drawn = draw(f"chain {setting.name} {setting.rate} {seed} {attempt}", ready.undisturbed.ended, ids)
        if seed % 2 or set(drawn.kinds) <= COMMANDABLE:
            break
    story, readable, changed = play(ready, drawn, seed)
    return _judged(ready, drawn, story, readable, changed)


def _judged(ready: Ready, drawn: Drawn, story: Story, readable: bool, changed: tuple[str, ...]) -> ChainOutcome:
    config, record = ready.config, story.record
    told = Told(config, story.traffic, drawn.start)
    reasons = reasons_of(config, drawn, story, ready.undisturbed, told)
    time, driven = record["time"][:, 0], np.asarray(record["driven"].any(axis=1))
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    position: Array = record["position"]
    moved = position[driven] if driven.any() else position[:1]
    unheard = bool(set(drawn.kinds) & UNHEARD)
    cut_ms = max(BOUND_MS, 1e3 * config.safety.watchdog + TRIP_MS) if unheard else BOUND_MS
    lower_ms = 1e3 * (longest_lowering(ready.path) + SETTLES_S)
    cannot = [reason for reason in reasons if any(word in reason[0] for word in CANNOT)]
    unreached = [reason for reason in cannot if any(word in reason[0] for word in UNREACHED)]
    (owed, since), bound = _owed(reasons, unreached, cut_ms, lower_ms)
    flowed = time[driven & (time >= since)]
    stopped = bool(story.code)
    named, misleading = judge_words(drawn, story.text) if stopped else (True, False)
    last = np.flatnonzero(driven)
    return ChainOutcome(
        ready.setting,
        drawn,
        owed,
        1e3 * float(flowed[-1] - since) if flowed.size else 0.0,
        bound,
        lower_ms,
        cut_ms,
        _clearance(config, record, drawn) - min(0.0, _undisturbed_clearance(ready.setting)) + SAME_M,
        float(np.maximum(low - moved.min(axis=0), moved.max(axis=0) - high).max()),
        overruled_ms(config, story, told),
        stopped,
        not cannot and _leaves_command(drawn, story.ended),
        _lies(config, record["position"][last[-1] if last.size else -1]),
        bool(named),
        misleading,
        not readable or (stopped and story.code != -9 and not story.text.strip()),
        changed,
        story.text,
    )


def _owed(reasons: list[Reason], unreached: list[Reason], cut_ms: float, lower_ms: float) -> tuple[Reason, float]:
    """The reason for ending the current whose time limit expires first, and this time limit [ms]."""
    ends = [(each, cut_ms if each in unreached else lower_ms) for each in reasons]
    return min(ends, key=lambda pair: pair[0][1] + 1e-3 * pair[1], default=(("", np.inf), cut_ms))


@cache
def longest_lowering(path: Path) -> float:
    """Duration of the longest path home from any point of the planned path [s]."""
    from hil.config.schema import parse_config
    from hil.plan.chain_plan import make_chain_plan

    config = parse_config(path.read_text(encoding="utf-8"), path)
    plan = make_chain_plan(config)
    way = WayHome(config, plan)
    segment: Any = plan.segments[0]
    played = segment.paths[1]
    every = range(0, played.position.shape[1], max(1, played.position.shape[1] // 20))
    ways = [way.path(played.position[:, k], played.velocity[:, k]).position.shape[1] for k in every]
    return float(max(ways)) / plan.rate


def _leaves_command(drawn: Drawn, ended: float) -> bool:
    """Whether the arm could still be commanded: all faults are of kinds that permit this, and no force held it.

    Only a force that still acts at the end of the run counts. The result is False after a second request to stop, since
    that asks for torque to be cut at once.
    """
    forced = any(
        each.kind in _BY_FORCE and each.start < ended < each.end and abs(each.amount) > WEAKER for each in drawn.attacks
    )
    asked = sum(each.kind in _SIGNALS and each.start < ended for each in drawn.attacks)
    return set(drawn.kinds) <= COMMANDABLE and not forced and asked <= 1


def _clearance(config: Config, record: NDArray[Any], drawn: Drawn | None = None) -> float:
    """Least distance [m] while motors drove the arm and it was away from its rest pose."""
    driven = np.asarray(record["driven"].any(axis=1))
    position = record["position"][driven][::LOOKED_AT_MS].T
    time = record["time"][driven, 0][::LOOKED_AT_MS]
    space = Space.of(config)
    position = position[:, ~space.lies(_without_held(config, position, time, drawn))]
    if not position.shape[1]:
        return 1.0
    return float(min(space.nearest(position, on_the_way=True).distance, 1.0))


@cache
def _undisturbed_clearance(setting: Setting) -> float:
    ready = prepare(setting, PERIOD_S, make_document)
    return _clearance(ready.config, ready.undisturbed.record)


def _without_held(config: Config, position: Array, time: Array, drawn: Drawn | None) -> Array:
    """The poses (joints, times) [rad], with joints set to their rest angles while something holds them by force."""
    free = position.copy()
    for attack in drawn.attacks if drawn else ():
        if attack.kind in _BY_FORCE and abs(attack.amount) > WEAKER:
            held = (time >= attack.start) & (time <= attack.end)
            for index, joint in enumerate(config.joints):
                if attack.concerns(joint.id):
                    free[index, held] = config.arm.rest_pose[index]
    return free


def _lies(config: Config, position: Array) -> bool:
    return bool(np.abs(position - np.array(config.arm.rest_pose)).max() < LIES_RAD)


def figures(outcomes: Iterable[ChainOutcome]) -> dict[str, Any]:
    """Summary figures."""
    every = list(outcomes)
    stopped = [each for each in every if each.stopped]
    commanding = [each for each in stopped if each.can_command]
    return {
        "injections": len(every),
        "unsafe": sum(each.unsafe for each in every),
        "stopped": len(stopped),
        "could_command": len(commanding),
        "lying": sum(each.lies for each in commanding),
        "unnamed": sum(not each.named for each in stopped),
        "misleading": sum(each.misleading for each in stopped),
        "unreadable": sum(each.unreadable for each in every),
        "not_restored": sum(bool(each.not_restored) for each in every),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--injections", type=int, default=INJECTIONS, help="total number over all settings")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--only", choices=NAMES)
    parser.add_argument("--rate", type=int, choices=RATES)
    parser.add_argument("--show", action="store_true", help="print every outcome with a problem")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    settings = [
        Setting(name, rate)
        for name in NAMES
        for rate in RATES
        if options.only in (None, name) and options.rate in (None, rate)
    ]
    outcomes, left_out = [], set()
    for number in range(options.injections):
        try:
            outcomes.append(inject(settings[number // 2 % len(settings)], options.first + number))
        except DoesNotRun as error:
            left_out.add(str(error))
            continue
        bad = outcomes[-1]
        if options.show and (bad.unsafe or bad.dropped or bad.misleading or bad.unreadable or bad.not_restored):
            print(bad, flush=True)
    told = {**figures(outcomes), "left_out": sorted(left_out)}
    print(json.dumps(told) if options.json else "\n".join(f"{name}: {value}" for name, value in told.items()))


if __name__ == "__main__":
    main()
