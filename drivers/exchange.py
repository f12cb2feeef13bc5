"""The control cycle on the wire: goals out and states in, with one write and one bounded read.

Current mode and PWM mode have separate goal registers and therefore separate Sync Writes. A Sync Write has no reply, so
all packets of a cycle can be sent in one write, which takes one adapter transaction instead of two. Packets are
prepared in advance; a cycle only packs the goals and computes one CRC per goal register.

The registers that are read vary from cycle to cycle. Most cycles read `spans[0]`. Every `slow_every`-th cycle reads one
of the other spans, in turn; every `status_every`-th cycle reads `status`, the registers that show whether torque is
still on. After a lost reply, the usual span is read with a few more bytes. Every span must include what the control
loop needs.
"""

import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from fastcrc import crc16

from hil.drivers.control_table import Register
from hil.drivers.others.heard import Heard
from hil.drivers.packet import BROADCAST_ID, HEADER, Instruction
from hil.drivers.port import Port, ReplyTime
from hil.drivers.sync_read import Answer, FastSyncRead, GroupRead, Span, SyncRead, one_each
from hil.drivers.turns import NEVER, Turns

HOST_S = 0.75e-3
"""Time allowed for the computer itself, including USB frames [s], in addition to wire, servos and adapter."""

PATIENCE_SHARE = 0.5
"""Minimum reply timeout as a fraction of the time between two cycles."""

MOST_PATIENCE_S = 0.02
"""Upper limit of the minimum reply timeout [s]: even in slow cycles, a silent servo must not delay the others."""

AFTER_LOSS = 5
"""Number of reads of different lengths that are used in turn after a lost reply. The length of a late reply then shows
which request it belongs to, provided that it is late by fewer cycles than this number.
"""

REMEMBERED = 128
"""Until the status shows that writes are lost, a servo may still hold any of the latest `REMEMBERED` goals."""

_LONGEST_REPLY = 1024
_DOUBTS = 3

_crc = crc16.umts
_pack_crc = struct.Struct("<H").pack


class Reply(NamedTuple):
    """The result of one exchange.

    time_before_write, time_after_read: times on the port's clock [s].
    span: index of the span that was read; len(spans) if the status was read.
    servos: one answer per servo as described in hil.drivers.sync_read, None for a servo that did not reply.
    """

    time_before_write: float
    time_after_read: float
    span: int
    servos: Sequence[Answer]


_reply = partial(tuple.__new__, Reply)  # half the time of Reply(...)


