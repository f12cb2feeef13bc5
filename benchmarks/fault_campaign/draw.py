"""Random faults of a run (kind, time, duration, strength, combination) and the words by which messages name causes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

from benchmarks.fault_campaign.attack import AT_ONCE, FORGED, ON_MOTORS, Attack, Kind
from hil.fakes.bus.faults import INSTRUCTION_FAULTS, REPLY_FAULTS, Fault, FaultKind

PAIRS = 0.35
"""Probability that an injection consists of two faults."""

TOGETHER_S = 0.3
"""In half of the pairs, the two faults are at most this far apart [s]."""

OFTEN = 0.25
"""Additional share of faults that are drawn within a short phase that needs many tests."""

SILENCE, GARBLED, LATE, CABLE, TORQUE, REBOOT = "silence", "garbled", "late", "cable", "torque", "reboot"
HEAT, OVERLOAD, VOLTAGE, STUCK, ENCODER = "heat", "overload", "voltage", "stuck", "encoder"
LIMIT, SIGN, PROGRAM, SIGNAL, MODEL, POSE = "limit", "sign", "program", "signal", "model", "pose"
REFUSED, STRANGER, DISK, MIXED = "refused", "stranger", "disk", "mixed"
HAND, REPEATED, SETTING = "hand", "repeated", "setting"

WORDS = {
    SILENCE: r"heard nothing|received nothing|no (reply|answer)|not (yet )?answer|silent|miss(ed|ing|es) (\d+ )?repl"
    r"|no response|repl(y|ies).{0,30}(missing|lost)",
    GARBLED: r"damaged|corrupt|\bCRC|not an answer|not one to the question|garbled|broken packet|incorrect|echo",
    LATE: r"\blate\b|\blater\b|deadlines?\b|latency|too slow",
    CABLE: r"[Pp]ort .{0,80}(failed|closed|lost)|unplugged|cable (is|was)|Is the cable|adapter",
    TORQUE: r"torque (is|was|seems|has been) (off|lost|cut|switched off|gone)|lost (its )?torque|carries|not follow"
    r"|goals? .{0,30}(lost|dropped|refused|ignored|not (arrive|reach))|watchdog",
    REBOOT: r"(was|has|been) (been )?reboot|restarted|power.cycle|supply (broke|was interrupted|failed)",
    HEAT: r"overheat|temperature|degrees C|too hot",
    OVERLOAD: r"overload",
    VOLTAGE: r"voltage|\d V\b",
    STUCK: r"stuck|\bheld\b|jammed|not move(?! like)|stands? still|blocked|not moving|something holds",
    ENCODER: r"encoder|magnet|seems to have moved|implausible|frozen|velocity and position"
    r"|position.{0,40}(disagree|contradict)|contradicts its position",
    LIMIT: r"(outside|more than|beyond|exceeded) (its|the) (position|velocity)[ _]limit",
    SIGN: r"sign of|against its command|wrong way|turned? round",
    PROGRAM: r"deadlines?\b|(the|this) computer|program (was|stood|stopped)|stalled|suspended|did not run|kept waiting",
    SIGNAL: r"Ctrl-C|SIGINT|SIGTERM|SIGHUP",
    MODEL: r"any arm|repeat its motion|than (the )?model|predicted|not as planned|foreseen|the dry run",
    REFUSED: r"refus|reports no hardware error|answers? with an? error",
    STRANGER: r"another (program|master)|Drive Mode is|somebody else|not asked for|collision|other master",
    MIXED: r"another servo's|mixed up|swapped|ID has changed|same ID|was not addressed:",
    REPEATED: r"repeated|too late or twice",
    SETTING: r"changed the settings.{0,80}(Homing Offset|Return (Delay Time|Level)|(PWM|Current) Limit|Secondary.*) is"
    r"|changed the settings.{0,80}((PWM|Current) Limit|Goal PWM) from"
    r"|(Homing Offset|Return Delay Time|PWM Limit) was changed during this|Current Limit is \d+, but current_limit",
    HAND: r"pushes or holds|pushing or holding|hit it|slips|begun to slip",
    DISK: r"\bdisk\b|no space|File too large|cannot be written",
    POSE: r"rest[_ ]pose|before the start|starts? (from|at)",
}
"""A message names a cause if it matches this pattern."""

_READINGS = frozenset({ENCODER, STUCK, MODEL, SIGN})
_FORGED = _READINGS | {TORQUE}
_BY_HAND = frozenset({HAND, STUCK, MODEL, SIGN, LIMIT})
_BY_MOTOR = _BY_HAND | {TORQUE}
_LOST_GOALS = frozenset({TORQUE, MODEL, STUCK})
_OTHER_GOALS = frozenset({TORQUE, MODEL, SIGN, LIMIT, STRANGER})
_BYTES = frozenset({SILENCE, GARBLED})
_REPEATED = _BYTES | {REPEATED}
_SLOW = frozenset({LATE, SILENCE})

CAUSES: dict[str, frozenset[str]] = {
    Kind.HOLD: _SLOW,
    Kind.SPLIT: _SLOW | _BYTES,
    Kind.DROP: frozenset({SILENCE}),
    Kind.CUT: _BYTES,
    Kind.REPEAT: _REPEATED,
    Kind.FLIP: _BYTES,
    Kind.ECHO: _BYTES,
    Kind.SWAP: _FORGED | {MIXED},
    Kind.FREEZE: _FORGED,
    Kind.SCALE: _FORGED | {LIMIT},
    Kind.REPLAY: _FORGED | {LATE},
    Kind.BIAS: _FORGED | {LIMIT, POSE},
    Kind.CREEP: _FORGED | {LIMIT, POSE},
    Kind.LAG: _FORGED | {LIMIT},
    Kind.JITTER: _FORGED | {LIMIT, POSE},
    Kind.STUCK_BIT: _FORGED | {LIMIT, POSE},
    Kind.CONSTANT: _FORGED | {LIMIT, POSE},
    Kind.COLLISION: _BYTES | {MIXED},
    Kind.DEAF: _LOST_GOALS | {SILENCE},  # if the chance is below 1, the servo may miss goals but answer other requests
    Kind.DEAF_TO_GOALS: _LOST_GOALS,
    Kind.TWICE_TOLD: _REPEATED,
    Kind.TORQUE_TAKEN: _LOST_GOALS,
    Kind.WATCHDOG_TRIPPED: _LOST_GOALS,
    Kind.STRANGE_GOAL: _OTHER_GOALS | {HAND},
    Kind.GOAL_FIGHT: _OTHER_GOALS,
    Kind.MODE_TAKEN: _OTHER_GOALS,
    Kind.ANSWERS_LESS: frozenset({SILENCE}),
    Kind.RAISED_LIMIT: frozenset(),
    Kind.LOWERED_LIMIT: _LOST_GOALS | {LIMIT, SETTING, STRANGER},  # as THROTTLED, written by another program
    Kind.WATCHDOG_OFF: frozenset({TORQUE, STRANGER}),
    Kind.WATCHDOG_LONG: frozenset({TORQUE, STRANGER}),
    Kind.TURNED_ROUND: _FORGED | {LIMIT, POSE, REFUSED, STRANGER},
    Kind.SLOW_REPLIES: _SLOW | _BYTES | {SETTING},
    Kind.NEW_ID: frozenset({SILENCE}),
    Kind.NEW_BAUD: frozenset({SILENCE}),
    Kind.CLOCK_RATE: frozenset({LATE}),
    Kind.CLOCK_WRAP: frozenset(),
    Kind.WEAK: _BY_MOTOR,
    Kind.SATURATED: _BY_MOTOR,
    Kind.PUSHED: _BY_HAND,
    Kind.GRIPPED: _BY_HAND,
    Kind.PLAY: _BY_HAND,
    Kind.DISK_FULL: frozenset({DISK}),
    Kind.STALL: frozenset({PROGRAM, LATE}),
    Kind.SIGINT: frozenset({SIGNAL}),
    Kind.SIGTERM: frozenset({SIGNAL}),
    Kind.SIGHUP: frozenset({SIGNAL}),
    Kind.KILLED: frozenset(),
    Kind.HICCUPS: frozenset({PROGRAM, LATE}),
    Kind.CLOCK_SET: frozenset(),
    Kind.WRONG_ID: _BYTES | {MIXED},
    Kind.ONE_BEHIND: _FORGED | {LATE},
    Kind.REORDERED: _BYTES | {MIXED},
    Kind.RIVAL: _OTHER_GOALS,
    Kind.FACTORY_RESET: frozenset({SILENCE, REBOOT, TORQUE}),
    Kind.SHADOWED: _OTHER_GOALS | {SETTING},
    Kind.THROTTLED: _BY_MOTOR | {SETTING, STRANGER},
    Kind.HOMING_MOVED: _FORGED | {LIMIT, POSE, SETTING, STRANGER},  # only another program writes it
    Kind.SLIP: _BY_HAND,
    Kind.OBSTACLE: _BY_HAND,
    Kind.SNAG: _BY_HAND,
    Kind.LOAD_CHANGED: _BY_HAND,
    Kind.FADING: _BY_MOTOR,
    Kind.IDS_SWAPPED: _LOST_GOALS | {LIMIT, POSE, MIXED, ENCODER},
    Kind.SUSPENDED: frozenset({PROGRAM, LATE}),
    FaultKind.LOST_REPLY: frozenset({SILENCE}),
    FaultKind.CORRUPTED_REPLY: _BYTES,
    FaultKind.TRUNCATED_REPLY: _BYTES,
    FaultKind.DUPLICATED_REPLY: _REPEATED,
    FaultKind.LATE_REPLY: _SLOW,
    FaultKind.NOISE: _BYTES,
    FaultKind.LOST_INSTRUCTION: _LOST_GOALS | {SILENCE},
    FaultKind.CORRUPTED_INSTRUCTION: _LOST_GOALS | _BYTES,
    FaultKind.SILENT_SERVO: frozenset({SILENCE}),
    FaultKind.REBOOT: frozenset({SILENCE, REBOOT, TORQUE}),
    FaultKind.OVERHEATING: frozenset({HEAT}),
    FaultKind.OVERLOAD: frozenset({OVERLOAD}),
    FaultKind.LOW_VOLTAGE: frozenset({VOLTAGE}),
    FaultKind.STUCK_JOINT: frozenset({STUCK, ENCODER, MODEL}),
    FaultKind.ENCODER_JUMP: frozenset({ENCODER, POSE}),
    FaultKind.CABLE_PULLED: frozenset({CABLE}),
    FaultKind.STATUS_ERROR: frozenset({REFUSED, SILENCE, TORQUE}),
    FaultKind.OTHER_MASTER: _BYTES | {STRANGER, LATE},
}
"""Causes that a message may name for each fault. The host cannot distinguish a jammed joint from a dead encoder."""

BESIDE: dict[str, frozenset[str]] = {
    Kind.RAISED_LIMIT: frozenset({SETTING, STRANGER}),
    Kind.ANSWERS_LESS: frozenset({SETTING, STRANGER}),
}
"""What a message may mention besides the cause of a stop: a real change by another program that does not stop the run.
"""

_OF_FIELD = {
    "position": _READINGS | {LIMIT, POSE},
    "velocity": _READINGS | {LIMIT},
    "current": frozenset({TORQUE, VOLTAGE}),
}
"""Causes that a message may name if only one reading is forged; e.g. a wrong angle must not be called lost torque."""


_INSTRUCTIONS = frozenset({FaultKind.LOST_INSTRUCTION, FaultKind.CORRUPTED_INSTRUCTION})
UNHEARD = _INSTRUCTIONS | {
    Kind.DEAF,
    Kind.STALL,
    Kind.SUSPENDED,
    Kind.KILLED,
    Kind.NEW_ID,
    Kind.NEW_BAUD,
    Kind.FACTORY_RESET,
    Kind.HICCUPS,
    FaultKind.CABLE_PULLED,
    FaultKind.SILENT_SERVO,
    FaultKind.REBOOT,
    FaultKind.STATUS_ERROR,
}
"""Faults during which the program cannot reach a servo, so that the watchdog's timeout applies."""

