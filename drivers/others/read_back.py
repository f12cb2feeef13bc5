"""Read-backs of goals, settings and Torque Enable: what a servo holds right before a cycle shows who commands it."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from random import Random
from typing import NamedTuple

from hil.drivers.others.foreign_values import ForeignValues
from hil.drivers.packet import ALERT
from hil.drivers.sync_read import Answer, FastSyncRead, GroupRead, Span, SyncRead, one_each

__all__ = ["TRY_AGAIN_S", "Overruled", "ReadBack", "pause_after"]

GOALS, MODES, TORQUE = range(3)
"""Kinds of read-back, as indices into `ReadBack.reads`."""

_OTHERS_S = {MODES: 0.025, TORQUE: 0.1}
"""Mean time between two read-backs of the modes, and between two of Torque Enable [s]. In between, goals are read back.

The actual time is random. If it were fixed, a program that overwrites goals periodically might always do so just when
the modes are read.
"""

_GOALS_PER_OTHER_IN_DOUBT = 4
"""Minimum number of goal read-backs between two read-backs of other kinds while a foreign value is suspected."""

_RECENT = 4
"""After lost writes, a servo may still hold any of the latest `_RECENT` goals; longer losses show in the status."""

_UNSURE_SIGHTINGS, _SIGHTINGS, _SIGHTED_S = 3, 2, 1.0
"""Numbers of read-backs of a foreign value that prove another writer, and the time within which they must occur [s].

Three read-backs of the same value are required for a goal that this program may have written in an earlier cycle, and
for 0, which a servo itself may have set. Before the third one, the status would have revealed lost writes, a tripped
watchdog or a reboot. If writes are lost only occasionally, the servo holds a different goal each time.
"""

_UNSURE_S = 0.01
"""Minimum time between the first and last of `_UNSURE_SIGHTINGS` [s], so that the status is read in between."""

TRY_AGAIN_S = 0.005
"""If a cycle leaves no time for a read-back, the read-back is tried again after this delay [s]."""

_AGAIN_SHARE = 0.5
_SHORT_CYCLE_S = 0.005
"""In cycles of up to `_SHORT_CYCLE_S` [s], a lost read-back is repeated at once, although this may delay the next cycle
by up to the fraction `_AGAIN_SHARE` of a cycle. In longer cycles, it is not repeated: read-backs are rarely destroyed
there, and a delay would leave the joints unobserved for too long.
"""

OVERDUE_S, OVERTIME_SHARE = 0.075, 0.8
"""If nothing was read back for `OVERDUE_S` [s] because cycles leave no time for it, a read-back may delay the next
cycle by up to the fraction `OVERTIME_SHARE` of a cycle; otherwise, a disarmed watchdog or lost torque would never be
detected. Every fourth such read-back is of Torque Enable.
"""

_DELAYED_SHARE, _DELAYED_SHARE_IN_DOUBT = 0.01, 0.1
"""Delay caused by an overdue read-back, as a fraction of the longest time until the next read-back. The second value
applies while a foreign value is suspected. The next read-back thus follows sooner than `OVERDUE_S` if the delay was
short.
"""

LOST_GOALS, LOST_OF = 3, 6
"""A servo that misses `LOST_GOALS` of `LOST_OF` goals counts as not accepting goals, even if it receives the next one.