class Exchange:
    """Sync Write of a two-byte goal register and a group read of the state, for a fixed list of servos.

    goal: the goal register, or one per servo.
    spans, status: registers to read; each is one span for all servos, or one per servo.
    return_delay: the longest Return Delay Time of the servos [s].
    fast: whether to read with Fast Sync Read.
    one_write: whether to send both packets in one write instead of two.
    slow_every: number of cycles between two reads of a slow span, i.e. one of `spans[1:]`.
    status_every: number of cycles between two status reads; there are none if `status` is None.
    interval: time between two cycles [s], 0 if unknown; the longer it is, the longer a cycle can wait for a reply.
    patience: minimum time to wait for replies [s]; by default the longest time that the wire, the servos and the
    adapter may need.
    beside: registers that are read back between cycles; a late reply to such a read is also recognised by its length.
    """

    def __init__(
        self,
        port: Port,
        ids: Sequence[int],
        goal: Register | Sequence[Register],
        spans: Sequence[Span | Sequence[Span]],
        return_delay: float,
        *,
        fast: bool = False,
        one_write: bool = True,
        slow_every: int = 100,
        status: Span | Sequence[Span] | None = None,
        status_every: int = 20,
        interval: float = 0.0,
        patience: float = 0.0,
        beside: Sequence[Span | Sequence[Span]] = (),
    ) -> None:
        goals = (goal,) * len(ids) if isinstance(goal, Register) else tuple(goal)
        for register in goals:
            if register.size != 2:
                raise ValueError(f"{register.name} has {register.size} bytes; a goal must have 2.")
        self._port = port
        self._now = port.clock.now
        self._echoes: bool = getattr(port, "echoes", False)  # detected during set-up
        self.ids = tuple(ids)
        self.fast = fast
        self.one_write = one_write
        self._is_plain = one_write and not self._echoes
        """Whether goals and request are sent in one write, and the adapter does not echo them."""
        self._writes = [
            _GoalWrite(register, self.ids, [place for place, own in enumerate(goals) if own == register])
            for register in dict.fromkeys(goals)
        ]
        self._write = self._writes[0] if len(self._writes) == 1 else None
        every = [*spans] if status is None else [*spans, status]
        self._kinds = len(every)
        every += _of_other_lengths(every, beside, len(self.ids))
        reads: list[GroupRead] = [(FastSyncRead if fast else SyncRead)(self.ids, span) for span in every]
        self.heard = Heard(self.ids, reads)
        self.quickest = max(self._timeout(read, return_delay) for read in reads)
        """Time within which all replies arrive if this computer is not busy [s]."""
        least = max(patience, min(PATIENCE_SHARE * interval, MOST_PATIENCE_S))
        self._wire_s = {read: port.wire_time(self._bytes(read)) for read in reads}
        self._plans = [
            _Plan(
                read,
                span if span < self._kinds else 0,
                port.reply_time(max(self._timeout(read, return_delay), least), self._sent_bytes(read)),
                struct.Struct(f"<H{len(read.request)}s").pack,
                self._wire_s[read],
                0.5 * self._wire_s[read],
                span >= self._kinds,
            )
            for span, read in enumerate(reads)
        ]
        self._doubts = _DOUBTS
        self._turns = Turns(len(spans) - 1, slow_every, NEVER if status is None else status_every)
        self._usual_left = self._turns.plan()
        """Number of remaining cycles that read the usual span before another span may be due."""
        self._late_possible = False
        self._after_loss = 0
        self._cut_off = b""
        """Incomplete reply received before the latest exchange timed out."""
        self._sent: deque[Sequence[int]] = deque(maxlen=REMEMBERED)
        self._took = math.inf
        """Duration of the latest cycle [s]."""
        self._usual = self._latest_plan = self._plans[0]
        self._interval = interval
        shown = () if status is None else one_each(status, len(self.ids))[0].registers
        self._shows_torque = "Torque Enable" in shown

    @property
    def command_to_sample(self) -> float:
        """Wire time from the goals' arrival at the servos to the arrival of the read request [s].

        With two writes, the adapter may add a pause, which is not included.
        """
        return self._port.wire_time(len(self._plans[0].read.request))

    @property
    def usual_wire_s(self) -> float:
        """Wire time of most exchanges [s]."""
        return self._usual.wire_s

    @property
    def longest(self) -> float:
        """Wire time of the longest exchange [s], without adapter and computer: a lower bound on the cycle time."""
        return self._port.wire_time(max(self._bytes(plan.read) for plan in self._plans[: self._kinds]))

    @property
    def patience(self) -> float:
        """Longest time that a cycle waits for replies [s]."""
        return max(plan.reply_time.timeout for plan in self._plans)

    def wait_longer(self, seconds: float) -> None:
        """From now on, wait this much longer [s] for missing replies, which may merely be late."""
        self._plans = [plan._replace(reply_time=self._longer(plan, seconds)) for plan in self._plans]
        self._usual = self._plans[0]

    def _longer(self, plan: "_Plan", seconds: float) -> ReplyTime:
        return self._port.reply_time(plan.reply_time.timeout + seconds, self._sent_bytes(plan.read))

    def accept_any_order(self) -> None:
        """From now on, accept answers in any order. Use this only if the next request is not sent before all replies to
        the previous one have arrived or count as lost: nothing else shows which request an answer belongs to.
        """
        for plan in self._plans:
            if isinstance(plan.read, SyncRead):
                plan.read.in_any_order = True

    def read_status_next(self) -> None:
        """Read the status in the next cycle instead of waiting until it is due."""
        self._turns.count(self._usual_left)
        self._turns.read_status_next()
        self._usual_left = self._turns.plan()

    def cycle(self, goal_ticks: Sequence[int], *, between: bool = False) -> Reply:
        """Send one goal per servo and read all states; the answer of a servo that did not reply is None.

        between: whether this is an extra cycle between two samples. Slow spans then wait for the next sample, since
        only samples are recorded.

        Raises PortLost; ValueError for the wrong number of goals or a goal that does not fit into two bytes.
        """
        port = self._port
        if between:
            self._turns.between += 1
        left = self._usual_left = self._usual_left - 1
        plan = self._usual if left >= 0 else self._plans[self._any_span(between)]
        read, write = plan.read, self._write
        try:
            if write is None:
                sent = self._pack_each(goal_ticks) + read.request
            else:  # the inlined code of `_GoalWrite.pack`, which also appends the request to the CRC
                fields = write.fields
                fields[2::2] = goal_ticks
                sent = write.pack_fields(*fields)
                sent += plan.pack_behind(_crc(sent), read.request)
        except struct.error:
            raise ValueError(f"goals {list(goal_ticks)}: each must be a whole number from -32768 to 32767") from None
        self._sent.append(tuple(goal_ticks))
        before = self._now()
        if self._is_plain:
            received = port.ask(sent, read.reply_size, plan.reply_time, before)
        else:
            received = self._ask_otherwise(sent, plan, before)
        if port.overheard:
            self._overhear()
        self.heard.latest = received
        servos = read.unpack(received)
        after = self._now()
        took = after - before
        if servos is None or (took < plan.soonest and self._doubts):
            servos = self._look_again(plan, received, servos, before)
            after = self._now()
            took = after - before
        self._took = took
        self._latest_plan = plan
        return _reply((before, after, plan.span, servos))

    def _look_again(self, plan: "_Plan", received: bytes, servos: list[Answer] | None, before: float) -> list[Answer]:
        """Return the answers in a reply that is irregular (`servos` is None) or arrived too soon."""
        deadline = before + plan.reply_time.timeout
        if servos is not None:
            return self._latest(plan.read, servos, deadline)
        servos = self._search(plan.read, received, deadline)
        if None in servos:
            self._expect_late()
        return servos

    def _expect_late(self) -> None:
        """Make the next cycle allow for replies that are still in transit."""
        self._late_possible = True
        self._turns.count(self._usual_left)
        self._usual_left = self._turns.usual = 0

    def _latest(self, read: GroupRead, servos: list[Answer], deadline: float) -> list[Answer]:
        """Handle replies that arrive sooner than the wire time allows: they may belong to an earlier request.

        A duplicate of an earlier reply is still in the input when the next request is sent. If it were used, every
        later reply would be one cycle old. If another reply follows, it is the true one and is used instead. If none
        follows, the port is probably not a real serial line but, for example, a pty; after a few such cases, this check
        is switched off.
        """
        received = self._port.read(read.reply_size, max(0.0, deadline - self._now()))
        if not received:
            self._doubts -= 1
            return servos
        return read.unpack(received) or self._search(read, received, deadline)

    def _any_span(self, between: bool) -> int:
        """Choose the span for a cycle: after a lost reply, one of another length; otherwise, the one that is due."""
        self._turns.count(self._usual_left)
        if self._late_possible:
            self._late_possible = False
            if self._port.has_input():
                self._port.put_aside()
            # A reply that arrives even later must not be taken for the reply to this request. Nothing in a packet
            # identifies the request it belongs to, but its length differs if another span was requested. As several
            # replies in a row may be late, each request needs a length of its own.
            self._after_loss = self._after_loss % AFTER_LOSS + 1
            span = self._kinds - 1 + self._after_loss
        else:
            span = self._turns.due(between)
        self._usual_left = self._turns.plan()
        return span

    def _search(self, read: GroupRead, received: bytes, deadline: float) -> list[Answer]:
        """Extract the answers, which may be stuffed, damaged or missing; read until all have arrived or time is up."""
        while True:
            answers, over = read.search(received)
            remaining = deadline - self._now()
            if over or remaining <= 0:
                break
            # One byte at a time, since the length of a stuffed packet is not known in advance.
            received += self._port.read(1, remaining)
        self.heard.instead(read, received, answers, self._now(), echoes=self._echoes)
        if self._cut_off:
            self.heard.continued(self._cut_off, received, self._now())
        self._cut_off = b"" if over else received
        return answers

    def _overhear(self) -> None:
        """Examine bytes that were pending before the request."""
        self.heard.pending(self._port.overheard, self._now(), echoes=self._echoes)
        if self._cut_off:
            self.heard.continued(self._cut_off, self._port.overheard, self._now())
            self._cut_off = (self._cut_off + self._port.overheard)[-_LONGEST_REPLY:]
        self._port.overheard = b""

    def _ask_otherwise(self, sent: bytes, plan: "_Plan", start: float) -> bytes:
        """Return the reply without any echo; used if two writes are needed or the adapter echoes what is sent."""
        port, read = self._port, plan.read
        count = read.reply_size + (len(sent) if self._echoes else 0)
        if self.one_write:
            received = port.ask(sent, count, plan.reply_time, start)
        else:
            port.write(sent.removesuffix(read.request))
            expected = port.reply_time(plan.reply_time.timeout, len(read.request))
            received = port.ask(read.request, count, expected, start)
        if not self._echoes:
            return received
        if len(received) == read.reply_size and read.unpack(received) is not None:
            self._echoes = False  # the adapter no longer echoes; waiting for an echo would make every cycle late
            self._is_plain = self.one_write
        return received.removeprefix(sent)

    def _pack_each(self, goal_ticks: Sequence[int]) -> bytes:
        """Return the packets for these goals, one per goal register."""
        if len(goal_ticks) != len(self.ids):
            raise ValueError(f"{len(goal_ticks)} goals for {len(self.ids)} servos")
        return b"".join(write.pack([goal_ticks[place] for place in write.places]) for write in self._writes)

    def _timeout(self, read: GroupRead, return_delay: float) -> float:
        # Each servo's answer may contain up to two stuffing bytes.
        wire = self._port.wire_time(self._bytes(read) + 2 * len(self.ids))
        return wire + return_delay * len(self.ids) + self._port.latency + HOST_S

    def _sent_bytes(self, read: GroupRead) -> int:
        return sum(write.size for write in self._writes) + len(read.request)

    def _bytes(self, read: GroupRead) -> int:
        return self._sent_bytes(read) + read.reply_size


