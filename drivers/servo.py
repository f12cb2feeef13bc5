"""One servo on a port, for set-up work: pings, and register reads and writes by name, with up to three attempts each.

Everything goes through the packet handler of `dynamixel-sdk`. Writes are read back, because a status packet only
confirms that the instruction was understood, and does not show what the register now holds.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from dynamixel_sdk import COMM_RX_CORRUPT, COMM_RX_TIMEOUT, COMM_SUCCESS

from hil.drivers.control_table import ControlTable, Register
from hil.drivers.errors import InconsistentReplies, NoReply, ServoRefused, WrongReply
from hil.drivers.packet import ALERT, HardwareError, Instruction, StatusError
from hil.drivers.port import Port
from hil.drivers.sdk_port import PATIENCE_S, ResyncingPacketHandler, SdkPort

_T = TypeVar("_T")

_ATTEMPTS = 3
"""Number of attempts at a set-up exchange before a corrupted or missing reply is reported."""


_SURE_ATTEMPTS = 3
"""Number of attempts at a reading that must be confirmed by a second one."""

_LATE_S = 0.06
"""How long after a timed-out exchange its reply may still arrive [s]."""

_DATA = 9
"""Index of the first data byte in a status packet."""

LATE = (
    "Replies did arrive, but too late: check the adapter's latency timer, the USB hub and whether other programs keep "
    "the computer busy."
)

NO_ERROR = "none"
"""Result of `describe_error` if there is no error."""

_BESIDE_DATA = 4
"""Number of bytes that LEN counts in addition to the data: INST, ERR, CRC."""


class Servo:
    """A servo addressed by its ID. `title` begins its error messages, e.g. "Joint 'elbow' (ID 2, XM430-W350)"."""

    def __init__(self, port: Port, servo_id: int, table: ControlTable, title: str = "") -> None:
        self.port = port
        self.id = servo_id
        self.table = table
        self.answered_pings_only = False
        """Whether `let_answer` was needed."""
        self.title = title or f"The {table.model} with ID {servo_id}"
        self._sdk_port = SdkPort(port)
        self._sdk = ResyncingPacketHandler()

    def ping(self, attempts: int = _ATTEMPTS) -> int:
        """Return the model number reported at this ID; raises NoReply, WrongReply, PortLost."""

        def ask() -> tuple[int, int, int]:
            number, result, error = self._sdk.ping(self._sdk_port, self.id)
            return number, result, error

        return self._try("ping", ask, attempts)

    def read(self, register: str, attempts: int = _ATTEMPTS) -> int:
        """Return the value of a register in ticks; raises NoReply, WrongReply, ServoRefused, PortLost."""
        return self.read_entry(self.table[register], attempts)

    def read_despite_error(self, register: str, attempts: int = _ATTEMPTS) -> int:
        """Read a register like `read`, but also accept a reply that contains the value and reports an error."""
        return self.read_entry(self.table[register], attempts, despite_error=True)

    def read_surely(self, register: str) -> int:
        """Read a register twice like `read_despite_error`, reading the servo's ID in between, until the readings agree.

        A reply does not identify its register: a late reply, or one that another device repeats, may belong to an
        earlier request. Raises InconsistentReplies if the readings never agree, and the errors of `read`.
        """
        for _ in range(_SURE_ATTEMPTS):
            first = self.read_despite_error(register)
            is_its_own = self.read_despite_error("ID") == self.id
            if is_its_own and self.read_despite_error(register) == first:
                return first
        raise InconsistentReplies(
            f"{self.title}: {register} reads differently each time: its replies are late or repeated and belong to "
            "earlier requests. Check the adapter."
        )

    def read_entry(self, entry: Register, attempts: int = _ATTEMPTS, *, despite_error: bool = False) -> int:
        """Read a register that need not be in the model's table. Raises the errors of `read`.

        despite_error: also accept a reply that contains the value and reports an error.
        """

        def ask() -> tuple[list[int], int, int]:
            # The SDK's own readTxRx accepts the first bytes of any reply, including a late one to another request.
            request = [
                0,
                0,
                0,
                0,
                self.id,
                7,
                0,
                Instruction.READ,
                *_two_bytes(entry.address),
                *_two_bytes(entry.size),
                0,
                0,
            ]
            packet, result, error = self._sdk.txRxPacket(self._sdk_port, request)
            if result != COMM_SUCCESS:
                return [], result, error
            data = packet[_DATA : _DATA + (packet[5] | packet[6] << 8) - _BESIDE_DATA]
            if len(data) != entry.size and not error & ~ALERT:
                return [], COMM_RX_CORRUPT, error
            if despite_error and len(data) == entry.size:
                error = 0
            return data, result, error

        return entry.decode(bytes(self._try(f"reading {entry.name}", ask, attempts, is_read=True)))

    def write(self, register: str, value: int, attempts: int | None = None) -> None:
        """Write a register and read it back. Raises the errors of `read`, and ServoRefused if the register then holds a
        different value.

        attempts: maximum number of attempts, for the write and for the read separately; by default, the same number as
        for all set-up work.
        """
        self._write_and_read_back(register, value, attempts, despite_error=False)

    def write_despite_error(self, register: str, value: int) -> None:
        """Write a register like `write`, but ignore errors reported in replies if the value reads back as written.

        A write that makes an arm safe or restores it must not fail just because a servo that obeys also reports an
        error.
        """
        self._write_and_read_back(register, value, None, despite_error=True)

    def write_once(self, register: str, value: int) -> None:
        """Write a register like `write_despite_error`, but try only once. If the write itself is not answered, send
        nothing more and raise NoReply.
        """
        with suppress(ServoRefused):
            self.write_only(register, value, attempts=1)
        actual = self.read_entry(self.table[register], attempts=1, despite_error=True)
        if actual != value:
            raise _not_held(self.title, register, value, actual)

    def _write_and_read_back(self, register: str, value: int, attempts: int | None, *, despite_error: bool) -> None:
        attempts = _ATTEMPTS if attempts is None else attempts
        for left in reversed(range(attempts if despite_error else 1)):
            try:
                self._write_and_compare(register, value, attempts, despite_error=despite_error)
                break
            except ServoRefused:
                if not left:
                    raise

    def _write_and_compare(self, register: str, value: int, attempts: int, *, despite_error: bool) -> None:
        refused: ServoRefused | None = None
        try:
            # The status packet may be lost or switched off (Status Return Level 1); what counts is the register's
            # value.
            with suppress(NoReply):
                self.write_only(register, value, attempts)
        except ServoRefused as error:
            if not despite_error:
                raise
            refused = error
        actual = self.read_entry(self.table[register], attempts, despite_error=despite_error)
        if actual != value:
            raise refused or _not_held(self.title, register, value, actual)

    def write_only(self, register: str, value: int, attempts: int = _ATTEMPTS) -> None:
        """Write a register without reading it back, as necessary for ID and Baud Rate. Raises the errors of `read`."""
        entry = self.table[register]
        data = list(entry.encode(value))

        def send() -> tuple[None, int, int]:
            result, error = self._sdk.writeTxRx(self._sdk_port, self.id, entry.address, entry.size, data)
            return None, result, error

        self._try(f"writing {value} to {register}", send, attempts)

    def let_answer(self) -> None:
        """Set Status Return Level to 2 if the servo answers pings but not reads, as at level 0. Raises the errors of
        `ping` and `read`.
        """
        self.ping(attempts=1)
        with suppress(NoReply):
            self.read("Status Return Level", attempts=2)
            return  # it was silent for another reason, for example because it was booting
        with suppress(NoReply):
            self.write_only("Status Return Level", 2, attempts=1)
        self.answered_pings_only = True

    def hardware_error(self) -> HardwareError:
        """Return the Hardware Error Status, the reason for a raised alert bit. Raises the errors of `read`."""
        return HardwareError(self.read("Hardware Error Status"))

    def _try(
        self, what: str, action: Callable[[], tuple[_T, int, int]], attempts: int = _ATTEMPTS, *, is_read: bool = False
    ) -> _T:
        """Run one SDK exchange until it succeeds, at most `attempts` times; turn result codes into exceptions."""
        late, others = False, set[int]()
        late_before = self.port.late_replies
        for left in reversed(range(attempts)):
            self._sdk.heard = -1
            self._sdk_port.patience = PATIENCE_S * self.port.growth ** (attempts - 1 - left)
            value, result, error = action()
            others.add(self._sdk.heard)
            refused = error & ~ALERT
            if result == COMM_SUCCESS and not (is_read and refused) and refused != StatusError.CRC:
                break  # refused reads and damaged requests are tried again: the servo has done nothing
            late = late or result == COMM_RX_TIMEOUT
            if left == 1 and result != COMM_RX_TIMEOUT and is_read:
                # A busy computer delivers replies late and in pieces, which are then discarded before the last attempt.
                self.port.clock.wait_until(self.port.clock.now() + _LATE_S)
        if late and result == COMM_SUCCESS:
            # Late replies to the requests that timed out may still arrive and would be taken for the next reply.
            self.port.clock.wait_until(self.port.clock.now() + _LATE_S)
            self._sdk_port.clearPort()
        if result == COMM_RX_TIMEOUT and len(others) == 1 and (other := others.pop()) not in (-1, self.id):
            raise NoReply(
                f"Requests to {self.title} are answered by ID {other} ({what}): the servos' IDs or replies "
                "are mixed up. Check that every servo has its own ID, and whether a device on the bus changes replies."
            )
        if result == COMM_RX_TIMEOUT:
            check = f"{LATE} If that does not help, check" if self.port.late_replies > late_before else "Check"
            raise NoReply(
                f"{self.title} does not answer at {self.port.baud} baud on {self.port.url} ({what}). {check} its "
                "supply and its cable; `hil scan` shows whether it has another ID or baud rate."
            )
        if result != COMM_SUCCESS:
            text = self._sdk.getTxRxResult(result).removeprefix("[TxRxResult] ").rstrip("!. ").lower()
            raise WrongReply(
                f"{self.title}: {what} failed: the reply is corrupted or does not match the request ({text}). Check "
                f"its cable and supply, and look for a second servo with ID {self.id}. Replies may also have come too "
                "late because other programs keep this computer busy; if so, close them and try again."
            )
        if refused == StatusError.CRC:
            raise ServoRefused(
                f"{self.title} receives damaged requests ({what}): check its cable, its supply and the adapter, and "
                "whether a second device sends at the same time.",
                refused,
            )
        if refused:
            raise ServoRefused(f"{self.title} refused {what}: {describe_status_error(refused)}.", refused)
        return value


def _two_bytes(value: int) -> tuple[int, int]:
    return value & 0xFF, value >> 8


def describe_error(error: HardwareError) -> str:
    """Return a description of hardware errors, e.g. "overload, overheating"."""
    known = [bit.name.replace("_", " ").lower() for bit in HardwareError if bit in error and bit.name]
    rest = int(error) & ~sum(HardwareError)
    return ", ".join(known + ([f"unknown bits {rest:#04x}"] if rest else [])) or NO_ERROR


def _not_held(title: str, register: str, value: int, actual: int) -> ServoRefused:
    return ServoRefused(
        f"{title}: {register} was written as {value} but reads back as {actual}. Another program is writing to this "
        "servo, or the servo does not obey: end that program, or power-cycle the servo."
    )


def describe_status_error(code: int) -> str:
    """Return a description of a status packet's error number, e.g. "data range error"."""
    try:
        return StatusError(code).name.replace("_", " ").lower() + " error"
    except ValueError:
        return f"error {code}"
