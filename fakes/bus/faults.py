"""Scheduled, seeded faults of a fake bus, in its cable, adapter, servos and joints.

    bus.faults.add(Fault(kind="lost_reply", servo=2, at=3.0, duration=0.5, probability=0.2))

Faults can also be given in TOML, as `[[fake.faults]]` with the same keys, and on the command line, as `--fault
lost_reply:servo=2,at=3`. `FAULTS` describes each kind. Times are seconds since the bus was created (`bus.time`).

Packet faults (replies, instructions, noise, another master) affect each packet with the given probability while they
last. Any other fault occurs at most once, with the given probability, at the given time. The same seed yields the same
faults.
"""

import difflib
import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from random import Random
from typing import Annotated, NamedTuple

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from hil.toml_errors import Described, describe

__all__ = [
    "FAULTS",
    "INSTRUCTION_FAULTS",
    "REPLY_FAULTS",
    "Fault",
    "FaultFacts",
    "FaultKind",
    "Faults",
    "Happened",
    "parse_fault",
]


class FaultKind(StrEnum):
    """Every kind of fault that can be injected."""

    LOST_REPLY = "lost_reply"
    CORRUPTED_REPLY = "corrupted_reply"
    TRUNCATED_REPLY = "truncated_reply"
    DUPLICATED_REPLY = "duplicated_reply"
    LATE_REPLY = "late_reply"
    NOISE = "noise"
    LOST_INSTRUCTION = "lost_instruction"
    CORRUPTED_INSTRUCTION = "corrupted_instruction"
    STATUS_ERROR = "status_error"
    OTHER_MASTER = "other_master"
    SILENT_SERVO = "silent_servo"
    REBOOT = "reboot"
    OVERHEATING = "overheating"
    OVERLOAD = "overload"
    LOW_VOLTAGE = "low_voltage"
    STUCK_JOINT = "stuck_joint"
    ENCODER_JUMP = "encoder_jump"
    CABLE_PULLED = "cable_pulled"


class FaultFacts(NamedTuple):
    """The effect of one kind of fault, and the meaning, default and range (inclusive) of its `amount`.

    amount: meaning of the amount, with its unit; "" if this kind has no amount. whole: whether the amount must be a
    whole number.
    """

    does: str
    amount: str = ""
    default: float = 0.0
    least: float = 0.0
    most: float = 0.0
    whole: bool = False

    @property
    def allowed(self) -> str:
        """The amounts allowed, in words."""
        number = "a whole number" if self.whole else "a number"
        return f"{number} from {self.least:.7g} to {self.most:.7g} ({self.amount})"

    def allows(self, amount: float) -> bool:
        return self.least <= amount <= self.most and (not self.whole or amount == round(amount))


FAULTS: Mapping[FaultKind, FaultFacts] = {
    FaultKind.LOST_REPLY: FaultFacts("a status packet never reaches the host"),
    FaultKind.CORRUPTED_REPLY: FaultFacts("bits of a status packet are flipped", "bits", 1, 1, 88, whole=True),
    FaultKind.TRUNCATED_REPLY: FaultFacts("a status packet ends early"),
    FaultKind.DUPLICATED_REPLY: FaultFacts("a status packet arrives twice"),
    FaultKind.LATE_REPLY: FaultFacts(
        "the adapter delays a status packet and all bytes after it", "seconds", 0.02, 1e-6, 3600
    ),
    FaultKind.NOISE: FaultFacts("random bytes precede a status packet", "bytes", 8, 1, 1000, whole=True),
    FaultKind.LOST_INSTRUCTION: FaultFacts("an instruction packet is lost on its way to one servo, or to all servos"),
    FaultKind.CORRUPTED_INSTRUCTION: FaultFacts(
        "an instruction packet arrives with a wrong CRC at one servo, or at all servos"
    ),
    FaultKind.STATUS_ERROR: FaultFacts(
        "a servo refuses commands and answers with an error; if amount=128 (only the Alert bit), it obeys and sets "
        "Alert",
        "ERR byte",
        1,
        1,
        255,
        whole=True,
    ),
    FaultKind.OTHER_MASTER: FaultFacts(
        "another program on the bus keeps requesting a servo's position", "seconds between requests", 0.01, 1e-3, 3600
    ),
    FaultKind.SILENT_SERVO: FaultFacts("a servo's bus cable is disconnected; its motor keeps running"),
    FaultKind.REBOOT: FaultFacts(
        "a servo reboots after a dip in its supply voltage", "seconds without response", 0.25, 0, 3600
    ),
    FaultKind.OVERHEATING: FaultFacts(
        "a servo is hotter than its Temperature Limit; when the fault ends, it cools by 10 K/s, unless its [thermal] "
        "table cools it from the start",
        "kelvin above it",
        10,
        1,
        150,
    ),
    FaultKind.OVERLOAD: FaultFacts("a servo reports overload"),
    FaultKind.LOW_VOLTAGE: FaultFacts(
        "the supply falls below a servo's Min Voltage Limit", "volts below it", 1.0, 0.1, 40
    ),
    FaultKind.STUCK_JOINT: FaultFacts("a joint is jammed"),
    FaultKind.ENCODER_JUMP: FaultFacts("an encoder's position reading is offset", "ticks", 512, -1e6, 1e6, whole=True),
    FaultKind.CABLE_PULLED: FaultFacts(
        "the adapter's cable is unplugged, and replugged when the fault ends; the port must be reopened"
    ),
}
"""Effect of every kind of fault."""