class _Plan(NamedTuple):
    """One of the group reads of an exchange.

    span: index of the span, as given in a Reply. reply_time: how long to wait for the replies. pack_behind: function
    that packs the goals' CRC and the request. wire_s: wire time of goals, request and replies [s]. soonest: time after
    the start of the cycle [s]; a complete reply that arrives sooner may belong to an earlier request. is_after_loss:
    whether a late reply may be on the wire when this read is sent, and may then destroy the goals.
    """

    read: GroupRead
    span: int
    reply_time: ReplyTime
    pack_behind: Callable[[int, bytes], bytes]
    wire_s: float
    soonest: float
    is_after_loss: bool


class _GoalWrite:
    """A Sync Write of one goal register to some of the servos; `places` are their indices among all IDs."""

    def __init__(self, goal: Register, ids: Sequence[int], places: Sequence[int]) -> None:
        # A two-byte value between ID bytes (at most 252) can never hold FF FF FD: the goals are never stuffed.
        packet = struct.Struct("<12s" + "Bh" * len(places))
        self.pack_fields = packet.pack
        self.fields: list[bytes | int] = [_front(goal, len(places))]
        for place in places:
            self.fields += [ids[place], 0]
        self.places = tuple(places)
        self.size = packet.size + 2

    def pack(self, goal_ticks: Sequence[int]) -> bytes:
        """Return the packet for these goals, one per servo in `places`. Raises struct.error for a goal that is too
        large, and ValueError or struct.error for a wrong number of goals.
        """
        fields = self.fields
        fields[2::2] = goal_ticks
        packet = self.pack_fields(*fields)
        return packet + _pack_crc(_crc(packet))


def _of_other_lengths(
    spans: Sequence[Span | Sequence[Span]], beside: Sequence[Span | Sequence[Span]], servos: int
) -> list[tuple[Span, ...]]:
    """Return variants of the usual span with extra leading bytes, such that no two spans have the same length."""
    taken = {one_each(span, servos)[0].size for span in (*spans, *beside)}
    usual = one_each(spans[0], servos)
    lengths = [size for size in range(usual[0].size + 1, usual[0].size + AFTER_LOSS + len(taken)) if size not in taken]
    return [tuple(each.longer(size - each.size) for each in usual) for size in lengths[:AFTER_LOSS]]


def _front(goal: Register, count: int) -> bytes:
    """Return the bytes of a Sync Write up to its first ID."""
    length = 7 + 3 * count  # INST, address, size, then per servo ID and value, CRC
    return struct.pack("<4sBHBHH", HEADER, BROADCAST_ID, length, Instruction.SYNC_WRITE, goal.address, goal.size)
