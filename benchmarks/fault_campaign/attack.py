"""Man-in-the-middle attacks on the bytes between host and servos, and attacks on the servos themselves."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from hil.drivers.packet import HEADER, Framer, Instruction, Packet, crc, encode, encode_status

PRESENT = {"current": (126, 2), "velocity": (128, 4), "position": (132, 4)}
"""Address and size of the present registers whose values can be forged."""


class Kind(StrEnum):
    """Kinds of attack: on replies, on instructions, on servos, and on the program's environment."""

    HOLD = "hold"
    SPLIT = "split"
    DROP = "drop"
    CUT = "cut"
    REPEAT = "repeat"
    FLIP = "flip"
    ECHO = "echo"
    SWAP = "swap"
    FREEZE = "freeze"
    SCALE = "scale"
    REPLAY = "replay"
    BIAS = "bias"
    CREEP = "creep"
    LAG = "lag"
    JITTER = "jitter"
    STUCK_BIT = "stuck_bit"
    CONSTANT = "constant"
    COLLISION = "collision"
    DEAF = "deaf"
    DEAF_TO_GOALS = "deaf_to_goals"
    TWICE_TOLD = "twice_told"
    TORQUE_TAKEN = "torque_taken"
    MODE_TAKEN = "mode_taken"
    GOAL_FIGHT = "goal_fight"
    ANSWERS_LESS = "answers_less"
    WATCHDOG_TRIPPED = "watchdog_tripped"
    STRANGE_GOAL = "strange_goal"
    RAISED_LIMIT = "raised_limit"
    LOWERED_LIMIT = "lowered_limit"
    WATCHDOG_OFF = "watchdog_off"
    WATCHDOG_LONG = "watchdog_long"
    TURNED_ROUND = "turned_round"
    SLOW_REPLIES = "slow_replies"
    NEW_ID = "new_id"
    NEW_BAUD = "new_baud"
    CLOCK_RATE = "clock_rate"
    CLOCK_WRAP = "clock_wrap"
    WEAK = "weak"
    SATURATED = "saturated"
    PUSHED = "pushed"
    GRIPPED = "gripped"
    PLAY = "play"
    DISK_FULL = "disk_full"
    STALL = "stall"
    SIGINT = "SIGINT"
    SIGTERM = "SIGTERM"
    SIGHUP = "SIGHUP"
    KILLED = "killed"
    HICCUPS = "hiccups"
    CLOCK_SET = "clock_set"
    WRONG_ID = "wrong_id"
    ONE_BEHIND = "one_behind"
    REORDERED = "reordered"
    RIVAL = "rival"
    FACTORY_RESET = "factory_reset"
    SHADOWED = "shadowed"
    THROTTLED = "throttled"
    HOMING_MOVED = "homing_moved"
    SLIP = "slip"
    OBSTACLE = "obstacle"
    SNAG = "snag"
    LOAD_CHANGED = "load_changed"
    FADING = "fading"
    IDS_SWAPPED = "ids_swapped"
    SUSPENDED = "suspended"


ON_REPLIES = frozenset({Kind.HOLD, Kind.SPLIT, Kind.DROP, Kind.CUT, Kind.REPEAT, Kind.FLIP, Kind.COLLISION}) | {
    Kind.ONE_BEHIND,
    Kind.REORDERED,
}
FORGED = frozenset({Kind.SWAP, Kind.FREEZE, Kind.SCALE, Kind.REPLAY, Kind.BIAS, Kind.CREEP, Kind.LAG, Kind.JITTER}) | {
    Kind.STUCK_BIT,
    Kind.CONSTANT,
    Kind.WRONG_ID,
}
ON_MOTORS = frozenset({Kind.WEAK, Kind.SATURATED, Kind.PUSHED, Kind.GRIPPED, Kind.PLAY}) | {
    Kind.SLIP,
    Kind.OBSTACLE,
    Kind.SNAG,
    Kind.LOAD_CHANGED,
    Kind.FADING,
}
ON_INSTRUCTIONS = frozenset({Kind.DEAF, Kind.DEAF_TO_GOALS, Kind.TWICE_TOLD, Kind.GOAL_FIGHT})
ON_TIME = frozenset({Kind.RIVAL, Kind.HICCUPS})
"""Attacks that recur from their start to their end."""

AT_ONCE = frozenset(set(Kind) - ON_REPLIES - FORGED - ON_INSTRUCTIONS - ON_MOTORS - ON_TIME - {Kind.ECHO})
"""Attacks that happen once, at their start time."""

ON_PROGRAM = frozenset({Kind.SIGINT, Kind.SIGTERM, Kind.SIGHUP, Kind.KILLED, Kind.STALL, Kind.SUSPENDED}) | {
    Kind.DISK_FULL,
    Kind.CLOCK_SET,
}
"""Attacks that happen once and take effect only while the program runs."""


@dataclass(frozen=True)
class Attack:
    """One attack, from `start` to `end` [s on the port's clock].

    servo: bus ID, None for all. chance: probability of affecting a packet. amount: seconds, bits, ticks or a factor,
    depending on the kind. field: the register that is forged, or "state" for all three.
    """

    kind: Kind
    start: float
    end: float
    servo: int | None = None
    chance: float = 1.0
    amount: float = 0.0
    field: str = "state"

    def concerns(self, servo_id: int) -> bool:
        return self.servo is None or self.servo == servo_id