The status check needs two consecutive missed goals: if every second goal is lost, it may not notice for 0.1 s. If one
goal in a hundred is lost, missing three of six is rarer than missing two consecutive ones.
"""

_FADES = 0.98
_IN_DOUBT_S = 0.3
"""How long after reading a foreign value further ones are expected [s]."""


_Sightings = deque[tuple[float, int]]
"""Time [s] and value of each read-back of a foreign value."""


class Overruled(NamedTuple):
    """A servo (by its index among the IDs) that holds a goal or other setting that this program did not write."""

    place: int
    register: str
    value: int
    written: int


def pause_after(delay: float, share: float = _DELAYED_SHARE) -> float:
    """Longest time [s] from an overdue read-back that delayed a cycle by `delay` [s] until the next one."""
    return min(OVERDUE_S, delay / share) if delay > 0.0 else OVERDUE_S


class ReadBack:
    """Reads back the goals that the servos hold right before a cycle, and occasionally other registers instead.

    goal: a span of Bus Watchdog, registers that limit the motor's output, and goal; `limits` holds each servo's values
    of these registers. mode: a span that ends with the settings; `modes` holds each servo's values. A change to one of
    them reverses the motor, shifts every angle, or changes the meaning of goals. torque: a span that begins with Torque
    Enable. watches_torque: whether Torque Enable is read back regularly, which is necessary if no status includes it.
    interval: time between two cycles [s], 0 if unknown.

    If a cycle leaves no time to read all servos, only one is read (`alone`); the servos take turns.

    Every cycle overwrites the goals of another master. A master that writes less often than this program is therefore
    detected only if the goals are read before every cycle.
    """

    def __init__(
        self,
        ids: Sequence[int],
        goal: Span | Sequence[Span],
        mode: Span | Sequence[Span],
        modes: Sequence[Sequence[int]],
        torque: Span | Sequence[Span],
        limits: Sequence[Sequence[int]],
        *,
        watches_torque: bool = False,
        interval: float,
        fast: bool,
    ) -> None:
        kind = FastSyncRead if fast else SyncRead
        spans = goal, mode, torque
        self.reads: tuple[GroupRead, ...] = tuple(kind(ids, span) for span in spans)
        self._alone = [list(map(_of_one, ids, one_each(span, len(ids)))) for span in spans]
        self.longest = 0.0
        """Duration of the longest recent read-back, without wire time [s]; it decays from one read-back to the next."""
        self._longest_again = _AGAIN_SHARE * interval if interval <= _SHORT_CYCLE_S else 0.0
        self._repeated_at = -math.inf
        self._goals = [own.registers[-1] for own in one_each(goal, len(ids))]
        self._names_of_limits = [own.registers[1:-1] for own in one_each(goal, len(ids))]
        self._limits = tuple(map(tuple, limits))
        self._modes = tuple(map(tuple, modes))
        self._settings = one_each(mode, len(ids))[0].registers[-len(self._modes[0]) :]
        self.kind = MODES
        """What is read back next."""
        self.place = 0
        """Index of the servo to read if there is only time for one."""
        self.modes_seen_at = -math.inf
        """Time of the latest read-back that found the expected settings in every servo [s]."""
        self._due = dict.fromkeys((MODES, TORQUE) if watches_torque else (MODES,), -math.inf)
        """Times at which the registers other than goals are due [s]."""
        self._goals_since = 0
        self._was_of_goals = False
        self._draws = {kind: Random(kind) for kind in (GOALS, MODES, TORQUE)}
        self._goals_sighted: list[_Sightings] = [deque() for _ in ids]
        self._settings_sighted: list[_Sightings] = [deque() for _ in ids]
        self._never_written = [ForeignValues() for _ in ids]
        """Values that this program cannot have written, by servo."""
        self.is_unexpected = False
        """Whether the latest read-back found anything other than the latest goals or the expected settings."""
        self.lost: Overruled | None = None
        """A servo that has missed `LOST_GOALS` of `LOST_OF` goals, with the older goal that it holds."""
        self._looks = [0] * len(self._goals)  # read-backs of each servo's goal so far
        self._missed: list[deque[int]] = [deque(maxlen=LOST_GOALS) for _ in ids]
        """Indices of the latest read-backs that found an older goal of this program, by servo."""
        self.watchdogs: list[tuple[int, int]] = []
        """Index and Bus Watchdog of each servo that answered the latest read-back; empty unless goals were read."""
        self.torque_off: int | None = None
        """Index of a servo whose Torque Enable read 0 when it was last read back; None if there is none."""
        self.overdue_at = math.inf
        """Time [s] after which a read-back may delay a cycle, unless something is read back earlier."""
        self.doubts_until = -math.inf
        self.sighted: Overruled | None = None
        """The latest value read back that this program did not write; it counts as recent until `doubts_until`."""

    @property
    def read(self) -> GroupRead:
        """The next group read to send."""
        return self.reads[self.kind]

    @property
    def alone(self) -> GroupRead:
        """The read to send instead if there is only time for one servo."""
        return self._alone[self.kind][self.place]

    @property
    def shortest(self) -> GroupRead:
        """The read of one servo's goal."""
        return self._alone[GOALS][0]

    @property
    def every(self) -> list[GroupRead]:
        """All reads that may be sent."""
        return [*self.reads, *chain.from_iterable(self._alone)]

    def took(self, seconds: float) -> None:
        self.longest = max(_FADES * self.longest, seconds)

    def postponed(self, now: float) -> None:
        """Record that a cycle left no time for a read-back."""
        self.overdue_at = min(self.overdue_at, now + OVERDUE_S)

    def delayed(self, now: float, delay: float, *, alone: bool) -> None:
        """Account for a read-back that has delayed the next cycle by `delay` [s], which may be 0.

        alone: whether only one of n servos was read; the next read-back is then due after 1/n of the usual pause.
        """
        if delay == 0.0 and self._was_of_goals and now >= min(self._due.values()):
            return  # what is due did not fit
        share = _DELAYED_SHARE_IN_DOUBT if now < self.doubts_until else _DELAYED_SHARE
        pause = pause_after(delay, share) * (1.0 - 0.5 * self._draws[GOALS].random() * (delay > 0.0))
        due = self.overdue_at + pause / len(self._goals) if alone else math.inf
        self.overdue_at = min(due, now + pause)

    def may_repeat(self, now: float, takes: float) -> bool:
        """Return whether to repeat a lost read-back at once. takes: duration of the repetition [s]."""
        if takes >= self._longest_again or now <= self._repeated_at + TRY_AGAIN_S:
            return False
        self._repeated_at = now
        return True

    def look(
        self,
        servos: Sequence[Answer],
        sent: Sequence[Sequence[int]],
        now: float,
        *,
        collided: bool = False,
        alone: bool = False,
    ) -> Overruled | None:
        """Compare the answers with the written values; return a value that only another master can have written, or
        None.

        An answer with an error is ignored: a servo that refuses a read reveals nothing about its goal.

        collided: whether a late reply may have destroyed the latest goals on the wire; a servo that holds an older
        goal is then not at fault. alone: whether only the servo whose turn it was has been read.
        """
        of_modes = self.kind == MODES
        self._was_of_goals = self.kind == GOALS
        self.place = (self.place + 1) % len(servos) if alone else 0
        if self._was_of_goals and not alone and (watchdogs := self._if_latest(servos, sent[-1])):
            self.watchdogs = watchdogs
            self._looks = [looks + (not collided) for looks in self._looks]
            self.is_unexpected = False
            self._choose_next(now)
            return None
        is_nearly_sure = False
        intact = [_intact(answer) for answer in servos]
        # Answers about goals begin with ERR and Bus Watchdog, those about torque with ERR and Torque Enable.
        told = [(at, each[1]) for at, each in enumerate(intact) if each is not None]
        self.watchdogs = told if self.kind == GOALS else []
        if self.kind == TORQUE:
            # If the servo has raised its alert, which explains why torque is off, the next cycle reports it.
            self.torque_off = next(
                (at for at, is_on in told if not is_on and not (servos[at] or (0,))[0] & ALERT), None
            )
        foreign = self._foreign(intact, sent, collided=collided)
        if of_modes and not foreign and None not in intact:
            self.modes_seen_at = now
        for place, register, value, written in foreign:
            of_goal = register == self._goals[place]
            seen = (self._goals_sighted if of_goal else self._settings_sighted)[place]
            while seen and now - seen[0][0] > _SIGHTED_S:
                seen.popleft()
            seen.append((now, value))
            self.sighted = Overruled(place, register, value, written)
            is_ours = of_goal and (value == 0 or any(value in each for each in sent))
            if not is_ours:
                self._never_written[place].add(now)
                if self._never_written[place].are_proof(now):
                    return self.sighted
            times = [when for when, other in seen if other == value or not is_ours]
            most, least_s = (_UNSURE_SIGHTINGS, _UNSURE_S) if is_ours else (_SIGHTINGS, 0.0)
            if len(times) >= most and now - times[0] >= least_s:
                return self.sighted
            self.doubts_until = now + _IN_DOUBT_S
            is_nearly_sure |= len(times) >= most - 1
        if not is_nearly_sure and self.place == 0:
            self._choose_next(now)
        return None

    def _if_latest(self, servos: Sequence[Answer], goals: Sequence[int]) -> list[tuple[int, int]]:
        """Return `watchdogs` if all servos hold their latest goals and report no error; otherwise nothing."""
        watchdogs: list[tuple[int, int]] = []
        for answer, goal, limits in zip(servos, goals, self._limits, strict=True):
            if not answer or answer[0] or answer[-1] != goal or answer[2:-1] != limits:
                return []
            watchdogs.append((len(watchdogs), answer[1]))
        return watchdogs

    def _choose_next(self, now: float) -> None:
        """Choose what to read next. Modes are read even while a foreign goal is suspected, since that goal may be the
        first sign of a mode change, which resets goals.
        """
        if self.kind == GOALS:
            self._goals_since += 1
        else:
            self._due[self.kind], self._goals_since = (
                now + _OTHERS_S[self.kind] * (0.5 + self._draws[self.kind].random()),
                0,
            )
        other = min(self._due, key=self._due.__getitem__)
        enough = _GOALS_PER_OTHER_IN_DOUBT if now < self.doubts_until else 1
        self.kind = other if now >= self._due[other] and self._goals_since >= enough else GOALS

    def _foreign(self, servos: Sequence[Answer], sent: Sequence[Sequence[int]], *, collided: bool) -> list[Overruled]:
        """Return the values that servos hold although this program did not write them."""
        if self.kind != GOALS:
            found = self._other_settings(servos) if self.kind == MODES else []
            self.is_unexpected = bool(found)
            return found
        for place, answer in enumerate(servos):
            self._looks[place] += answer is not None and not collided
        limits = self._other_limits(servos)
        self.is_unexpected = bool(limits) or any(
            answer is not None and answer[-1] != value for answer, value in zip(servos, sent[-1], strict=True)
        )
        if not self.is_unexpected:
            return []
        if not collided:
            self._count_missed(servos, sent)
        # A servo that received its neighbour's goal is not commanded by another master.
        own = set().union(*islice(reversed(sent), _RECENT))
        return limits + [
            Overruled(place, self._goals[place], answer[-1], sent[-1][place])
            for place, answer in enumerate(servos)
            if answer is not None and answer[-1] not in own
        ]

    def _other_limits(self, servos: Sequence[Answer]) -> list[Overruled]:
        """Return the limits that differ from what this program wrote or found."""
        held = [answer and answer[2:-1] for answer in servos]
        return list(_differing(held, self._names_of_limits, self._limits))

    def _other_settings(self, servos: Sequence[Answer]) -> list[Overruled]:
        """Return, for each servo, the first setting that differs from what this program wrote or found."""
        held = [answer and answer[-len(self._settings) :] for answer in servos]
        return list(_differing(held, [self._settings] * len(held), self._modes))

    def _count_missed(self, servos: Sequence[Answer], sent: Sequence[Sequence[int]]) -> None:
        """Count a missed goal for each servo that still holds an earlier goal from this program."""
        before = list(islice(reversed(sent), 1, _RECENT))
        for place, (answer, missed) in enumerate(zip(servos, self._missed, strict=True)):
            if answer is None or answer[-1] == sent[-1][place] or all(answer[-1] != each[place] for each in before):
                continue
            missed.append(self._looks[place])
            if len(missed) == LOST_GOALS and self._looks[place] - missed[0] < LOST_OF:
                self.lost = Overruled(place, self._goals[place], answer[-1], sent[-1][place])


def _differing(
    held: Sequence[tuple[int, ...] | None], names: Sequence[Sequence[str]], expected: Sequence[tuple[int, ...]]
) -> Iterator[Overruled]:
    """Yield, for each servo that answered, the first value that differs from the expected one."""
    for place, (values, wanted) in enumerate(zip(held, expected, strict=True)):
        if values is not None and values != wanted:
            each = zip(names[place], values, wanted, strict=True)
            yield next(Overruled(place, *one) for one in each if one[1] != one[2])


def _of_one(servo_id: int, span: Span) -> GroupRead:
    """Return a read of one servo; a fast read would be no shorter."""
    return SyncRead((servo_id,), span)


def _intact(answer: Answer) -> Answer:
    """Return the answer if it contains values and no error, otherwise None."""
    return answer if answer is not None and len(answer) > 1 and not answer[0] & ~ALERT else None
