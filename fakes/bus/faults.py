"""Faults of a fake bus: what can go wrong on a cable, in an adapter, in a servo and in a joint, timed and seeded.

    bus.faults.add(Fault(kind="lost_reply", servo=2, at=3.0, duration=0.5, probability=0.2))

The same from TOML, `[[fake.faults]]` with the same keys, and from the command line, `--fault lost_reply:servo=2,at=3`.
`FAULTS` lists the kinds with what they do. Times are seconds since the bus was made (`bus.time`).

Faults of packets (replies, instructions, noise) strike each packet while they last, with their probability. The others
happen once, at their time, or do not happen at all if chance says so. The same seed gives the same faults.
"""

import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from random import Random
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError


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
    """What a kind does, and what its `amount` is: its meaning, its value unless given."""

    does: str
    amount: str = ""
    default: float = 0.0


FAULTS: Mapping[FaultKind, FaultFacts] = {
    FaultKind.LOST_REPLY: FaultFacts("a status packet never reaches the host"),
    FaultKind.CORRUPTED_REPLY: FaultFacts("bits of a status packet are flipped", "bits", 1),
    FaultKind.TRUNCATED_REPLY: FaultFacts("a status packet ends early"),
    FaultKind.DUPLICATED_REPLY: FaultFacts("a status packet comes twice"),
    FaultKind.LATE_REPLY: FaultFacts("the adapter holds a status packet back", "seconds", 0.02),
    FaultKind.NOISE: FaultFacts("random bytes come before a status packet", "bytes", 8),
    FaultKind.LOST_INSTRUCTION: FaultFacts("no servo hears an instruction packet"),
    FaultKind.CORRUPTED_INSTRUCTION: FaultFacts("the servos hear an instruction packet with a wrong CRC"),
    FaultKind.STATUS_ERROR: FaultFacts(
        "a servo refuses what it is told and answers with an error; 128 is the Alert bit, with which alone it obeys",
        "ERR byte",
        1,
    ),
    FaultKind.OTHER_MASTER: FaultFacts(
        "another program on the bus asks a servo for its position, again and again", "seconds between", 0.01
    ),
    FaultKind.SILENT_SERVO: FaultFacts("a servo's bus cable is out: it hears and says nothing, its motor goes on"),
    FaultKind.REBOOT: FaultFacts("a servo's supply breaks down for a moment and it boots", "seconds deaf", 0.25),
    FaultKind.OVERHEATING: FaultFacts("a servo is hotter than its Temperature Limit", "kelvin above it", 10),
    FaultKind.OVERLOAD: FaultFacts("a servo finds itself overloaded"),
    FaultKind.LOW_VOLTAGE: FaultFacts("the supply falls below a servo's Min Voltage Limit", "volt below it", 1.0),
    FaultKind.STUCK_JOINT: FaultFacts("something holds a joint fast"),
    FaultKind.ENCODER_JUMP: FaultFacts("an encoder is wrong", "ticks", 512),
    FaultKind.CABLE_PULLED: FaultFacts(
        "the adapter's cable is pulled, and put back at the end; the port must be reopened"
    ),
}
"""All kinds of faults, and what they are."""

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
_LEAST_REPEAT_S = 1e-3