SHIFTED = frozenset({Kind.HOLD, Kind.STALL, Kind.SUSPENDED, Kind.HICCUPS, Kind.SPLIT, FaultKind.LATE_REPLY})
"""Faults after which the program may run its plan later than in an undisturbed run."""

HARMLESS = frozenset({Kind.CLOCK_WRAP, Kind.CLOCK_SET, Kind.RAISED_LIMIT})
"""Faults after which a run ends as if undisturbed."""

_OF_ONE_FIELD = frozenset({Kind.BIAS, Kind.CREEP, Kind.JITTER, Kind.STUCK_BIT, Kind.CONSTANT})

_LAST = frozenset({Kind.KILLED})


@dataclass(frozen=True)
class Drawn:
    """The faults of one run: attacks by the man in the middle and faults of the fake bus, timed from the start of the
    run.
    """

    attacks: tuple[Attack, ...]
    faults: tuple[Fault, ...]

    @property
    def kinds(self) -> tuple[str, ...]:
        return (*(str(each.kind) for each in self.attacks), *(str(each.kind) for each in self.faults))

    @property
    def start(self) -> float:
        return min([each.start for each in self.attacks] + [each.at for each in self.faults])

    def __str__(self) -> str:
        told = [
            f"{each.kind} servo {each.servo or 'all'} {each.start:.3f}-{each.end:.3f} s, chance {each.chance:g}, "
            f"{each.amount:.3g} {each.field}"
            for each in self.attacks
        ]
        told += [
            f"{each.kind} servo {each.servo or 'all'} {each.at:.3f}-{each.end:.3f} s, chance {each.probability:g}, "
            f"{each.size:g}"
            for each in self.faults
        ]
        return " and ".join(told)


