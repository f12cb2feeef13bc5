"""Judges a run from the emulated servos' own record, independently of the program's view.

The judgement is independent of the kind of fault. For every millisecond it determines from the record whether the
program received correct data, received anything, was obeyed, and kept the arm within its limits and near its
undisturbed motion. From the first moment at which one of these conditions fails permanently, the current must end
within `BOUND_MS`.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.fault_campaign.attack import (
    Kind,
    Request,
    blocks_in,
    field_of,
    goals_in,
    request_among,
    request_in,
)
from benchmarks.fault_campaign.draw import HARMLESS, SHIFTED, UNHEARD, WORDS, Drawn, causes_of, true_beside
from benchmarks.fault_campaign.middle import Traffic
from benchmarks.fault_campaign.twin import Heard, has_healthy_twin, may_be_wired_otherwise
from benchmarks.fault_campaign.witness import STEP_S
from hil.config.schema import Config
from hil.drivers.packet import Framer, Instruction, Packet
from hil.fakes.bus.faults import FaultKind

BOUND_MS = 100.0
TRIP_MS = 40.0
"""Allowance beyond the watchdog's timeout [ms]: its step of 20 ms, and the last packet that restarted it."""

LASTING_MS = 100
"""A failure that lasts less than this may be tolerated [ms]."""

GAP_MS = 50
"""Failures separated by less than this count as one [ms], except for missing replies, which any reply ends."""

LIE_RAD, LIE_RAD_S, LIE_SHARE = 0.1, 0.5, 0.1
"""Tolerances for the position and velocity reported to the program; the velocity also has a relative tolerance."""

UNSURE_MS = 20
"""How much earlier than the attack its effect may appear in the record [ms], because the record is only written when
the bus is used.
"""

SHORTEST_WATCHDOG_S = 0.04
"""Shortest practicable timeout of the Bus Watchdog [s], which counts in steps of 20 ms. With a timeout of one step, it
would trip even during short stalls of a busy computer, after which the arm can still be lowered.
"""

OBEYED = 0.1
"""Tolerance for a servo's goal, relative to the largest goal of the run."""

ASTRAY_RAD, ASTRAY_SHARE = 0.1, 0.35
"""Tolerance for the deviation from the undisturbed motion, absolute and relative to the range of that motion."""

DRIVES_MS = 15
"""Longest time for which a goal in the direction of visible motion may exceed all goals of the undisturbed run [ms]."""

DRIVES_SHARE, DRIVES_TICKS, DRIVES_S = 1.2, 5, 0.01
"""Largest permitted ratio of a goal to the largest goal of the undisturbed run; largest change of position that does
not yet count as visible motion [ticks]; time within which visible motion must occur [s].
"""

STIRS_RAD = 0.05
"""Largest change between two readings before torque is on that a program may take for motion of a healthy arm [rad]."""

TO_BE_SEEN = (
    "is not where the program was told",
    "is not as fast as told",
    "is not where it would be",
)
"""Deviations that a program can only detect once the replies that it receives differ from all those that a healthy arm
might have sent (`fault_campaign.twin`).
"""

_TICKS_PER_RAD = 4096 / (2 * np.pi)
_TICKS_PER_RAD_S = 60 / (2 * np.pi) / 0.229

Numbers = NDArray[np.float64]
"""A column of a record. Stating its type makes type checking of arithmetic on it ten times as fast."""


@dataclass(frozen=True)
class Story:
    """Everything about one run: the servos' record, the bytes transferred, when the program ended, its exit code and
    its output."""

    record: NDArray[Any]
    traffic: Traffic
    ended: float
    code: int | None
    text: str


@dataclass(frozen=True)
class Verdict:
    """The judgement of one run.

    owed: why the current had to end; "" if there was no reason. late_ms: how long current flowed after it had to end.
    beyond: overshoot of each joint beyond its limit (joints,) [rad]. named: whether the output names the cause; None if
    nothing stopped the run. misleading: whether the output names only wrong causes. unseen: whether the current ended
    late, but a healthy arm might have sent the same replies (`fault_campaign.twin`) until shortly before, in which case
    the run is not unsafe. drives_ms: how long the program drove a joint harder than planned in the direction in which
    the received positions were moving; a program that brakes must not do this.
    """

    owed: str
    late_ms: float
    unsafe: bool
    beyond: NDArray[np.float64]
    named: bool | None
    misleading: bool
    unseen: bool = False
    drives_ms: float = 0.0


