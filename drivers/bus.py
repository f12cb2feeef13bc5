"""Prepares one arm's servos on one port and runs their control cycle; `hil.drivers.torque` switches their torque."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import NoReply, ServoFault, WrongModel, WrongReply
from hil.drivers.joint import Joint
from hil.drivers.others.heard import MOST_MIXED_UP, MOST_STRANGERS
from hil.drivers.packet import ALERT
from hil.drivers.port import Port, open_port
from hil.drivers.preparation.cadence import CHECK_S, cadence
from hil.drivers.preparation.prepare import (
    check_quiet,
    learn_latency,
    overheard,
    overruled,
    prepare_servo,
)
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.read_back_exchange import ReadBackExchange
from hil.drivers.servo import Servo
from hil.drivers.servo_model import RETURN_DELAY_UNIT, VOLTAGE_UNIT, with_article
from hil.drivers.state import LIMITS, NAN, SETTINGS, Converter, State, fold, read_back_spans, spans
from hil.drivers.sync_read import Answer, Span, SyncRead
from hil.drivers.torque.held import LetDown, Originals, held_servos, let_sink, refuse_held
from hil.drivers.torque.switch import TorqueSwitch

__all__ = ["CHECK_S", "BusConfig", "ServoBus"]

_PROBES = 3
"""Number of unanswered Fast Sync Reads after which Sync Read is used instead."""


@dataclass(frozen=True)
class BusConfig:
    """Where the servos are connected and how to communicate with them.

    url: device or pyserial URL.
    one_write: whether to send Sync Write and group read in one write; False if `hil check` finds that the arm needs two
    writes.
    fast_sync_read: whether to use Fast Sync Read if the firmware of every servo supports it.
    slow_every: number of samples between two slow reads, which alternate between the servo clock (Realtime Tick) and
    voltage plus temperature.
    watchdog_required: whether to reject firmware without Bus Watchdog.
    take_over: whether to let an arm whose torque is already on sink slowly, and then cut torque, instead of refusing to
    start.
    interval: time between two samples [s]; 0 if the rate is not fixed, in which case the servos' status is not read.
    """

    url: str
    baud: int
    joints: tuple[Joint, ...]
    one_write: bool = True
    fast_sync_read: bool = True
    slow_every: int = 100
    watchdog_required: bool = True
    take_over: bool = False
    interval: float = 0.0

    def __post_init__(self) -> None:
        ids = [drive.id for joint in self.joints for drive in joint.drives]
        if len(set(ids)) < len(ids):
            raise ValueError(f"The servos' IDs are {', '.join(map(str, ids))}, but each must be unique.")

    def is_same_arm(self, other: "BusConfig") -> bool:
        """Return whether both configurations describe the same servos on the same port.

        `Joint.near` may differ: it only selects the turn, and a pilot's runs start where the arm has come to rest.
        """
        joints, others = ([replace(joint, near=None) for joint in each.joints] for each in (self, other))
        return (self.url, self.baud, joints) == (other.url, other.baud, others)


class ServoBus(TorqueSwitch):
    """The servos of an arm on an open port. Use as a context manager; `close` may be called twice.

        with ServoBus.open(BusConfig("/dev/ttyUSB0", 1_000_000, joints)) as bus, bus.torque(watchdog=0.1):
            state = bus.exchange([0.1, 0.0])

    After any error, the same object can still cut torque; `torque_off_report` then shows whether that succeeded.
    """

    def __init__(self, port: Port, config: BusConfig) -> None:
        drives = tuple(drive for joint in config.joints for drive in joint.drives)
        tables = {drive: load_control_table(drive.servo.name) for drive in drives}
        super().__init__(port, {drive: Servo(port, drive.id, tables[drive], drive.title) for drive in drives})
        self.config = config
        self.joints = config.joints
        self._drives = drives
        """One single-servo joint per servo."""
        self._of = tuple(index for index, joint in enumerate(self.joints) for _ in joint.drives)
        self._in_pairs = len(self._drives) > len(self.joints)
        self._measured = self._drives
        """Like `_drives`, but `prepare` shifts the zeros to the servos' present turn."""
        self._exchange: ReadBackExchange | None = None
        self.exchanges_per_sample = 1
        """Number of exchanges per sample, chosen by `prepare` so that they are at most CHECK_S apart if possible."""
        self._converter = Converter(self._drives, [NAN] * len(self._drives))
        self._last_answers: Sequence[Answer] = ()
        self._alerted: set[Joint] = set()
        """Servos that have set their alert bit in an exchange; recorded only if a joint has several servos."""

    @classmethod
    def open(cls, config: BusConfig) -> "ServoBus":
        """Open the port, check that the expected servos answer and that their torque is off, and set every servo's
        mode.

        Raises PortNotOpened, NoReply, WrongModel, ServoFault, WrongSetting or TorqueHeld, after closing the port.
        """
        bus = cls.connect(config)
        try:
            bus.check_identity()
            bus.release_held()
            bus.prepare()
        except BaseException:
            bus.close()
            raise
        return bus

    @classmethod
    def connect(cls, config: BusConfig) -> "ServoBus":
        """Open the port without sending anything, for set-up work; raises PortNotOpened."""
        port = open_port(config.url, config.baud)
        try:
            return cls(port, config)
        except BaseException:
            port.close()
            raise

    def __enter__(self) -> "ServoBus":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.port.close()

    def servo(self, joint: Joint) -> Servo:
        """Return the joint's servo (the first if it has several), for reading and writing registers."""
        return self.servos(joint)[0]

    def servos(self, joint: Joint) -> tuple[Servo, ...]:
        """Return all servos of a joint, in the order of its `drives`."""
        return tuple(self._servos[drive] for drive in joint.drives)

    def _silent(self) -> set[Joint]:
        answers = zip(self._drives, self._last_answers, strict=False)
        return {drive for drive, answer in answers if answer is None or len(answer) == 1}

    def learn_latency(self) -> None:
        """Lower the adapter's latency timer, and measure whether the adapter is slower than expected for its type.

        Before this has been called, late replies through a slow adapter may be mistaken for replies to the next
        request. Raises PortLost.
        """
        self.port.lower_latency()
        learn_latency(next(iter(self._servos.values())))

    def check_identity(self) -> None:
        """Ping every servo and compare its model and firmware with the configuration; raises NoReply, WrongModel.

        Also lowers the adapter's latency timer and determines whether the adapter is slower than expected for its type.
        """
        self.learn_latency()
        for joint, servo in self._servos.items():
            number = servo.ping()
            if number != servo.table.number:
                known = model_names().get(number)
                found = with_article(known) if known else f"a servo with model number {number}"
                raise WrongModel(
                    f"{joint.title}: {found} answers at ID {joint.id}, but the configuration specifies "
                    f"{with_article(joint.servo.name)}. Correct `model` or `id` in the configuration, or change the "
                    "servo's ID."
                )
            try:
                firmware = servo.read("Firmware Version")
            except NoReply as error:
                raise NoReply(
                    f"{joint.title} answers pings but not reads: its Status Return Level is probably 0. Power-cycle "
                    "it to reset that level to 2."
                ) from error
            if firmware < joint.servo.watchdog_firmware:
                self._no_watchdog(joint, firmware)

    def _no_watchdog(self, joint: Joint, firmware: int) -> None:
        if self.config.watchdog_required:
            raise WrongModel(
                f"{joint.title}: firmware {firmware} has no Bus Watchdog; {joint.servo.watchdog_firmware} or newer is "
                "needed. Update it with DYNAMIXEL Wizard 2.0. With safety.allow_no_watchdog = true, the servo is "
                "accepted, but nothing then stops it when the program is killed or the cable is pulled."
            )
        self._without_watchdog.add(joint)

    def release_held(
        self, ours: Collection[Joint] = (), before_lowering: Callable[[Collection[Joint]], Originals] | None = None
    ) -> LetDown:
        """Ensure that every servo's torque is off before anything is written.

        If torque is on, raises TorqueHeld or, if `BusConfig.take_over` is set, lets the arm sink (`let_sink`).
        ours: joints whose torque was left on by a program that this user ran earlier; that torque is cut immediately.
        before_lowering: called with the joints that are about to be let down, before anything is written to their
        servos; returns the `originals` of `let_sink`.
        """
        for joint in ours:
            if self._servos[joint].read("Torque Enable"):
                self._servos[joint].write("Torque Enable", 0)
        down = LetDown()
        if self.config.take_over and (held := held_servos(self._servos)):
            originals = None if before_lowering is None else before_lowering(held)
            down = let_sink(held, self.port.clock, originals)
        refuse_held(self._servos)
        for servo in self._servos.values():
            if servo.read("Bus Watchdog") == WATCHDOG_TRIPPED and servo.read("Torque Enable"):
                servo.write("Torque Enable", 0)  # if torque is on after this, another program has switched it on
        return down

    def prepare(self) -> None:
        """Set every servo's mode with torque off, and prepare the exchange.

        Raises ServoFault, BusShared if another master is heard or has switched torque on since `release_held`, and
        WrongSetting if a register rules out an experiment and only the user may change it.
        """
        check_quiet(self.port)
        ids = {drive.id for drive in self._drives}
        for joint, servo in self._servos.items():
            if servo.read("Torque Enable"):
                self.refuse_switched_on()
            prepare_servo(joint, servo, ids - {joint.id})
        self._measured = tuple(
            joint.within_turn(servo.read("Present Position")) for joint, servo in self._servos.items()
        )
        supply = [VOLTAGE_UNIT * servo.read("Present Input Voltage") for servo in self._servos.values()]
        units = [joint.drive_unit(voltage) for joint, voltage in zip(self._drives, supply, strict=True)]
        self._converter = Converter(self._measured, units)
        one_write = self.config.one_write
        fast = self.config.fast_sync_read and self.knows_fast_sync_read()
        exchange = self.make_exchange(fast=fast, one_write=one_write)
        nothing = [0] * len(self._drives)
        if fast and all(None in exchange.cycle(nothing).servos for _ in range(_PROBES)):
            exchange = self.make_exchange(fast=False, one_write=one_write)
        self.add_read_back(exchange)
        self._exchange = exchange

    def add_read_back(self, exchange: ReadBackExchange) -> None:
        """Make `exchange` read back the servos' goals, Torque Enable, and the settings that must not change."""
        modes = [drive.mode for drive in self._drives]
        servos = self._servos.values()
        settings = [[servo.read(name) for name in SETTINGS] for servo in servos]
        limits = [[servo.read(name) for name in LIMITS[mode]] for mode, servo in zip(modes, servos, strict=True)]
        exchange.add_read_back(*read_back_spans(modes, [servo.table for servo in servos]), settings, limits)

    def knows_fast_sync_read(self) -> bool:
        """Return whether every servo's firmware supports Fast Sync Read."""
        return all(_knows_fast_sync_read(joint, servo) for joint, servo in self._servos.items())

    def make_exchange(
        self,
        *,
        fast: bool,
        one_write: bool,
        slow_every: int | None = None,
        status: bool = True,
        patience: float = 0.0,
    ) -> ReadBackExchange:
        """Return an exchange with these servos, after reading their Return Delay Times.

        fast: whether to use Fast Sync Read instead of Sync Read.
        one_write: whether to send the goals and the read request in one write instead of two.
        slow_every: number of cycles between two slow reads; by default `BusConfig.slow_every`.
        status: whether to read the servos' status periodically if there is time.
        patience: minimum time to wait for replies before they count as lost [s].
        """
        servos = self._servos.values()
        tables = [servo.table for servo in servos]
        modes = [drive.mode for drive in self._drives]
        return_delay = max(RETURN_DELAY_UNIT * servo.read("Return Delay Time") for servo in servos)
        every, span, status_every = (
            cadence(self.config.interval, self.port, self._drives, tables, return_delay) if status else (1, None, 0)
        )
        self.exchanges_per_sample = every
        return ReadBackExchange(
            self.port,
            [servo.id for servo in servos],
            [table[mode.goal_register] for table, mode in zip(tables, modes, strict=True)],
            spans(modes, tables),
            return_delay,
            fast=fast,
            one_write=one_write,
            slow_every=slow_every or self.config.slow_every,
            status=span,
            status_every=status_every,
            interval=self.config.interval / every,
            patience=patience,
            beside=read_back_spans(modes, tables),
        )

    @property
    def prepared(self) -> ReadBackExchange:
        """The prepared exchange; raises RuntimeError if `prepare` has not been called."""
        if self._exchange is None:
            raise RuntimeError("ServoBus.prepare has not been called")
        return self._exchange

    def read_positions(self) -> tuple[float, ...]:
        """Read each joint's angle [rad], from its first servo, outside the control cycle."""
        first = [self._of.index(index) for index in range(len(self.joints))]
        return tuple(
            self._measured[place].angle(self._servos[self._drives[place]].read("Present Position")) for place in first
        )

    def read_drives(self, index: int) -> tuple[float, ...]:
        """Read the angle [rad] of joint `index` (from 0) from each of its servos, in order; see `read_positions`."""
        return tuple(
            self._measured[place].angle(self._servos[self._drives[place]].read("Present Position"))
            for place, of in enumerate(self._of)
            if of == index
        )

    def exchange(self, goals: Sequence[float], *, between: bool = False) -> State:
        """Send goals, one per joint [A, or V in PWM mode], and return the arm's state.

        between: whether this is an extra exchange between two samples (`Exchange.cycle`).
        A servo that does not reply is marked as missing. Raises PortLost; BusOverheard if packets from another master
        are heard repeatedly; WrongReply if servos repeatedly answer with each other's ID; ValueError for a goal that is
        not a finite number.
        """
        if self._in_pairs and len(goals) == len(self.joints):
            goals = [goals[joint] / self._of.count(joint) for joint in self._of]
        ticks = self._converter.ticks(goals)
        exchange = self._exchange or self.prepared
        reply = exchange.cycle(ticks, between=between)
        self._last_answers = reply.servos
        state = self._converter.state(ticks, reply)
        if (strangers := exchange.heard.strangers) > MOST_STRANGERS:
            raise overheard(f"has sent or requested {strangers} packets")
        if exchange.heard.mixed_up > MOST_MIXED_UP:
            raise WrongReply(exchange.heard.mixed_up_advice(self.port.url))
        if not self._in_pairs:
            return state
        if any(error & ALERT for error in state.error):
            self._alerted |= {drive for drive, error in zip(self._drives, state.error, strict=True) if error & ALERT}
        return fold(state, self._of, len(self.joints))

    def first_hides_others(self, patience: float) -> bool:
        """Return whether the first servo is silent although the last one replies. Raises PortLost.

        In a group read, a silent servo prevents all servos listed after it from replying. This method therefore
        reads the last servo before the first. patience: how long to wait for the replies [s].
        """
        drives = (self._drives[-1], self._drives[0])
        read = SyncRead([each.id for each in drives], Span.of([self._servos[each].table for each in drives], ["ID"]))
        expected = self.port.reply_time(patience, len(read.request))
        echo = read.request if self.port.echoes else b""
        received = self.port.ask(read.request, len(echo) + read.reply_size, expected, self.port.clock.now())
        (last, first), _ = read.search(received.removeprefix(echo))
        return last is not None and first is None

    def check_not_overruled(self, due: float) -> None:
        """Check that the servos hold this program's goals and modes, if there is time before `due` [s].

        Raises PortLost; BusShared if another master has written to a servo.
        """
        if (found := self.prepared.overruled(due)) is not None:
            raise overruled(self._drives[found.place], found)

    @property
    def watchdog_changed(self) -> tuple[int, int] | None:
        """Index of a joint whose Bus Watchdog had changed when it was last read back, and the value read [20 ms]; None
        if there is no such joint.

        A tripped watchdog does not count as changed, since a pause between this program's packets can also trip it.
        """
        expected = self.armed_ticks, WATCHDOG_TRIPPED
        for place, ticks in self.prepared.watchdogs:
            if ticks not in expected and self._drives[place] in self._armed:
                return self._of[place], ticks
        return None

    @property
    def torque_lost(self) -> int | None:
        """Index of a joint whose Torque Enable was last read back as 0; None if there is none."""
        place = self.prepared.torque_off
        return None if place is None else self._of[place]

    def read_torque(self) -> int | None:
        """Read Torque Enable of all servos now, before torque is cut; then return `torque_lost`."""
        self.prepared.read_torque()
        return self.torque_lost

    @property
    def goals_lost(self) -> tuple[int, str] | None:
        """Index of a joint that has missed many of the latest goals, and a description of the value read back; None if
        there is no such joint.
        """
        if (lost := self.prepared.lost) is None:
            return None
        return self._of[lost.place], f"its {lost.register} reads {lost.value} but {lost.written} was written"

    @property
    def modes_seen_ago(self) -> float:
        """Time since all servos were last confirmed to be in their modes [s]; infinite if they never were."""
        return self.prepared.modes_seen_ago

    @property
    def heard_instead(self) -> str:
        """Advice on irregular replies and other bytes received in the last 0.1 s; "" if there were none."""
        return self.prepared.heard.advice(self.port.clock.now(), self.port.url)

    @property
    def commanded_by_another(self) -> str:
        """Sentence about a value that was recently read back but not written by this program; "" if there is none.

        One such value does not prove that there is another master: a servo that misses writes holds an older goal.
        """
        seen = self.prepared.sighted
        if seen is None:
            return ""
        # A tripped watchdog or a reboot also leaves 0.
        who = ": another program is commanding it, or writes are being lost" if seen.value else ""
        return (
            f"Shortly before this, {seen.register} of {self._drives[seen.place].title} was {seen.value} although "
            f"{seen.written} had been written{who}."
        )

    def bear_others(self) -> None:
        """Stop raising BusOverheard for packets from another master; its writes to servos are still detected."""
        self.prepared.heard.strangers = -math.inf

    def read_status_next(self) -> None:
        """Read the servos' status in the next exchange, if the status is read at all."""
        self.prepared.read_status_next()

    def check_alerts(self, state: State) -> None:
        """Read the hardware error of every servo whose alert bit is set; raises one ServoFault for all of them."""
        raised = [joint for joint, error in zip(self.joints, state.error, strict=True) if error & ALERT]
        faults = [text for joint in raised if (text := self._faults(joint))]
        if faults:
            raise ServoFault(" ".join(faults))

    def _faults(self, joint: Joint) -> str:
        """Describe the faults of a joint's servos after one of them has set its alert bit."""
        alone = len(joint.drives) == 1
        texts = [self._fault(drive, its_own=alone or drive in self._alerted) for drive in joint.drives]
        return " ".join(filter(None, texts))


def _knows_fast_sync_read(joint: Joint, servo: Servo) -> bool:
    needed = joint.servo.fast_sync_read_firmware
    return needed is not None and servo.read("Firmware Version") >= needed
