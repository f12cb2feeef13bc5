"""The servos of one arm on one port: set-up work before the control cycle, the cycle, and torque off after it."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import DriverError, ServoFault, ServoRefused, TorqueNotOff, WrongModel, WrongSetting
from hil.drivers.exchange import Exchange
from hil.drivers.hold import let_sink, refuse_held
from hil.drivers.joint import Joint
from hil.drivers.packet import ALERT, BROADCAST_ID, HardwareError, Instruction, encode
from hil.drivers.port import Port, open_port
from hil.drivers.servo import Servo, describe_error
from hil.drivers.servo_model import RETURN_DELAY_UNIT, VOLTAGE_UNIT, WATCHDOG_UNIT, Mode
from hil.drivers.settings import arms_itself
from hil.drivers.state import NAN, Converter, State, spans

TIME_BASED_PROFILE = 0x04
"""Bit of Drive Mode that changes profiles only, which current and PWM mode do not have."""

_PROBES = 3
"""How often Fast Sync Read may stay without an answer before Sync Read is used instead."""


@dataclass(frozen=True)
class BusConfig:
    """Where the servos are and how they are talked to.

    url: device or pyserial URL. one_write: Sync Write and group read leave in one write; False where `hil check` finds
    that an arm needs two. fast_sync_read: use it where every servo's firmware has it. slow_every: cycles from one
    reading of tick or voltage and temperature to the next. watchdog_required: refuse firmware without Bus Watchdog.
    take_over: let an arm that somebody holds sink slowly, then cut its torque; else it is refused.
    """

    url: str
    baud: int
    joints: tuple[Joint, ...]
    one_write: bool = True
    fast_sync_read: bool = True
    slow_every: int = 100
    watchdog_required: bool = True
    take_over: bool = False

    def __post_init__(self) -> None:
        modes = {joint.mode for joint in self.joints}
        if len(modes) != 1:
            raise ValueError(
                "One Sync Write drives all joints, so all must be in current mode or all in PWM mode: "
                + ", ".join(f"{joint} is in {joint.mode.name} mode" for joint in self.joints)
            )

    def is_same_arm(self, other: "BusConfig") -> bool:
        """Whether both are the same servos on the same port."""
        return (self.url, self.baud, self.joints) == (other.url, other.baud, other.joints)


@dataclass(frozen=True)
class TorqueOff:
    """How the attempt to cut torque ended: joints read back as off, why the others could not be confirmed, and which of
    all have no Bus Watchdog.
    """

    confirmed: tuple[Joint, ...]
    unconfirmed: tuple[tuple[Joint, str], ...]
    unwatched: frozenset[Joint] = frozenset()

    def __str__(self) -> str:
        if not self.unconfirmed:
            return f"Torque is off on all {len(self.confirmed)} servos, read back."
        names = "; ".join(f"{str(joint).upper()}: {why}" for joint, why in self.unconfirmed)
        alone = [str(joint).upper() for joint, _ in self.unconfirmed if joint in self.unwatched]
        if alone:
            return (
                f"TORQUE OFF IS NOT CONFIRMED for {names} NOTHING STOPS {' AND '.join(alone)}, which has no Bus "
                "Watchdog and may go on with its last current: cut the supply now."
            )
        return (
            f"TORQUE OFF IS NOT CONFIRMED for {names} The Bus Watchdog stops a servo that hears nothing, but cut the "
            "supply before you reach into the arm."
        )


class ServoBus:
    """The servos of an arm on an open port. Use as a context manager; `close` may be called twice.

        with ServoBus.open(BusConfig("/dev/ttyUSB0", 1_000_000, joints)) as bus, bus.torque(watchdog=0.1):
            state = bus.exchange([0.1, 0.0])

    After any error the same object can still send torque off, and `torque_off_report` says whether that succeeded.
    """

    def __init__(self, port: Port, config: BusConfig) -> None:
        self.port = port
        self.config = config
        self.joints = config.joints
        self._servos = {
            joint: Servo(port, joint.id, load_control_table(joint.servo.name), joint.title) for joint in self.joints
        }
        self._exchange: Exchange | None = None
        self._converter = Converter(self.joints, [NAN] * len(self.joints))
        self._without_watchdog: set[Joint] = set()
        self.torque_off_report: TorqueOff | None = None

    @classmethod
    def open(cls, config: BusConfig) -> "ServoBus":
        """Open the port, check who answers and that nobody holds the arm, bring every servo into its mode.

        Raises PortNotOpened, NoReply, WrongModel, ServoFault, WrongSetting, TorqueHeld; the port is closed then.
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
        """Open the port and send nothing, for set-up work; raises PortNotOpened."""
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
        """The joint's servo, for reading and writing registers."""
        return self._servos[joint]

    def check_identity(self) -> None:
        """Ping every servo and compare its model and firmware with the configuration; raises NoReply, WrongModel."""
        for joint, servo in self._servos.items():
            number = servo.ping()
            if number != servo.table.number:
                found = model_names().get(number, f"model number {number}")
                raise WrongModel(
                    f"{joint.title}: a {found} answers at ID {joint.id}, where the configuration has a "
                    f"{joint.servo.name}. Correct `model` or `id` in the configuration, or change the servo's ID."
                )
            firmware = servo.read("Firmware Version")
            if firmware < joint.servo.watchdog_firmware:
                self._no_watchdog(joint, firmware)

    def _no_watchdog(self, joint: Joint, firmware: int) -> None:
        if self.config.watchdog_required:
            raise WrongModel(
                f"{joint.title}: firmware {firmware} has no Bus Watchdog; {joint.servo.watchdog_firmware} or newer is "
                "needed. Update it with DYNAMIXEL Wizard 2.0. With safety.allow_no_watchdog = true it is accepted, but "
                "then nothing stops this servo when the program is killed or the cable is pulled."
            )
        self._without_watchdog.add(joint)

    def release_held(self, ours: Collection[Joint] = ()) -> None:
        """See to it that no servo has torque before anything is written: raises TorqueHeld, or with
        `BusConfig.take_over` lets the arm sink. ours: joints that a program of this user left behind, cut at once.
        """
        for joint in ours:
            if self._servos[joint].read("Torque Enable"):
                self._servos[joint].write("Torque Enable", 0)
        if self.config.take_over:
            let_sink(self._servos, self.port.clock)
        refuse_held(self._servos)

    def prepare(self) -> None:
        """Bring every servo into its mode with torque off, and prepare the exchange.

        Raises ServoFault, and WrongSetting where a register forbids an experiment and changing it is the user's
        decision.
        """
        self.port.lower_latency()
        for joint, servo in self._servos.items():
            _prepare_servo(joint, servo)
        supply = [VOLTAGE_UNIT * servo.read("Present Input Voltage") for servo in self._servos.values()]
        units = [joint.drive_unit(voltage) for joint, voltage in zip(self.joints, supply, strict=True)]
        self._converter = Converter(self.joints, units)
        one_write = self.config.one_write
        fast = self.config.fast_sync_read and self.knows_fast_sync_read()
        exchange = self.make_exchange(fast=fast, one_write=one_write)
        nothing = [0] * len(self.joints)
        if fast and all(None in exchange.cycle(nothing).servos for _ in range(_PROBES)):
            exchange = self.make_exchange(fast=False, one_write=one_write)
        self._exchange = exchange

    def knows_fast_sync_read(self) -> bool:
        """Whether every servo's firmware has Fast Sync Read."""
        return all(_knows_fast_sync_read(joint, servo) for joint, servo in self._servos.items())

    def make_exchange(self, *, fast: bool, one_write: bool, slow_every: int | None = None) -> Exchange:
        """An exchange with these servos, sent one way or the other; reads their Return Delay Times first."""
        servos = self._servos.values()
        tables = [servo.table for servo in servos]
        mode = self.joints[0].mode
        return Exchange(
            self.port,
            [servo.id for servo in servos],
            tables[0]["Goal Current" if mode is Mode.CURRENT else "Goal PWM"],
            spans(mode, tables),
            max(RETURN_DELAY_UNIT * servo.read("Return Delay Time") for servo in servos),
            fast=fast,
            one_write=one_write,
            slow_every=slow_every or self.config.slow_every,
        )

    @property
    def prepared(self) -> Exchange:
        """The prepared exchange; raises RuntimeError before `prepare`."""
        if self._exchange is None:
            raise RuntimeError("ServoBus.prepare has not been called")
        return self._exchange

    def read_positions(self) -> tuple[float, ...]:
        """Every joint's angle [rad], by set-up reads."""
        return tuple(joint.angle(servo.read("Present Position")) for joint, servo in self._servos.items())

    def exchange(self, goals: Sequence[float]) -> State:
        """Send goals, one per joint [A, or V under PWM], and read the arm's state.

        A silent servo is marked missing. Raises PortLost; ValueError for a goal that is no number.
        """
        ticks = self._converter.ticks(goals)
        exchange = self._exchange or self.prepared
        return self._converter.state(ticks, exchange.cycle(ticks))

    def check_alerts(self, state: State) -> None:
        """Where a servo raised its alert bit, read the cause; raises ServoFault, which names all of them."""
        faults = [self._fault(joint) for joint, error in zip(self.joints, state.error, strict=True) if error & ALERT]
        if faults:
            raise ServoFault(" ".join(faults))

    def _fault(self, joint: Joint) -> str:
        try:
            cause = describe_error(self._servos[joint].hardware_error())
        except DriverError as error:
            cause = f"unknown, it could not be read ({error})"
        return _fault_text(joint, cause)

    @contextmanager
    def torque(self, watchdog: float) -> Iterator[None]:
        """Torque on inside the block, off after it, however it is left.

        watchdog: seconds without a packet after which a servo stops by itself (20 ms steps, at most 2.54 s).
        Raises TorqueNotOff on leaving when a servo could not be confirmed off; `torque_off_report` tells which.
        """
        self.torque_off_report = None
        try:
            self._torque_on(watchdog)
            yield
        finally:
            report = self.torque_off()
            if report.unconfirmed:
                raise TorqueNotOff(str(report))

    def _torque_on(self, watchdog: float) -> None:
        ticks = round(watchdog / WATCHDOG_UNIT)
        if not 1 <= ticks <= 127:
            raise ValueError(f"watchdog must be 0.02 to 2.54 s, not {watchdog}")
        for joint, servo in self._servos.items():
            watched = joint not in self._without_watchdog
            if watched:
                servo.write("Bus Watchdog", 0)
            # Changing Operating Mode leaves Goal Current at Current Limit.
            servo.write("Goal Current" if joint.mode is Mode.CURRENT else "Goal PWM", 0)
            if watched:
                servo.write("Bus Watchdog", ticks)
        for joint, servo in self._servos.items():
            try:
                servo.write("Torque Enable", 1)
            except ServoRefused:
                if servo.hardware_error() != HardwareError(0):
                    raise ServoFault(self._fault(joint)) from None
                raise

    def torque_off(self) -> TorqueOff:
        """Cut torque on every servo and read it back. Tries all of them whatever fails; never raises.

        After each servo that cannot be confirmed all are told again: it may hear though it cannot answer, and while it
        was asked the others' watchdogs heard packets and waited.
        """
        self._torque_off_at_once()
        confirmed, unconfirmed = [], []
        for joint, servo in self._servos.items():
            try:
                servo.write("Torque Enable", 0)
            except Exception as error:  # whatever one servo does, the next must be tried
                unconfirmed.append((joint, str(error) or type(error).__name__))
                self._torque_off_at_once()
            else:
                confirmed.append(joint)
        for joint in confirmed:
            if joint not in self._without_watchdog:
                with suppress(DriverError):
                    self._servos[joint].write("Bus Watchdog", 0)
        self.torque_off_report = TorqueOff(tuple(confirmed), tuple(unconfirmed), frozenset(self._without_watchdog))
        return self.torque_off_report

    def _torque_off_at_once(self) -> None:
        """To all servos of the arm at once, which takes 0.3 ms; confirming takes some ms each, and 0.1 s where one is
        silent. A Sync Write, since what else is on the bus may be held by somebody. Twice, since a packet may be lost.
        """
        entry = self._servos[self.joints[0]].table["Torque Enable"]
        body = entry.address.to_bytes(2, "little") + entry.size.to_bytes(2, "little")
        body += b"".join(bytes((joint.id, 0)) for joint in self.joints)
        # Where this fails, the confirmed writes will say so.
        with suppress(DriverError):
            self.port.write(2 * encode(BROADCAST_ID, Instruction.SYNC_WRITE, body))