def judge(config: Config, drawn: Drawn, story: Story, undisturbed: Story) -> Verdict:
    """Judge the run that `story` describes, into which the faults `drawn` were injected."""
    told = Told(config, story.traffic, drawn.start)
    reasons = reasons_of(config, drawn, story, undisturbed, told)
    owed, since = min(reasons, key=lambda reason: reason[1], default=("", np.inf))
    driven = np.asarray(story.record["driven"].any(axis=1))
    time = story.record["time"][:, 0]
    bound = BOUND_MS
    if set(drawn.kinds) & UNHEARD:
        bound = max(bound, 1e3 * config.safety.watchdog + TRIP_MS)
    again = [attack.start for attack in drawn.attacks if attack.kind == Kind.MODE_TAKEN]
    since = since_again(time[driven], since, again)
    late_ms, unseen = _flowed_ms(time[driven], since), False
    plain = min([when for what, when in reasons if not what.endswith(TO_BE_SEEN)], default=np.inf)
    if late_ms > bound and _flowed_ms(time[driven], plain) <= bound:
        unseen = was_built_so(config, drawn, story) or has_healthy_twin(
            config, received(config, story), time[driven][-1] - 1e-3 * bound
        )
    left_on = bool(driven[time > story.ended + config.safety.watchdog + 1e-3 * TRIP_MS].any())
    was_killed = any(each.kind == Kind.KILLED and each.start <= story.ended for each in drawn.attacks)
    # A killed program prints nothing; here, it continues to run, cut off from the bus.
    named, misleading = judge_words(drawn, story.text) if story.code and not was_killed else (None, False)
    limits = np.array([joint.position_limit for joint in config.joints])
    position = story.record["position"]
    beyond = np.maximum(limits[:, 0] - position.min(axis=0), position.max(axis=0) - limits[:, 1])
    drives_ms = driving_ms(config, told, story, undisturbed)
    unsafe = (late_ms > bound and not unseen) or left_on or drives_ms > DRIVES_MS
    return Verdict(owed, late_ms, unsafe, beyond, named, misleading, unseen, drives_ms)


def driving_ms(config: Config, told: "Told", story: Story, undisturbed: Story) -> float:
    """Longest time for which a joint's goal exceeded all goals of the undisturbed run and drove the joint in the
    direction in which the received positions were moving [ms]; 0 for arms with a stabiliser, which may use any torque.

    Goals of a servo with torque off, e.g. while settings are restored, do not count.
    """
    if config.stabiliser is not None:
        return 0.0
    longest = 0.0
    for joint, (sent, heard) in enumerate(zip(told.sent, told.heard, strict=True)):
        record = undisturbed.record[:, joint]
        goal: Numbers = record["goal"]
        driven: NDArray[np.bool_] = record["driven"]
        most = DRIVES_SHARE * float(np.abs(goal[driven]).max(initial=1))
        sent_at = np.array([each[0] for each in sent])
        moved = _visible_motion(sent_at, np.array(heard).reshape(-1, 4))
        along = config.joints[joint].direction * np.array([each[1] for each in sent]) * np.sign(moved)
        own = addressed(config, story.record, joint)
        time: Numbers = own["time"]
        has_torque: Numbers = own["torque"].astype(np.float64)
        along *= has_torque[np.clip(np.searchsorted(time, sent_at) - 1, 0, own.size - 1)]
        begun = None
        for (when, _), drives in zip(sent, along > most, strict=True):
            if begun is not None:
                longest = max(longest, 1e3 * (when - begun))
            begun = (when if begun is None else begun) if drives else None
    return longest


