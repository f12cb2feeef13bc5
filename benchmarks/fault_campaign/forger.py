"""Forges values in complete replies and recomputes their CRCs, so that only the content is wrong."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from random import Random

from benchmarks.fault_campaign.attack import Attack, Kind, Request, blocks_in, field_of, forged, with_field

_IDS = 3
"""Largest wrong ID. Wrong IDs begin at 1, so they include the IDs of the arm and one that is not on the bus."""


class Forger:
    """Stores the servos' reported values and modifies them."""

    def __init__(self) -> None:
        self._latest: dict[int, tuple[int, bytes]] = {}
        self._history: deque[tuple[float, int, bytes]] = deque(maxlen=4000)
        self._frozen: dict[tuple[int, int, str], int] = {}
        self._lagging: dict[tuple[int, int, str], tuple[float, float]] = {}
        self._random = Random(0)

    def keep_and_forge(self, packet: bytes, request: Request | None, now: float, attacks: Sequence[Attack]) -> bytes:
        if request is None:
            return packet
        answers = blocks_in(packet, request)
        if not answers:
            return packet
        for servo_id, (_, block) in answers.items():
            self._history.append((now, servo_id, block))
        changed = dict(answers)
        for number, each in enumerate(attacks):
            for servo_id, (error, block) in changed.items():
                if each.concerns(servo_id):
                    changed[servo_id] = error, self._block(each, number, servo_id, block, request, now)
        self._latest.update(answers)
        named = _misnamed(answers, attacks)
        if (changed == answers and not named) or (request.fast and set(answers) != set(request.ids)):
            return packet
        return forged(changed, request, named)

    def _block(self, attack: Attack, number: int, servo_id: int, block: bytes, request: Request, now: float) -> bytes:
        if attack.kind == Kind.SWAP:
            others = [kept for other, (_, kept) in self._latest.items() if other != servo_id]
            return others[0] if others and len(others[0]) == len(block) else block
        names = ("current", "velocity", "position") if attack.field == "state" else (attack.field,)
        for name in names:
            value = field_of(block, request, name)
            if value is None:
                continue
            value = self._forged(attack, (number, servo_id, name), value, request, now, len(block))
            block = with_field(block, request, name, value)
        return block

    def _forged(
        self, attack: Attack, key: tuple[int, int, str], value: int, request: Request, now: float, length: int
    ) -> int:
        _, servo_id, name = key
        match attack.kind:
            case Kind.REPLAY:
                return self._earlier(servo_id, length, name, request, now - attack.amount, value)
            case Kind.FREEZE:
                return self._frozen.setdefault(key, value)
            case Kind.SCALE if name == "position":
                origin = self._frozen.setdefault(key, value)
                return origin + round(attack.amount * (value - origin))
            case Kind.SCALE:
                return round(attack.amount * value)
            case Kind.BIAS:
                return value + round(attack.amount)
            case Kind.CREEP:
                return value + round(attack.amount * (now - attack.start))
            case Kind.LAG:
                return self._lagged(key, value, now, attack.amount)
            case Kind.JITTER:
                return value + round(self._random.gauss(0.0, attack.amount))
            case Kind.STUCK_BIT:
                return value | 1 << round(attack.amount)
            case Kind.CONSTANT:
                return round(attack.amount)
        return value

    def _lagged(self, key: tuple[int, int, str], value: int, now: float, time_constant: float) -> int:
        before, then = self._lagging.get(key, (float(value), now))
        lagged = value + (before - value) * math.exp(-(now - then) / time_constant)
        self._lagging[key] = lagged, now
        return round(lagged)

    def _earlier(self, servo_id: int, length: int, name: str, request: Request, then: float, value: int) -> int:
        for when, other, block in self._history:
            if other == servo_id and when >= then and len(block) == length:
                earlier = field_of(block, request, name)
                return value if earlier is None else earlier
        return value


def _misnamed(answers: Mapping[int, object], attacks: Sequence[Attack]) -> dict[int, int]:
    """False IDs by true IDs, for servos that are to answer with a wrong ID: that of another servo, or an unused one."""
    hit = [each for each in answers for attack in attacks if attack.kind == Kind.WRONG_ID and attack.concerns(each)]
    return {each: each % _IDS + 1 for each in hit}