def causes_of(drawn: Drawn) -> frozenset[str]:
    """Causes that a message may correctly name for these faults."""
    own = [CAUSES[each.kind] for each in drawn.faults]
    for each in drawn.attacks:
        is_forged = each.kind in FORGED - {Kind.SWAP, Kind.WRONG_ID}
        own.append(_OF_FIELD[each.field] if is_forged and each.field in _OF_FIELD else CAUSES[each.kind])
    return frozenset().union(*own)


def true_beside(drawn: Drawn) -> frozenset[str]:
    """What a message may truthfully mention about these faults although it is not the cause of a stop."""
    return frozenset().union(*(BESIDE.get(kind, ()) for kind in drawn.kinds)) - causes_of(drawn)


def draw(seed: object, until: float, ids: Sequence[int], often_since: float | None = None) -> Drawn:
    """Draw one or two faults for a run that lasts `until` [s] undisturbed; the same seed gives the same faults.

    often_since: beginning of a short final phase [s], in which an additional quarter of the faults is placed.
    """
    random = Random(f"drawn {seed}")
    first = random.uniform(0.0, until)
    if often_since is not None and random.random() < OFTEN:
        first = random.uniform(often_since, until)
    times = [first]
    if random.random() < PAIRS:
        close = first + random.uniform(0.0, TOGETHER_S)
        times.append(close if random.random() < 0.5 else random.uniform(0.0, until))
    attacks, faults = [], []
    for begun in times:
        kind = random.choice([*Kind, *FaultKind])
        at = max(times) if kind in _LAST else begun
        if isinstance(kind, Kind):
            attacks.append(_attack(kind, at, ids, random))
        else:
            faults.append(_fault(kind, at, ids, random))
    return Drawn(tuple(attacks), tuple(faults))