def _visible_motion(when: NDArray[np.float64], heard: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of the received positions in the time `DRIVES_S` before each moment [rad]; 0 if it is too small to see."""
    moved = np.zeros(when.size)
    latest = np.searchsorted(heard[:, 0], when, "right") - 1
    for index, last in enumerate(latest):
        first = int(np.searchsorted(heard[:, 0], heard[last, 0] - DRIVES_S, "right")) - 1 if last > 0 else -1
        if first >= 0 and when[index] - heard[first, 0] < 5 * DRIVES_S:
            moved[index] = heard[last, 1] - heard[first, 1]
    return np.where(np.abs(moved) * _TICKS_PER_RAD > DRIVES_TICKS, moved, 0.0)


def received(config: Config, story: Story) -> Heard:
    """What the program received in a run, and what it commanded."""
    told = Told(config, story.traffic, 0.0)
    return Heard.of(config, told.heard, told.sent)


def was_built_so(config: Config, drawn: Drawn, story: Story) -> bool:
    """Whether the only fault is that two interchangeable servos swapped their IDs before the program had written to
    them, while their encoders showed the same angle.

    Until the swap, both servos gave the same readings. Afterwards, the arm is a healthy arm whose servos are wired the
    other way round, so its replies cannot reveal the fault. No simulation is needed to conclude this. For an upright
    arm, a simulation would not even help, because in open loop the smallest difference makes such an arm fall.
    """
    if drawn.kinds != (Kind.IDS_SWAPPED,) or not may_be_wired_otherwise(config):
        return False
    assert config.fake is not None
    writes = (Instruction.WRITE, Instruction.SYNC_WRITE)
    sent = [(time, data) for time, is_read, data in story.traffic.passed if not is_read]
    written = min((time for time, data in sent if data[7:8] and data[7] in writes), default=np.inf)
    stood = [
        servo.zero_ticks / _TICKS_PER_RAD + servo.direction * angle
        for servo, angle in zip(config.fake.servos, story.record["position"][0], strict=True)
    ]
    return bool(drawn.start < written and abs(stood[0] - stood[1]) <= STIRS_RAD)


def addressed(config: Config, record: NDArray[Any], joint: int) -> NDArray[Any]:
    """For each millisecond, the record of the servo that had the joint's ID, or of the joint's own servo if none did.

    A program addresses servos by ID. If two servos swap their IDs, each still obeys the commands to its ID; whether
    their replies reveal the swap is judged elsewhere.
    """
    has_id = record["id"] == config.joints[joint].id
    servo = np.where(has_id.any(axis=1), has_id.argmax(axis=1), joint)
    return np.asarray(record[np.arange(len(record)), servo])


def since_again(driven: NDArray[np.float64], since: float, again: list[float]) -> float:
    """Time from which the time limit for ending the current counts [s]: `since`, or a later time at which another
    program switched torque on again.

    driven: times at which current flowed [s]. again: times at which another program switched torque on. The time limit
    restarts at such a time if the current had ended in time after `since`, had been off for `LASTING_MS` (longer than
    goals take to pass through zero), and then flowed again.
    """
    for when in sorted(again):
        begins = when - 1e-3 * UNSURE_MS
        before, after = driven[driven < begins], driven[driven >= begins]
        was_off = not before.size or when - before[-1] >= 1e-3 * LASTING_MS
        is_on = after.size > 0 and after[0] <= when + 1e-3 * GAP_MS
        if since < when and was_off and is_on and _flowed_ms(before, since) <= BOUND_MS:
            since = begins
    return since


def _flowed_ms(driven: NDArray[np.float64], since: float) -> float:
    """How long current flowed after the time `since` [ms]. driven: times at which it flowed [s]."""
    flowed = driven[driven >= since]
    return 1e3 * float(flowed[-1] - since) if flowed.size else 0.0


def judge_words(drawn: Drawn, text: str) -> tuple[bool, bool]:
    """Whether at least a third of the causes that the message names are true, and whether it names only wrong ones."""
    offered = causes_in(text)
    if set(drawn.kinds) <= HARMLESS:
        return False, True  # whatever the message says, the run should not have been stopped
    right = causes_of(drawn)
    if not right:
        return True, False  # none of the faults had to stop the run, so the message is not judged
    told = offered & right
    return bool(told) and len(told) * 3 >= len(offered - true_beside(drawn)), bool(offered) and not told


def causes_in(text: str) -> set[str]:
    """The causes that a message names, ignoring lines about the torque state."""
    said = [line for line in text.splitlines() if not re.match(r"(hil: )?(Torque is off|TORQUE OFF)", line.strip())]
    return {cause for cause, words in WORDS.items() if any(re.search(words, line, re.IGNORECASE) for line in said)}


Reason = tuple[str, float]


def reasons_of(config: Config, drawn: Drawn, story: Story, undisturbed: Story, told: "Told") -> list[Reason]:
    """Reasons why the current had to end, each with the time from which it applied [s]."""
    record = story.record
    time = record["time"][:, 0]
    interval = 1.0 / config.experiment.rate
    joints = range(len(config.joints))
    # During set-up, before the first goals are sent with torque on, no servo needs to be heard regularly.
    holds = np.asarray(record["torque"].any(axis=1))
    holds &= time > told.first_goal(float(time[np.argmax(holds)]))
    # A fault that makes the set-up longer delays the motion, and changes nothing else in it.
    later = max(0, _begins(record) - _begins(undisturbed.record))
    found: list[Reason | None] = []
    for joint in joints:
        own = record[:, joint]
        found += [
            _since(f"joint {joint + 1} {what}", time, wrong, hold, gap)
            for what, wrong, hold, gap in (
                (
                    "is not where the program was told",
                    told.lies(joint, time, own, "position", interval),
                    LASTING_MS,
                    GAP_MS,
                ),
                ("is not as fast as told", told.lies(joint, time, own, "velocity", interval), LASTING_MS, GAP_MS),
                ("was not heard", told.silent(joint, time, interval, story.ended) & holds, LASTING_MS, 1),
                (
                    "does not do as told",
                    told.disobeys(joint, time, addressed(config, record, joint), interval),
                    LASTING_MS,
                    GAP_MS,
                ),
                ("is beyond a limit", _beyond(config, joint, own), 1, GAP_MS),
                (
                    "is not where it would be",
                    _astray(config, drawn, own[later:], undisturbed.record[:, joint], later),
                    LASTING_MS,
                    GAP_MS,
                ),
            )
        ]
    for attack in drawn.attacks:
        if attack.kind in (Kind.SIGINT, Kind.SIGTERM, Kind.SIGHUP) and attack.start < story.ended:
            found.append(("a stop was requested", attack.start))
    for fault in drawn.faults:
        if fault.kind == FaultKind.CABLE_PULLED and fault.at < story.ended:
            found.append(("the cable was unplugged", fault.at))
    helpless = [fed_by_another(drawn, story.ended), *stopped_unwatched(drawn)]
    return [(what, _not_before(what, when, helpless)) for what, when in (each for each in found if each is not None)]


def _not_before(what: str, when: float, helpless: Sequence[tuple[float, float]]) -> float:
    """Time from which a failure at `when` obliged the program to end the current [s].

    If the failure is a silent servo, this is not before the end of the times in which nothing could end the current
    (`helpless`).
    """
    until = [end for since, end in helpless if since <= when < end]
    return max([when, *until]) if what.endswith("was not heard") else when


def stopped_unwatched(drawn: Drawn) -> list[tuple[float, float]]:
    """Return when the program was suspended just before or after another program disarmed the watchdogs: (start, end)
    [s].

    Neither a suspended program nor a disarmed watchdog can end the current. If the program is suspended before it can
    be expected to have noticed the disarmed watchdogs, or if they are disarmed while it is suspended, nothing can end
    the current until the program runs again.
    """
    disarmed = [each.start for each in drawn.attacks if each.kind in (Kind.WATCHDOG_OFF, Kind.WATCHDOG_LONG)]
    return [
        (each.start - 1e-3 * UNSURE_MS, each.start + each.amount)
        for each in drawn.attacks
        if each.kind in (Kind.STALL, Kind.SUSPENDED, Kind.HICCUPS)
        and any(each.start - 1e-3 * BOUND_MS < when < each.start + each.amount for when in disarmed)
    ]


def fed_by_another(drawn: Drawn, ended: float) -> tuple[float, float]:
    """Return when nothing could stop the servos: (start, end) [s]; the end precedes the start if this never happened.

    A killed program does nothing more, and any packet on the bus feeds the watchdogs. While another program sends
    packets at shorter intervals than the shortest possible watchdog timeout, nothing can end the current, which must
    then end in time after the last of these packets. Longer intervals are no excuse, since a shorter watchdog timeout
    would have helped.
    """
    since = min((each.start for each in drawn.attacks if each.kind == Kind.KILLED), default=np.inf)
    fed = [
        min(each.end, ended)
        for each in drawn.faults
        if each.kind == FaultKind.OTHER_MASTER
        and each.probability == 1.0
        and each.size < SHORTEST_WATCHDOG_S
        and each.at <= since < each.end
    ]
    # The last reply before the kill may be up to one cycle older than the kill.
    return since - 1e-3 * UNSURE_MS, max(fed, default=-np.inf)


def overruled_ms(config: Config, story: Story, told: "Told") -> float:
    """Longest time for which a motor carried a current that the program had not commanded [ms]."""
    time = story.record["time"][:, 0]
    longest = 0
    for joint in range(len(config.joints)):
        own = addressed(config, story.record, joint)
        driven: NDArray[np.bool_] = own["driven"]
        at = np.flatnonzero(told.disobeys(joint, time, own, 1.0 / config.experiment.rate) & driven)
        breaks = np.flatnonzero(np.diff(at) > GAP_MS)
        for start, end in zip(at[np.r_[0, breaks + 1]], at[np.r_[breaks, at.size - 1]], strict=True) if at.size else ():
            longest = max(longest, int(end - start) + 1)
    return float(longest)


def _since(what: str, time: NDArray[Any], wrong: NDArray[np.bool_], hold_ms: int, gap_ms: int) -> Reason | None:
    """First failure that lasted at least `hold_ms`, with the time at which it began [s]; None if there is none.

    Interruptions of up to `gap_ms` do not end a failure.
    """
    at = np.flatnonzero(wrong)
    if not at.size:
        return None
    breaks = np.flatnonzero(np.diff(at) > gap_ms)
    starts, ends = at[np.r_[0, breaks + 1]], at[np.r_[breaks, at.size - 1]]
    lasting = np.flatnonzero(ends - starts + 1 >= hold_ms)
    return (what, float(time[starts[lasting[0]]])) if lasting.size else None


class Told:
    """The goals that the program sent, and the replies that it received from shortly before the first fault onwards."""

    def __init__(self, config: Config, traffic: Traffic, start: float) -> None:
        self._joints = config.joints
        self.sent: list[list[tuple[float, int]]] = [[] for _ in config.joints]
        self.heard: list[list[tuple[float, ...]]] = [[] for _ in config.joints]
        self._begun = np.inf
        self._largest = [1] * len(config.joints)
        index = {joint.id: number for number, joint in enumerate(config.joints)}
        request: Request | None = None
        pending = b""
        for time, is_read, data in traffic.passed:
            if not is_read:
                if b"\x83" in data[:16]:
                    packets = list(Framer().feed(data))
                    request = request_among(packets) or request
                    self._keep_goals(time, packets, index)
                elif b"\x82" in data[:9] or b"\x8a" in data[:9]:
                    request = request_in(data)
                else:
                    request = None
                pending = b""
            elif request is not None and data and time >= start - 0.2:
                pending += data
                self._keep_answers(time, pending, request, index)

    def first_goal(self, since: float) -> float:
        """Time of the first goal sent after `since` [s]; infinite if there is none."""
        return min((time for sent in self.sent for time, _ in sent if time > since), default=np.inf)

    def _keep_goals(self, time: float, packets: Sequence[Packet], index: dict[int, int]) -> None:
        for packet in packets:
            for servo_id, (_, goal) in goals_in(packet).items():
                if servo_id in index:
                    self._begun = min(self._begun, time)
                    self.sent[index[servo_id]].append((time, goal))
                    self._largest[index[servo_id]] = max(self._largest[index[servo_id]], abs(goal))

    def _keep_answers(self, time: float, data: bytes, request: Request, index: dict[int, int]) -> None:
        for servo_id, (error, block) in blocks_in(data, request).items():
            velocity = field_of(block, request, "velocity")
            position = field_of(block, request, "position")
            if servo_id not in index or velocity is None or position is None or error & 0x7F:
                continue
            joint = self._joints[index[servo_id]]
            heard = self.heard[index[servo_id]]
            told = (
                time,
                joint.direction * (position - joint.zero_ticks) / _TICKS_PER_RAD,
                joint.direction * velocity / _TICKS_PER_RAD_S,
                (field_of(block, request, "current") or 0) * joint.joint.drive_unit(12.0),
            )
            if not heard or heard[-1][1:] != told[1:] or time - heard[-1][0] > 5e-4:
                heard.append(told)

    def lies(self, joint: int, time: NDArray[Any], own: NDArray[Any], what: str, interval: float) -> NDArray[np.bool_]:
        wrong = np.zeros(time.size, bool)
        heard = np.array(self.heard[joint]).reshape(-1, 4)
        if not heard.size:
            return wrong
        at = np.clip(np.searchsorted(time, heard[:, 0]), 0, time.size - 1)
        true: Numbers = own[what][at]
        if what == "position":
            false = np.abs(heard[:, 1] - true) > LIE_RAD
        else:
            false = np.abs(heard[:, 2] - true) > LIE_RAD_S + LIE_SHARE * np.abs(true)
        # A false reading counts until the next one arrives; between two samples, the program reads again.
        steps = round(1.2 * interval / STEP_S) + 1
        until = np.minimum(at + steps, np.append(at[1:], time.size))
        for begin, end in zip(at[false], until[false], strict=True):
            wrong[begin : end + 1] = True
        return wrong

    def silent(self, joint: int, time: NDArray[Any], interval: float, ended: float) -> NDArray[np.bool_]:
        heard = np.array([each[0] for each in self.heard[joint]])
        if not heard.size or not np.isfinite(self._begun):
            return np.zeros(time.size, bool)
        latest = heard[np.clip(np.searchsorted(heard, time, "right") - 1, 0, None)]
        running = (time > max(self._begun, heard[0])) & (time < ended)
        return np.asarray(running & (time - latest > interval + 2e-3))

    def disobeys(self, joint: int, time: NDArray[Any], own: NDArray[Any], interval: float) -> NDArray[np.bool_]:
        if not self.sent[joint]:
            return np.zeros(time.size, bool)
        when = np.array([each[0] for each in self.sent[joint]])
        goals = np.array([each[1] for each in self.sent[joint]])
        goal: Numbers = own["goal"]
        done = np.where(own["torque"].astype(bool), goal, 0)
        tolerance = OBEYED * self._largest[joint] + 1
        # While a goal is in transit, the servo may still hold the previous one.
        latest = np.searchsorted(when, time, "right") - 1
        off = np.full(time.size, np.inf)
        for back in (0, 1):
            index = np.clip(latest - back, 0, None)
            off = np.minimum(off, np.abs(done - goals[index]))
        current = (latest >= 0) & (time - when[np.clip(latest, 0, None)] < 2 * interval + 2e-3)
        return np.asarray(current & (off > tolerance))


def _beyond(config: Config, joint: int, own: NDArray[Any]) -> NDArray[np.bool_]:
    low, high = config.joints[joint].position_limit
    fastest = config.joints[joint].velocity_limit
    position: Numbers = own["position"]
    velocity: Numbers = own["velocity"]
    return (position < low - 1e-3) | (position > high + 1e-3) | (np.abs(velocity) > 1.02 * fastest)


def _begins(record: NDArray[Any]) -> int:
    """The millisecond in which motors first drive the arm."""
    return int(np.argmax(record["driven"].any(axis=1)))


def _astray(
    config: Config, drawn: Drawn, own: NDArray[Any], undisturbed: NDArray[Any], later: int
) -> NDArray[np.bool_]:
    """For each millisecond, whether a joint is far from its undisturbed motion.

    later: delay of the motion, due to a longer set-up [ms]; `own` is the joint's record without its first `later` ms.
    """
    count = min(own.size, undisturbed.size)
    wrong = np.zeros(later + own.size, bool)
    if set(drawn.kinds) & SHIFTED:
        return wrong
    if config.stabiliser is None:
        count = _same_plan(own[:count], undisturbed[:count])
    position: Numbers = own["position"]
    expected: Numbers = undisturbed["position"]
    most = ASTRAY_RAD + ASTRAY_SHARE * float(np.ptp(expected))
    wrong[later : later + count] = np.abs(position[:count] - expected[:count]) > most
    return wrong


def _same_plan(own: NDArray[Any], undisturbed: NDArray[Any]) -> int:
    """Number of milliseconds for which a servo was given the goals of the undisturbed run.

    After that, the plan may differ: if a period does not repeat the previous one because it was disturbed, the program
    adds another period.
    """
    goal: Numbers = undisturbed["goal"]
    mine: Numbers = own["goal"]
    driven: NDArray[np.bool_] = undisturbed["driven"]
    largest = float(np.abs(goal[driven]).max(initial=1))
    other = np.abs(mine - goal) > OBEYED * largest
    lasting = np.convolve(other, np.ones(LASTING_MS), "valid") > LASTING_MS - GAP_MS
    return int(np.argmax(lasting)) if lasting.any() else own.size


def describe(verdict: Verdict) -> str:
    """The verdict as one line of text."""
    said = [f"{verdict.owed or 'nothing owed'}, current for {verdict.late_ms:.0f} ms"]
    said += ["UNSAFE"] * verdict.unsafe + ["a healthy arm might have done the same"] * verdict.unseen
    said += [f"DRIVES a joint for {verdict.drives_ms:.0f} ms"] * (verdict.drives_ms > DRIVES_MS)
    said += ["MISLEADING"] * verdict.misleading + ["UNNAMED"] * (verdict.named is False)
    return ", ".join(said)
