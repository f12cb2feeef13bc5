"""Random calls to a fake arm with dynamixel_sdk; every answer is compared with the rules of the manual.

    python -m benchmarks.bus.random_calls --calls 3000 --seed 1

The calls vary registers, lengths, values in and out of range, IDs, torque, operating modes, registered and grouped
instructions, reboots and factory resets. They use the SDK's port on a pseudo-terminal; the rules are in `servo_rules`.
A register is read back after every write, and the whole table after every hundred calls.
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from random import Random
from threading import Thread
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

import dynamixel_sdk as sdk

from benchmarks.bus.servo_rules import (
    ACCESS,
    BAUD,
    FINE,
    SERVO_ID,
    TORQUE_ENABLE,
    XL330_M288,
    XM430_W350,
    Row,
    Rules,
)
from hil.fakes.description import FakeArm, FakeServo, load_fake
from hil.fakes.pty_server import PtyServer
from tests.support.paths import CONFIGS

TABLES = {"XM430-W350": XM430_W350, "XL330-M288": XL330_M288}
NUMBERS = {"XM430-W350": 1020, "XL330-M288": 1200}
SERVOS = (
    (1, "XM430-W350", 48),
    (7, "XL330-M288", 52),
    (9, "XL330-M288", 48),
    (10, "XL330-M288", 46),
    (200, "XM430-W350", 45),
)
INDIRECT_ADDRESS, INDIRECT_SLOTS = 168, 20
KEPT = (SERVO_ID, BAUD, 68)  # registers whose change would break the communication; tested separately
TRIES = 4
BOOT_S = 0.3
WHOLE_EVERY = 100
HARMLESS = (31, 32, 34)  # limits of temperature and voltage: values other than the factory's would shut a servo down
PROTECTED = (12, 98)  # a Secondary ID does not answer, and a Bus Watchdog trips after a while: left out


def indirect_data(model: str, firmware: int) -> int:
    """Address of the first byte of indirect data; it differs for XL330 and XC330 servos with firmware 52."""
    return 208 if model.startswith(("XL330", "XC330")) and firmware == 52 else 224


class Client:
    """Sends calls to one arm through the SDK's port and records every deviation from the rules."""

    def __init__(self, port: Any, seed: int, sleep: Callable[[float], None] = time.sleep) -> None:
        self.port, self.handler, self.sleep = port, sdk.PacketHandler(2.0), sleep
        self.random = Random(seed)
        self.models = {servo_id: model for servo_id, model, _ in SERVOS}
        self.servos = {servo_id: Rules(TABLES[model], {}) for servo_id, model, _ in SERVOS}
        self.differences: list[str] = []
        self.calls: Counter[str] = Counter()
        self.late = 0

    def ask(self, call: Callable[[], Any]) -> Any:
        """Make a call, and repeat it if no answer arrives in time. Answers may be late because this computer runs both
        ends of the terminal and may be busy.
        """
        for _ in range(TRIES):
            answer = call()
            result = answer if isinstance(answer, int) else answer[-2]
            if result not in (sdk.COMM_RX_TIMEOUT, sdk.COMM_RX_CORRUPT):
                break
            self.late += 1
            self.sleep(0.02)
            self.port.clearPort()
        return answer

    def compare(self, what: str, got: Any, allowed: bool) -> None:
        """Record a difference unless this answer is allowed."""
        self.calls[what.split(" ", maxsplit=1)[0]] += 1
        if not allowed:
            self.differences.append(f"{sum(self.calls.values())}: {what}: {got}")

    def look(self, servo_id: int, row: Row) -> None:
        """Read one register and compare its value with the expected one."""
        data, result, error = self.ask(lambda: self.handler.readTxRx(self.port, servo_id, row.address, row.size))
        self._told(servo_id, row, data, (result, error), "read")

    def _told(self, servo_id: int, row: Row, data: Any, answer: tuple[int, int], how: str) -> None:
        rules = self.servos[servo_id]
        signed = row.low is not None and row.low < 0
        value = int.from_bytes(bytes(data or b""), "little", signed=signed)
        wanted = rules.expected(row.address)
        right = answer == (0, 0) and len(data) == row.size and (wanted is None or wanted == value)
        self.compare(f"{how} {servo_id} {row.address}, expected {wanted}", (value, *answer), right)
        if answer == (0, 0):
            rules.learn(row.address, value)

    def whole(self) -> None:
        """Read every register of every servo."""
        for servo_id, rules in self.servos.items():
            for row in rules.rows.values():
                self.look(servo_id, row)

    def step(self) -> None:
        """Make one random call."""
        kinds: list[tuple[int, Callable[[], None]]] = [
            (30, self.write),
            (8, self.write_neighbours),
            (5, self.write_anything),
            (8, self.reg_write),
            (6, self.action),
            (10, self.torque),
            (6, self.read_anything),
            (6, self.ping),
            (6, self.sync_write),
            (6, self.sync_read),
            (5, self.bulk_read),
            (4, self.indirect),
            (1, self.reboot),
            (1, self.factory_reset),
        ]
        self.random.choices([kind for _, kind in kinds], [weight for weight, _ in kinds])[0]()

    def _servo(self) -> int:
        return self.random.choice(list(self.servos))

    def _row(self, servo_id: int, *, writable: bool = True) -> Row:
        rows = [row for row in self.servos[servo_id].rows.values() if row.address not in (*KEPT, *PROTECTED)]
        return self.random.choice([row for row in rows if row.low is not None or not writable])

    def _value(self, row: Row) -> bytes:
        """A random value, in range three times out of four."""
        low, high = row.low or 0, row.high or 0
        if self.random.random() < 0.75:
            value = self.random.choice((low, high, self.random.randint(low, high), self.random.randint(low, high)))
            if row.address == 11:
                value = self.random.choice((0, 1, 3, 4, 5, 16))
            if row.address in HARMLESS:
                value = row.initial or 0
        else:
            value = self.random.choice((high + 1, low - 1, self.random.getrandbits(8 * row.size)))
            if row.address in HARMLESS and low <= value <= high:
                value = high + 1
        return (value % (1 << 8 * row.size)).to_bytes(row.size, "little")

    def _wrote(
        self, what: str, servo_id: int, address: int, data: bytes, answer: tuple[int, int], may: set[int]
    ) -> None:
        self.compare(
            f"{what} {servo_id} {address} {list(data)}, expected {may}", answer, answer[0] == 0 and answer[1] in may
        )
        rules = self.servos[servo_id]
        for row in list(rules.rows.values()):
            if row.address < address + len(data) and row.span.stop > address and not row.moves:
                self.look(servo_id, row)

    def _write(self, what: str, servo_id: int, address: int, data: bytes) -> None:
        may = self.servos[servo_id].write(address, data)
        answer = self.ask(lambda: self.handler.writeTxRx(self.port, servo_id, address, len(data), list(data)))
        self._wrote(what, servo_id, address, data, answer, may)

    def write(self) -> None:
        servo_id = self._servo()
        row = self._row(servo_id)
        self._write("write", servo_id, row.address, self._value(row))

    def write_neighbours(self) -> None:
        """Write two registers, the second of which begins where the first ends."""
        servo_id = self._servo()
        first = self._row(servo_id)
        second = self.servos[servo_id].rows.get(first.span.stop)
        if second is None or second.address in (*KEPT, *PROTECTED):
            return
        self._write("write_two", servo_id, first.address, self._value(first) + self._value(second))

    def write_anything(self) -> None:
        """Write to read-only registers, gaps, and parts of registers."""
        servo_id = self._servo()
        row = self._row(servo_id, writable=False)
        size = self.random.randint(1, row.size)
        address = self.random.choice((row.address, 3, 40, 75, 96, 148))
        if address != row.address:
            size = 1
        if (row.low is None or size < row.size) or address != row.address:
            may = self.servos[servo_id].write(address, bytes(size))
            answer = self.ask(lambda: self.handler.writeTxRx(self.port, servo_id, address, size, [0] * size))
            self._wrote("write_odd", servo_id, address, bytes(size), answer, may)

    def reg_write(self) -> None:
        servo_id = self._servo()
        row = self._row(servo_id)
        data = self._value(row)
        may = self.servos[servo_id].reg_write(row.address, data)
        answer = self.ask(lambda: self.handler.regWriteTxRx(self.port, servo_id, row.address, row.size, list(data)))
        self.compare(f"reg_write {servo_id} {row.address} {list(data)}, expected {may}", answer, answer[1] in may)
        if FINE in may and len(may) > 1 and answer == (0, 0):
            self.servos[servo_id].waiting = row.address, data
        self.look(servo_id, row)

    def action(self) -> None:
        servo_id = self._servo()
        rules = self.servos[servo_id]
        waiting = rules.waiting
        may = rules.action()
        result, error = self.ask(lambda: self._act(servo_id))
        self.compare(f"action {servo_id} {waiting}, expected {may}", (result, error), result == 0 and error in may)
        if waiting is not None:
            self.look(servo_id, rules.rows[waiting[0]])

    def _act(self, servo_id: int) -> tuple[int, int]:
        """Send Action to one servo and read its answer. The SDK's own call leaves the answer unread, and it would then
        disturb the next call.
        """
        packet = [0] * 10
        packet[4], packet[5], packet[6], packet[7] = servo_id, 3, 0, 5
        self.handler.txPacket(self.port, packet)
        self.port.setPacketTimeout(11)
        received, result = self.handler.rxPacket(self.port, False)
        return result, received[8] if result == 0 else 0

    def torque(self) -> None:
        servo_id, on = self._servo(), self.random.random() < 0.5
        self._write("torque", servo_id, TORQUE_ENABLE, bytes([on]))

    def read_anything(self) -> None:
        """Read any length from any defined register; undefined bytes between registers may have any value."""
        servo_id = self._servo()
        row = self._row(servo_id, writable=False)
        size = self.random.randint(1, 24)
        data, result, error = self.ask(lambda: self.handler.readTxRx(self.port, servo_id, row.address, size))
        right = (result, error) == (0, 0) and len(data) == size
        defined = {byte for other in self.servos[servo_id].rows.values() for byte in other.span}
        if error == ACCESS and not set(range(row.address, row.address + size)) <= defined:
            return  # according to the manual, undefined addresses are refused; servos are known to read them as 0
        for other in self.servos[servo_id].rows.values():
            at = other.address - row.address
            wanted = self.servos[servo_id].expected(other.address)
            if right and at >= 0 and at + other.size <= size and wanted is not None:
                held = wanted % (1 << 8 * other.size)
                right = int.from_bytes(bytes(data[at : at + other.size]), "little") == held
        self.compare(f"read_span {servo_id} {row.address} {size}", (data, result, error), right)

    def ping(self) -> None:
        servo_id = self.random.choice([*self.servos, 33])
        if servo_id in self.servos:
            answer = self.ask(lambda: self.handler.ping(self.port, servo_id))
        else:
            answer = self.handler.ping(self.port, servo_id)
        wanted = (NUMBERS[self.models[servo_id]], 0, 0) if servo_id in self.servos else (0, sdk.COMM_RX_TIMEOUT, 0)
        self.compare(f"ping {servo_id}", answer, answer == wanted)

    def sync_write(self) -> None:
        """Send a group write, which has no answer: each servo accepts or refuses its own value."""
        row = self._row(1)
        group = sdk.GroupSyncWrite(self.port, self.handler, row.address, row.size)
        for servo_id, rules in self.servos.items():
            data = self._value(row)
            group.addParam(servo_id, list(data))
            if rules.rows.get(row.address) == row:
                rules.write(row.address, data)
            else:
                rules.held.pop(row.address, None)
                rules.write(row.address, data)
        self.compare(f"sync_write {row.address}", result := group.txPacket(), result == 0)
        for servo_id, rules in self.servos.items():
            if not row.moves:
                self.look(servo_id, rules.rows[row.address])

    def sync_read(self) -> None:
        row = self._row(1, writable=False)
        group = sdk.GroupSyncRead(self.port, self.handler, row.address, row.size)
        for servo_id in self.servos:
            group.addParam(servo_id)
        fast = self.random.random() < 0.5
        result = self.ask(group.fastSyncRead if fast else group.txRxPacket)
        self.compare(f"sync_read {row.address} fast={fast}", result, result == 0)
        for servo_id, rules in self.servos.items() if result == 0 else ():
            own = rules.rows[row.address]
            data = self._grouped(group, servo_id, row)
            self._told(servo_id, own, data, (result, 0), "sync_read_data")

    def _grouped(self, group: Any, servo_id: int, row: Row) -> bytes:
        """A register's value as the SDK stores it from a grouped read; b"" if the answer had no data."""
        try:
            return int(group.getData(servo_id, row.address, row.size)).to_bytes(row.size, "little")
        except IndexError:
            return b""

    def bulk_read(self) -> None:
        group = sdk.GroupBulkRead(self.port, self.handler)
        rows = {servo_id: self._row(servo_id, writable=False) for servo_id in self.servos}
        for servo_id, row in rows.items():
            group.addParam(servo_id, row.address, row.size)
        fast = self.random.random() < 0.5 and not self._confusing(rows)
        result = self.ask(group.fastBulkRead if fast else group.txRxPacket)
        self.compare(f"bulk_read fast={fast}", result, result == 0)
        for servo_id, row in rows.items() if result == 0 else ():
            data = self._grouped(group, servo_id, row)
            self._told(servo_id, row, data, (result, 0), "bulk_read_data")

    def _confusing(self, rows: Mapping[int, Row]) -> bool:
        """Whether dynamixel_sdk 4.1 misreads this Fast Bulk Read, because another byte of the request equals an ID."""
        sent = [byte for servo_id, row in rows.items() for byte in (servo_id, row.address, 0, row.size, 0)]
        return any(sent.index(servo_id) % 5 for servo_id in rows)

    def indirect(self) -> None:
        """Map a register to indirect addresses, and read and write it through the indirect data."""
        servo_id = self._servo()
        model, firmware = next((model, firmware) for own, model, firmware in SERVOS if own == servo_id)
        data_begins = indirect_data(model, firmware)
        rows = [row for row in self.servos[servo_id].rows.values() if not row.is_eeprom and row.low is not None]
        row = self.random.choice(
            [row for row in rows if row.address not in KEPT and row.limit is None and not row.moves]
        )
        slot = self.random.randint(0, INDIRECT_SLOTS - row.size)
        mapped = b"".join((row.address + byte).to_bytes(2, "little") for byte in range(row.size))
        at = INDIRECT_ADDRESS + 2 * slot
        answer = self.ask(lambda: self.handler.writeTxRx(self.port, servo_id, at, len(mapped), list(mapped)))
        self.compare(f"indirect_map {servo_id} {row.address}", answer, answer == (0, 0))
        value, place = self._value(row), data_begins + slot
        self.look(servo_id, row)
        data, *answer = self.ask(lambda: self.handler.readTxRx(self.port, servo_id, place, row.size))
        held = self.servos[servo_id].expected(row.address)
        got = int.from_bytes(bytes(data or b""), "little", signed=(row.low or 0) < 0)
        self.compare(f"indirect_read {servo_id} {row.address}, expected {held}", (got, *answer), got == held)
        may = self.servos[servo_id].write(row.address, value)
        answer = self.ask(lambda: self.handler.writeTxRx(self.port, servo_id, place, row.size, list(value)))
        if row.size > 1 and answer[1]:  # refused: the manual does not say which of the bytes have been stored
            self.servos[servo_id].held.pop(row.address, None)
        self.compare(f"indirect_write {servo_id} {row.address} {list(value)}, expected {may}", answer, answer[1] in may)
        self.look(servo_id, row)

    def reboot(self) -> None:
        servo_id = self._servo()
        answer = self.ask(lambda: self.handler.reboot(self.port, servo_id))
        self.compare(f"reboot {servo_id}", answer, answer == (0, 0))
        self.sleep(BOOT_S)
        self.servos[servo_id].reboot()

    def factory_reset(self) -> None:
        servo_id = self._servo()
        answer = self.handler.factoryReset(self.port, servo_id, 2)  # everything but ID and baud
        self.compare(f"factory_reset {servo_id}", answer, answer == (0, 0))
        self.sleep(BOOT_S)
        self.servos[servo_id].factory_reset((SERVO_ID, BAUD))


