"""The servos of one arm on one port: set-up work before the control cycle, and torque off after it.

Set-up goes through `dynamixel-sdk`'s packet handler on our port; every register that matters for safety is read back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, PacketHandler

from drivers.control_table import load_control_table, model_names
from drivers.errors import (
    DriverError,
    NoReply,
    ServoRefused,
    TorqueNotOff,
    WrongModel,
    WrongReply,
    WrongSetting,
)
from drivers.exchange import Exchange
from drivers.joint import Joint
from drivers.packet import ALERT, BROADCAST_ID, HardwareError, Instruction, StatusError, encode
from drivers.port import Port, SdkPort
from drivers.servo_model import WATCHDOG_UNIT

_T = TypeVar("_T")

CURRENT_MODE = 0
_ATTEMPTS = 3
"""How often a set-up exchange is tried before a damaged or missing reply is believed."""


class State(NamedTuple):
    """One sample of the arm in SI units; NaN where a servo did not answer.

    time_before_write, time_after_read: s on the port's clock. goal_current: what was sent, a whole number of ticks,
    and current: what the servo measured [A]; velocity [rad/s]; position [rad]; error: the ERR bytes, 0 where missing.
    """

    time_before_write: float
    time_after_read: float
    goal_current: tuple[float, ...]
    current: tuple[float, ...]
    velocity: tuple[float, ...]
    position: tuple[float, ...]
    error: tuple[int, ...]
    missing: tuple[bool, ...]


@dataclass(frozen=True)
class TorqueOff:
    """How the attempt to cut torque ended: joints read back as off, and why the others could not be confirmed."""

    confirmed: tuple[Joint, ...]
    unconfirmed: tuple[tuple[Joint, str], ...]

    def __str__(self) -> str:
        if not self.unconfirmed:
            return f"Torque is off on all {len(self.confirmed)} servos, read back."
        names = "; ".join(f"{joint}: {why}" for joint, why in self.unconfirmed)
        return (
            f"TORQUE OFF IS NOT CONFIRMED for {names}. The Bus Watchdog stops a servo that hears nothing, but cut the "
            "supply before you reach into the arm."
        )


class ServoBus:
    """The servos of an arm on an open port. Use as a context manager; `close` may be called twice."""

    def __init__(self, port: Port, joints: Sequence[Joint]) -> None:
        self.port = port
        self.joints = tuple(joints)
        self._tables = {joint: load_control_table(joint.servo.name) for joint in self.joints}
        self._sdk_port = SdkPort(port)
        self._sdk = PacketHandler(2.0)
        self._exchange: Exchange | None = None
        self.torque_off_report: TorqueOff | None = None

    @classmethod
    def open(cls, url: str, baud: int, joints: Sequence[Joint]) -> ServoBus:
        """Open the port; raises PortNotOpened. Nothing is sent yet."""
        port = Port(url, baud)
        try:
            return cls(port, joints)
        except BaseException:
            port.close()
            raise

    def __enter__(self) -> ServoBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.port.close()

    def read(self, joint: Joint, register: str) -> int:
        """The value of a register, in ticks; raises NoReply, WrongReply, ServoRefused, PortLost."""
        entry = self._tables[joint][register]

        def ask() -> tuple[list[int], int, int]:
            data, result, error = self._sdk.readTxRx(self._sdk_port, joint.id, entry.address, entry.size)
            return data, result, error

        return entry.decode(bytes(self._try(joint, f"reading {register}", ask)))

    def write(self, joint: Joint, register: str, value: int) -> None:
        """Write a register and read it back; raises as `read`, and ServoRefused when it reads back otherwise."""
        entry = self._tables[joint][register]
        data = list(entry.encode(value))

        def send() -> tuple[None, int, int]:
            result, error = self._sdk.writeTxRx(self._sdk_port, joint.id, entry.address, entry.size, data)
            return None, result, error

        self._try(joint, f"writing {value} to {register}", send)
        actual = self.read(joint, register)
        if actual != value:
            raise ServoRefused(f"{_title(joint)}: {register} was written as {value} but reads back as {actual}.")

    def ping(self, joint: Joint) -> int:
        """The model number that answers at the joint's ID; raises as `read`."""

        def ask() -> tuple[int, int, int]:
            number, result, error = self._sdk.ping(self._sdk_port, joint.id)
            return number, result, error

        return self._try(joint, "ping", ask)

    def check_identity(self) -> None:
        """Ping every servo and compare its model and firmware with the configuration; raises NoReply, WrongModel."""
        for joint in self.joints:
            number = self.ping(joint)
            if number != self._tables[joint].number:
                found = model_names().get(number, f"model number {number}")
                raise WrongModel(
                    f"{_title(joint)}: a {found} answers at ID {joint.id}, where the configuration has a "
                    f"{joint.servo.name}. Correct `model` or `id` in the configuration, or change the servo's ID."
                )
            firmware = self.read(joint, "Firmware Version")
            if firmware < joint.servo.watchdog_firmware:
                raise WrongModel(
                    f"{_title(joint)}: firmware {firmware} has no Bus Watchdog; {joint.servo.watchdog_firmware} or "
                    "newer is needed. Update it with DYNAMIXEL Wizard 2.0."
                )

    def prepare(self) -> None:
        """Bring every servo into current mode with torque off, and prepare the exchange.

        Raises WrongSetting where a register forbids an experiment and changing it is the user's decision.
        """
        delays = []
        for joint in self.joints:
            self.write(joint, "Torque Enable", 0)
            fault = self.read(joint, "Hardware Error Status")
            if fault:
                raise WrongSetting(
                    f"{_title(joint)} reports {HardwareError(fault)!r}; it stays without torque until it is rebooted. "
                    "Find the cause, then switch the supply off and on."
                )
            drive_mode = self.read(joint, "Drive Mode")
            if drive_mode:
                raise WrongSetting(
                    f"{_title(joint)}: Drive Mode is {drive_mode}, 0 is needed (no reverse, no torque on by goal). "
                    "Set it to 0 with DYNAMIXEL Wizard 2.0; use `direction = -1` for a joint that turns the other way."
                )
            if self.read(joint, "Operating Mode") != CURRENT_MODE:
                self.write(joint, "Operating Mode", CURRENT_MODE)
            delays.append(2e-6 * self.read(joint, "Return Delay Time"))
        self._exchange = Exchange(
            self.port,
            [joint.id for joint in self.joints],
            [self._tables[joint] for joint in self.joints],
            max(delays),
        )

    @property
    def exchange_timing(self) -> Exchange:
        """The prepared exchange; raises RuntimeError before `prepare`."""
        if self._exchange is None:
            raise RuntimeError("ServoBus.prepare has not been called")
        return self._exchange

    def read_positions(self) -> tuple[float, ...]:
        """Every joint's angle [rad], by set-up reads."""
        return tuple(joint.angle(self.read(joint, "Present Position")) for joint in self.joints)

    def exchange(self, goal_current: Sequence[float]) -> State:
        """Send goal currents [A], one per joint, and read the arm's state. Raises PortLost, ValueError on NaN."""
        joints = self.joints
        ticks = [joint.current_ticks(goal) for joint, goal in zip(joints, goal_current, strict=True)]
        before, after, replies = self.exchange_timing.cycle(ticks)
        sent = tuple([joint.current_unit * tick for joint, tick in zip(joints, ticks, strict=True)])
        current, velocity, position, error, missing = [], [], [], [], []
        for joint, reply in zip(joints, replies, strict=True):
            if reply is None:
                current.append(_NAN)
                velocity.append(_NAN)
                position.append(_NAN)
                error.append(0)
            else:
                current.append(reply.current_ticks * joint.current_unit)
                velocity.append(reply.velocity_ticks * joint.velocity_unit)
                position.append((reply.position_ticks - joint.zero_ticks) * joint.position_unit)
                error.append(reply.error)
            missing.append(reply is None)
        return State(
            before,
            after,
            sent,
            tuple(current),
            tuple(velocity),
            tuple(position),
            tuple(error),
            tuple(missing),
        )

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
        for joint in self.joints:
            self.write(joint, "Bus Watchdog", 0)
            # Changing Operating Mode leaves Goal Current at Current Limit.
            self.write(joint, "Goal Current", 0)
            self.write(joint, "Bus Watchdog", ticks)
        for joint in self.joints:
            self.write(joint, "Torque Enable", 1)

    def torque_off(self) -> TorqueOff:
        """Cut torque on every servo and read it back. Tries all of them whatever fails; never raises DriverError."""
        self._broadcast_torque_off()
        confirmed, unconfirmed = [], []
        for joint in self.joints:
            try:
                self.write(joint, "Torque Enable", 0)
            except DriverError as error:
                unconfirmed.append((joint, str(error)))
            else:
                confirmed.append(joint)
                with suppress(DriverError):
                    self.write(joint, "Bus Watchdog", 0)
        self.torque_off_report = TorqueOff(tuple(confirmed), tuple(unconfirmed))
        return self.torque_off_report

    def _broadcast_torque_off(self) -> None:
        """One packet to all servos first: it takes 0.2 ms, the confirmed writes after it some ms each."""
        entry = self._tables[self.joints[0]]["Torque Enable"]
        body = entry.address.to_bytes(2, "little") + b"\x00"
        try:
            self.port.write(encode(BROADCAST_ID, Instruction.WRITE, body))
        except DriverError:
            return  # the confirmed writes will say so

    def _try(self, joint: Joint, what: str, action: Callable[[], tuple[_T, int, int]]) -> _T:
        """Run one SDK exchange until it succeeds, at most `_ATTEMPTS` times; turn result codes into exceptions."""
        for _ in range(_ATTEMPTS):
            value, result, error = action()
            if result == COMM_SUCCESS:
                break
        if result == COMM_RX_TIMEOUT:
            raise NoReply(
                f"{_title(joint)} does not answer at {self.port.baud} baud on {self.port.url} ({what}). Check its "
                "supply, its cable, its ID and its baud rate."
            )
        if result != COMM_SUCCESS:
            text = self._sdk.getTxRxResult(result)
            raise WrongReply(f"{_title(joint)}: {what} failed: {text} Do two servos share ID {joint.id}?")
        refused = error & ~ALERT
        if refused:
            raise ServoRefused(f"{_title(joint)} refused {what}: {_status_error(refused)}.")
        return value


_NAN = float("nan")


def _title(joint: Joint) -> str:
    text = str(joint)
    return text[0].upper() + text[1:]


def _status_error(code: int) -> str:
    try:
        return StatusError(code).name.replace("_", " ").lower() + " error"
    except ValueError:
        return f"error {code}"