REPLY_FAULTS = frozenset(
    {
        FaultKind.LOST_REPLY,
        FaultKind.CORRUPTED_REPLY,
        FaultKind.TRUNCATED_REPLY,
        FaultKind.DUPLICATED_REPLY,
        FaultKind.LATE_REPLY,
        FaultKind.NOISE,
    }
)
INSTRUCTION_FAULTS = frozenset({FaultKind.LOST_INSTRUCTION, FaultKind.CORRUPTED_INSTRUCTION})

MOST_REMEMBERED = 100_000
"""`Faults.happened` keeps at least this number of the latest faults, and fewer than twice this number."""


class Fault(Described):
    """One injected fault (immutable). `servo` is the servo's bus ID when the fault begins; None means all servos."""

    kind: Annotated[FaultKind, Field(strict=False, description="kind of fault; see FAULTS")]
    at: Annotated[float, Field(ge=0, allow_inf_nan=False, description="start time [s since the bus was created]")] = 0.0
    duration: Annotated[float, Field(gt=0, description="duration [s]; unlimited by default")] = math.inf
    servo: Annotated[int | None, Field(ge=0, le=252, description="bus ID of the servo; all servos by default")] = None
    probability: Annotated[
        float, Field(ge=0, le=1, description="packet faults: probability per packet; others: probability of occurring")
    ] = 1.0
    amount: Annotated[
        float | None,
        Field(allow_inf_nan=False, description="size; its meaning, default and range depend on the kind"),
    ] = None

    @field_validator("amount")
    @classmethod
    def _allowed_amount(cls, amount: float | None, others: ValidationInfo) -> float | None:
        kind = others.data.get("kind")  # absent if the kind itself is invalid
        if kind is not None and (wrong := _wrong_amount(kind, amount)):
            raise ValueError(wrong)
        return amount

    @property
    def end(self) -> float:
        """Time at which the fault ends [s since the bus was created]."""
        return self.at + self.duration

    @property
    def size(self) -> float:
        """`amount`, or the default of this kind of fault."""
        return FAULTS[self.kind].default if self.amount is None else self.amount

    @property
    def repeats_every(self) -> float:
        """Period with which the fault recurs [s]; infinite for a fault that happens once."""
        return self.size if self.kind is FaultKind.OTHER_MASTER else math.inf

    def concerns(self, servo_id: int) -> bool:
        return self.servo is None or self.servo == servo_id


def _wrong_amount(kind: FaultKind, amount: float | None) -> str:
    """Return a description of the allowed amounts if a fault of this kind cannot have this amount, otherwise ""."""
    facts = FAULTS[kind]
    if amount is None or (facts.amount and facts.allows(amount)):
        return ""
    return f"must be {facts.allowed} for {kind}" if facts.amount else f"{kind} has no amount"


class Happened(NamedTuple):
    """A fault that took effect: time [s since the bus was created], kind, and servo (None if no particular servo)."""

    time: float
    kind: FaultKind
    servo: int | None


Effect = Callable[[Fault], None]