def _prepare_servo(joint: Joint, servo: Servo) -> None:
    servo.write("Torque Enable", 0)
    fault = servo.hardware_error()
    if fault != HardwareError(0):
        raise ServoFault(_fault_text(joint, describe_error(fault)))
    drive_mode = servo.read("Drive Mode")
    if drive_mode & ~TIME_BASED_PROFILE:
        raise WrongSetting(
            f"{joint.title}: Drive Mode is {drive_mode}, 0 is needed (no reverse, no torque on by goal). "
            "Set it to 0 with DYNAMIXEL Wizard 2.0; use `direction = -1` for a joint that turns the other way."
        )
    if arms_itself(servo):
        raise WrongSetting(
            f"{joint.title}: Startup Configuration turns its torque on by itself whenever it is switched on or "
            "reboots. Set that register to 0 with DYNAMIXEL Wizard 2.0."
        )
    if servo.read("Operating Mode") != joint.mode:
        servo.write("Operating Mode", joint.mode)
    if servo.read("Bus Watchdog"):
        servo.write("Bus Watchdog", 0)  # goals are read-only while it is tripped
    # Goal PWM limits the output in current mode too; what another program left there may be nothing.
    if joint.mode is Mode.CURRENT and servo.read("Goal PWM") != servo.read("PWM Limit"):
        servo.write("Goal PWM", servo.read("PWM Limit"))


def _fault_text(joint: Joint, cause: str) -> str:
    return (
        f"{joint.title} raised its alert, hardware error: {cause}. It stays without torque until it is rebooted: "
        "find the cause, then switch its supply off and on."
    )


def _knows_fast_sync_read(joint: Joint, servo: Servo) -> bool:
    needed = joint.servo.fast_sync_read_firmware
    return needed is not None and servo.read("Firmware Version") >= needed