def _length(random: Random) -> float:
    """Duration of a fault [s]: from a few milliseconds to the end of the run."""
    return math.inf if random.random() < 0.4 else 10 ** random.uniform(-2.3, 0.7)


def _chance(random: Random) -> float:
    return random.choice((1.0, 1.0, 0.5, 0.1))


def _attack(kind: Kind, at: float, ids: Sequence[int], random: Random) -> Attack:
    servo = random.choice((None, *ids))
    # Values are forged without interruption: an intermittent forgery would be a new fault at every sample.
    chance = 1.0 if kind in FORGED | ON_MOTORS | {Kind.ECHO, Kind.ONE_BEHIND, Kind.REORDERED} else _chance(random)
    fields = ("position", "velocity", "current")
    field = random.choice(fields if kind in _OF_ONE_FIELD else ("state", *fields))
    amount = _amount(kind, field, random)
    return Attack(kind, at, at if kind in AT_ONCE else at + _length(random), servo, chance, amount, field)


def _amount(kind: Kind, field: str, random: Random) -> float:
    """Strength of the fault; its meaning depends on the kind."""
    sign = random.choice((-1.0, 1.0))
    ticks = {"position": 10 ** random.uniform(1.0, 3.6), "velocity": 10 ** random.uniform(0.3, 2.3)}.get(field, 100.0)
    return {
        Kind.HOLD: 10 ** random.uniform(-3, -0.7),
        Kind.SPLIT: 10 ** random.uniform(-4, -1.3),
        Kind.FLIP: float(random.randrange(1, 9)),
        Kind.SCALE: random.choice((-1.0, 0.0, 0.5, 0.8, 1.25, 2.0)),
        Kind.REPLAY: random.uniform(0.02, 0.5),
        Kind.BIAS: sign * ticks,
        Kind.CREEP: sign * 10 ** random.uniform(1.0, 2.7),
        Kind.LAG: 10 ** random.uniform(-2.0, -0.3),
        Kind.JITTER: 0.1 * ticks,
        Kind.STUCK_BIT: float(random.randrange(13 if field == "position" else 9)),
        Kind.CONSTANT: sign * random.choice((0.0, 1.0, 1023.0, 4095.0)),
        Kind.STALL: 10 ** random.uniform(-2, 0.5),
        Kind.STRANGE_GOAL: sign * random.uniform(0.05, 1.0),
        Kind.LOWERED_LIMIT: random.uniform(0.02, 0.9),
        Kind.CLOCK_RATE: sign * 10 ** random.uniform(-4.0, -2.3),
        Kind.WEAK: random.choice((-1.0, 0.0, 0.3, 0.5, 0.8, 1.3)),
        Kind.SATURATED: random.uniform(0.02, 0.8),
        Kind.PUSHED: sign * random.uniform(0.1, 2.0),
        Kind.GRIPPED: random.uniform(0.1, 2.0),
        Kind.PLAY: 10 ** random.uniform(-2.0, -0.7),
        Kind.GOAL_FIGHT: sign * random.uniform(0.02, 1.0),
        Kind.HICCUPS: random.choice((0.03, 0.1, 0.3)),
        Kind.CLOCK_SET: sign * 3600.0,
        Kind.RIVAL: sign * random.uniform(0.02, 1.0),
        Kind.THROTTLED: random.choice((0.0, 0.05, 0.3)),
        Kind.HOMING_MOVED: sign * 10 ** random.uniform(1.0, 3.3),
        Kind.SLIP: sign * 10 ** random.uniform(-1.3, -0.3),
        Kind.OBSTACLE: sign * random.uniform(0.5, 3.0),
        Kind.SNAG: random.uniform(0.3, 3.0),
        Kind.LOAD_CHANGED: sign * random.uniform(0.3, 2.0),
        Kind.FADING: 10 ** random.uniform(-1.0, 1.0),
        Kind.SUSPENDED: random.uniform(3.0, 12.0),
        Kind.ANSWERS_LESS: float(random.randrange(2)),
    }.get(kind, 0.0)