class Faults:
    """The faults of one bus: pending ones, active ones, and a record of those that took effect.

    happened: the faults that took effect; in a long run, only the latest (see `MOST_REMEMBERED`). count: how many took
    effect in total. begin, end: functions that apply a fault to the servos, and undo it. catch_up: function that
    advances the bus to the present, so that faults added or cleared now do not take effect at the time of the last
    packet.
    """

    def __init__(self, seed: int, begin: Effect, end: Effect, catch_up: Callable[[], None] = lambda: None) -> None:
        self.happened: list[Happened] = []
        self.count = 0
        self.next_change = math.inf
        """Time at which the next fault begins or ends [s since the bus was created]."""
        # Active faults that affect reply packets, instruction packets, and how servos answer.
        self.on_replies: list[Fault] = []
        self.on_instructions: list[Fault] = []
        self.on_answers: list[Fault] = []
        self.random = Random(f"faults {seed}")
        self._catch_up = catch_up
        self._begin = begin
        self._end = end
        self._to_come: list[Fault] = []
        self._lasting: list[Fault] = []
        self._repeats: list[tuple[float, Fault]] = []

    def add(self, *faults: Fault) -> None:
        """Add faults; those whose start time has passed begin immediately.

        Raises ValueError for an amount that is not allowed, which a modified copy of a fault may contain.
        """
        for fault in faults:
            if wrong := _wrong_amount(fault.kind, fault.amount):
                raise ValueError(f"fault: amount = {fault.amount!r}: {wrong}.")
        self._catch_up()
        self._to_come.extend(faults)
        self._look_ahead()

    def clear(self) -> None:
        """End all active faults and cancel the pending ones."""
        self._catch_up()
        self._to_come.clear()
        for fault in list(self._lasting):
            self._finish(fault)
        self._look_ahead()

    @property
    def lasting(self) -> tuple[Fault, ...]:
        """The faults that have begun but not yet ended."""
        return tuple(self._lasting)

    def change(self, now: float) -> None:
        """Begin and end all faults that are due by `now` [s since the bus was created]."""
        for fault in [fault for fault in self._lasting if fault.end <= now]:
            self._finish(fault)
        for fault in sorted((fault for fault in self._to_come if fault.at <= now), key=lambda fault: fault.at):
            self._to_come.remove(fault)
            self._start(fault, now)
        for index, (due, fault) in enumerate(self._repeats):
            if due <= now:
                self._repeats[index] = (max(due + fault.repeats_every, math.nextafter(now, math.inf)), fault)
                if self.strikes(fault, fault.servo, now):
                    self._begin(fault)
        self._look_ahead()

    def error(self, servo_id: int, now: float) -> int:
        """Return the ERR byte with which a servo answers during a status_error fault; 0 if no such fault is active.

        now: time since the bus was created [s].
        """
        for fault in self.on_answers:
            if self.strikes(fault, servo_id, now):
                return round(fault.size)
        return 0

    def strikes(self, fault: Fault, servo_id: int | None, now: float) -> bool:
        """Return whether a fault affects this packet, recording it in `happened` if it does."""
        if fault.servo is not None and fault.servo != servo_id:
            return False
        if fault.probability < 1.0 and self.random.random() >= fault.probability:
            return False
        self._note(now, fault.kind, servo_id)
        return True

    def _note(self, now: float, kind: FaultKind, servo_id: int | None) -> None:
        self.count += 1
        self.happened.append(Happened(now, kind, servo_id))
        if len(self.happened) >= 2 * MOST_REMEMBERED:
            del self.happened[:MOST_REMEMBERED]

    def _start(self, fault: Fault, now: float) -> None:
        self._lasting.append(fault)
        if fault.kind in REPLY_FAULTS:
            self.on_replies.append(fault)
        elif fault.kind in INSTRUCTION_FAULTS:
            self.on_instructions.append(fault)
        elif fault.kind is FaultKind.STATUS_ERROR:
            self.on_answers.append(fault)
        elif fault.repeats_every < math.inf:
            self._repeats.append((now, fault))
        elif fault.probability >= 1.0 or self.random.random() < fault.probability:
            self._note(now, fault.kind, fault.servo)
            self._begin(fault)
        else:
            self._lasting.remove(fault)

    def _finish(self, fault: Fault) -> None:
        self._lasting.remove(fault)
        if fault in self.on_replies:
            self.on_replies.remove(fault)
        elif fault in self.on_instructions:
            self.on_instructions.remove(fault)
        elif fault in self.on_answers:
            self.on_answers.remove(fault)
        elif fault.repeats_every < math.inf:
            self._repeats = [entry for entry in self._repeats if entry[1] is not fault]
        else:
            self._end(fault)

    def _look_ahead(self) -> None:
        times = [fault.at for fault in self._to_come] + [fault.end for fault in self._lasting]
        times += [due for due, _ in self._repeats]
        self.next_change = min(times, default=math.inf)


def parse_fault(text: str) -> Fault:
    """Parse a fault given on the command line as `KIND` or `KIND:key=value,key=value`; raises ValueError."""
    kind, _, rest = text.partition(":")
    if kind not in set(FaultKind):
        near = difflib.get_close_matches(kind, list(FaultKind), 1)
        meant = f" Did you mean {near[0]}?" if near else ""
        raise ValueError(f'fault "{text}": there is no kind {kind!r}.{meant} Available kinds: {", ".join(FaultKind)}')
    keys = [name for name in Fault.model_fields if name != "kind"]
    values: dict[str, object] = {"kind": kind}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if key not in keys or not equals:
            raise ValueError(f'fault "{text}": "{part}" is not KEY=VALUE with one of the keys {", ".join(keys)}')
        try:
            values[key] = int(value) if key == "servo" else float(value)
        except ValueError:
            raise ValueError(f'fault "{text}": {key} = {value!r}: must be a number') from None
    try:
        return Fault.model_validate(values)
    except ValidationError as error:
        raise ValueError(describe(error, f'fault "{text}"', Fault)) from None