class Fault(BaseModel):
    """One injected fault. Immutable; `servo` is a bus ID at the time it begins, None is all of them."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    kind: Annotated[FaultKind, Field(strict=False, description="what goes wrong; see FAULTS")]
    at: Annotated[float, Field(ge=0, allow_inf_nan=False, description="when it begins [s since the bus was made]")] = (
        0.0
    )
    duration: Annotated[float, Field(gt=0, description="how long it lasts; without an end unless given [s]")] = math.inf
    servo: Annotated[int | None, Field(ge=0, le=252, description="bus ID of the servo; all unless given")] = None
    probability: Annotated[float, Field(ge=0, le=1, description="that it strikes a packet, or happens at all")] = 1.0
    amount: Annotated[
        float | None, Field(allow_inf_nan=False, description="how much; what of and the default depend on the kind")
    ] = None

    @property
    def end(self) -> float:
        """When it is over [s since the bus was made]."""
        return self.at + self.duration

    @property
    def size(self) -> float:
        """`amount`, or what the kind has instead of it."""
        return FAULTS[self.kind].default if self.amount is None else self.amount

    @property
    def repeats_every(self) -> float:
        """How often it happens anew while it lasts [s]; infinite for a fault that happens once."""
        return max(self.size, _LEAST_REPEAT_S) if self.kind is FaultKind.OTHER_MASTER else math.inf

    def concerns(self, servo_id: int) -> bool:
        return self.servo is None or self.servo == servo_id


class Happened(NamedTuple):
    """A fault that struck: when [s since the bus was made], which kind, and which servo, if it was one."""

    time: float
    kind: FaultKind
    servo: int | None


Effect = Callable[[Fault], None]


class Faults:
    """The faults of one bus: those to come, those that last, and a record of those that struck (`happened`)."""

    def __init__(self, seed: int, begin: Effect, end: Effect) -> None:
        self.happened: list[Happened] = []
        self.next_change = math.inf
        """When the next fault begins or ends [s since the bus was made]."""
        self.on_replies: list[Fault] = []
        self.on_instructions: list[Fault] = []
        self.on_answers: list[Fault] = []
        """The faults of packets that last just now; on_answers: of what servos make of them."""
        self.random = Random(f"faults {seed}")
        self._begin = begin
        self._end = end
        self._to_come: list[Fault] = []
        self._lasting: list[Fault] = []
        self._repeats: list[tuple[float, Fault]] = []

    def add(self, *faults: Fault) -> None:
        """Add faults. One whose time has passed begins at once."""
        self._to_come.extend(faults)
        self._look_ahead()

    def clear(self) -> None:
        """End all that last and forget those to come."""
        self._to_come.clear()
        for fault in list(self._lasting):
            self._finish(fault)
        self._look_ahead()

    @property
    def lasting(self) -> tuple[Fault, ...]:
        """The faults that have begun and not ended."""
        return tuple(self._lasting)

    def change(self, now: float) -> None:
        """Begin and end what is due by `now` [s since the bus was made]."""
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
        """The ERR byte with which a servo answers instead of obeying; 0 when it obeys. now: seconds of the bus."""
        for fault in self.on_answers:
            if self.strikes(fault, servo_id, now):
                return round(fault.size) & 0xFF
        return 0

    def strikes(self, fault: Fault, servo_id: int | None, now: float) -> bool:
        """Whether a fault of packets strikes this one; if so, that is kept in `happened`."""
        if fault.servo is not None and fault.servo != servo_id:
            return False
        if fault.probability < 1.0 and self.random.random() >= fault.probability:
            return False
        self.happened.append(Happened(now, fault.kind, servo_id))
        return True

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
            self.happened.append(Happened(now, fault.kind, fault.servo))
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
    """A fault as on the command line, `KIND` or `KIND:key=value,key=value`; raises ValueError."""
    kind, _, rest = text.partition(":")
    keys = [name for name in Fault.model_fields if name != "kind"]
    values: dict[str, object] = {"kind": kind}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if key not in keys or not equals:
            raise ValueError(f'fault "{text}": "{part}" is not KEY=VALUE with a key of {", ".join(keys)}')
        try:
            values[key] = int(value) if key == "servo" else float(value)
        except ValueError:
            raise ValueError(f'fault "{text}": {key} = {value!r}: must be a number') from None
    try:
        return Fault.model_validate(values)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        key = ".".join(map(str, detail["loc"]))
        allowed = f"; kinds: {', '.join(FaultKind)}" if key == "kind" else ""
        raise ValueError(f'fault "{text}": {key} = {detail["input"]!r}: {detail["msg"]}{allowed}') from None