def _fault(kind: FaultKind, at: float, ids: Sequence[int], random: Random) -> Fault:
    servo = random.choice((None, *ids))
    amount = {
        FaultKind.LATE_REPLY: 10 ** random.uniform(-3, -1),
        FaultKind.STATUS_ERROR: float(random.choice((1, 2, 3, 4, 5, 6, 7, 128))),
        FaultKind.OTHER_MASTER: 10 ** random.uniform(-2.7, -0.7),
        FaultKind.REBOOT: 10 ** random.uniform(-2.0, -0.2),
        FaultKind.LOW_VOLTAGE: random.uniform(0.2, 3.0),
        FaultKind.ENCODER_JUMP: float(
            random.choice((-1, 1)) * random.choice((1024, 2048, 4096, random.randrange(60, 2049)))
        ),
    }.get(kind)
    length = _length(random)
    if kind == FaultKind.CABLE_PULLED:
        return Fault(kind=kind, at=at, duration=length)
    if kind in REPLY_FAULTS | INSTRUCTION_FAULTS | {FaultKind.STATUS_ERROR, FaultKind.OTHER_MASTER}:
        chance = _chance(random)
        return Fault(kind=kind, at=at, duration=length, servo=servo, probability=chance, amount=amount)
    lasting = kind in (FaultKind.STUCK_JOINT, FaultKind.SILENT_SERVO, FaultKind.LOW_VOLTAGE, FaultKind.ENCODER_JUMP)
    return Fault(kind=kind, at=at, duration=length if lasting else math.inf, servo=servo, amount=amount)