@dataclass(frozen=True)
class Request:
    """The group read that the servos are answering: start address and length of the block, IDs, and whether the read is
    a fast read.
    """

    address: int
    length: int
    ids: tuple[int, ...]
    fast: bool


def packets_of(data: bytes) -> list[bytes]:
    """Split one write into packets; bytes that belong to no packet stay with the packet before them."""
    starts = [at for at in range(len(data)) if data.startswith(HEADER, at)]
    return [data[at:end] for at, end in zip(starts, [*starts[1:], len(data)], strict=True)] or [data]


def request_in(data: bytes) -> Request | None:
    """Return the group read that these bytes from the host contain; None if there is none."""
    return request_among(Framer().feed(data))


def request_among(packets: Iterable[Packet]) -> Request | None:
    """Return the first group read among these packets; None if there is none."""
    for packet in packets:
        if packet.instruction in (0x82, 0x8A) and len(packet.body) > 4:
            address, length = int.from_bytes(packet.body[:2], "little"), int.from_bytes(packet.body[2:4], "little")
            return Request(address, length, tuple(packet.body[4:]), packet.instruction == 0x8A)
    return None


def goals_in(packet: Packet) -> dict[int, tuple[int, int]]:
    """Address and goal, by servo ID, in a Sync Write of two-byte goals; empty for any other packet."""
    body = packet.body
    if packet.instruction != 0x83 or len(body) < 7 or body[2:4] != b"\x02\x00" or body[0] not in (100, 102):
        return {}
    return {
        body[at]: (body[0], int.from_bytes(body[at + 1 : at + 3], "little", signed=True))
        for at in range(4, len(body) - 2, 3)
    }


def without_goal(data: bytes, servo_id: int) -> bytes:
    """Remove this servo's goal from a Sync Write of two-byte goals, as if the servo had missed the packet."""
    body = data[8:-2]
    kept = [body[at : at + 3] for at in range(4, len(body) - 2, 3) if body[at] != servo_id]
    return encode(data[4], Instruction(data[7]), body[:4] + b"".join(kept)) if kept else b""


def blocks_in(data: bytes, request: Request) -> dict[int, tuple[int, bytes]]:
    """Error byte and register block, by servo ID, of the complete answers to `request` in these bytes."""
    if request.fast:
        return _fast_blocks_in(data, request)
    found: dict[int, tuple[int, bytes]] = {}
    for packet in Framer().feed(data):
        if packet.instruction != 0x55:
            continue
        if packet.id in request.ids and len(packet.data) == request.length:
            found[packet.id] = packet.error, packet.data
    return found


def _fast_blocks_in(data: bytes, request: Request) -> dict[int, tuple[int, bytes]]:
    """Like `blocks_in`, for a fast answer, which is never byte-stuffed; stop at the first wrong CRC."""
    found: dict[int, tuple[int, bytes]] = {}
    length = 1 + (request.length + 4) * len(request.ids)
    start = data.rfind(HEADER + b"\xfe" + length.to_bytes(2, "little"))  # an answer to another request may be pending
    at = start + 8  # ERR, ID, data and CRC of each servo, after header, ID, LEN and INST
    for servo_id in request.ids if start >= 0 else ():
        end = at + 2 + request.length
        if len(data) < end + 2 or crc(data[start:end]) != int.from_bytes(data[end : end + 2], "little"):
            break
        if data[at + 1] == servo_id:
            found[servo_id] = data[at], data[at + 2 : end]
        at = end + 2
    return found


def field_of(block: bytes, request: Request, name: str) -> int | None:
    """Value of the register Present `name` in a block [ticks]; None if the block does not contain it."""
    address, size = PRESENT[name]
    at = address - request.address
    if at < 0 or at + size > request.length:
        return None
    return int.from_bytes(block[at : at + size], "little", signed=True)


def with_field(block: bytes, request: Request, name: str, value: int) -> bytes:
    """The block with the value of one Present register replaced."""
    address, size = PRESENT[name]
    at = address - request.address
    if at < 0 or at + size > request.length:
        return block
    bound = 1 << 8 * size - 1
    value = max(-bound, min(bound - 1, value))
    return block[:at] + value.to_bytes(size, "little", signed=True) + block[at + size :]


def forged(answers: dict[int, tuple[int, bytes]], request: Request, named: Mapping[int, int] | None = None) -> bytes:
    """Encode answers with forged values and correct CRCs. named: false IDs, by the true IDs that they replace."""
    named = named or {}
    if not request.fast:
        return b"".join(
            encode_status(named.get(servo_id, servo_id), error, block) for servo_id, (error, block) in answers.items()
        )
    length = 1 + (request.length + 4) * len(request.ids)
    whole = HEADER + b"\xfe" + length.to_bytes(2, "little") + b"\x55"
    for servo_id in request.ids:
        error, block = answers[servo_id]
        whole += bytes((error, named.get(servo_id, servo_id))) + block
        whole += crc(whole).to_bytes(2, "little")
    return whole