def servos() -> FakeArm:
    """Servos of two models and several firmwares, each with its own joint."""
    arm = load_fake(CONFIGS / "fake_pendulum.toml")
    several = tuple(
        FakeServo(id=servo_id, model=model, firmware=firmware, zero_ticks=2048, baud=1_000_000)
        for servo_id, model, firmware in SERVOS
    )
    joints = [] if arm.arm is None else [arm.arm.model_dump()] * len(several)
    plant = {"arm": None, "plant": "hil.fakes.plants.independent:make_plant", "plant_options": {"joints": joints}}
    return arm.model_copy(update={"servos": several, **plant})


@contextmanager
def sdk_port() -> Iterator[Any]:
    """The SDK's own port, open on a pseudo-terminal with emulated servos."""
    with PtyServer(servos()) as server:
        thread = Thread(target=server.serve, daemon=True)
        thread.start()
        port = sdk.PortHandler(server.path)
        try:
            if not (port.openPort() and port.setBaudRate(1_000_000)):
                raise SystemExit(f"{server.path} cannot be opened.")
            yield port
        finally:
            port.closePort()
            server.stop()
            thread.join(10.0)


def call(client: Client, calls: int) -> None:
    """Make this many random calls."""
    client.whole()
    for number in range(calls):
        client.step()
        if number % WHOLE_EVERY == WHOLE_EVERY - 1:
            client.whole()


def main() -> None:
    """Make the calls, compare the answers, and print the differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--calls", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    with sdk_port() as port:
        client = Client(port, chosen.seed)
        call(client, chosen.calls)
    found, calls, late = client.differences, client.calls, client.late
    if chosen.json:
        print(json.dumps({"calls": sum(calls.values()), "by_kind": calls, "repeated": late, "differences": found}))
    else:
        print("\n".join(found[:100]))
        print(f"{len(found)} of {sum(calls.values())} answers differ, {late} came too late: {dict(calls)}")
    raise SystemExit(bool(found))


if __name__ == "__main__":
    main()
