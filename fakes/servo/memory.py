"""The bytes of one control table, read and written in ranges, including through indirect addresses."""

from collections.abc import Iterator

from hil.drivers.packet import StatusError
from hil.fakes.servo.registers import EmulatedModel, Register


class Memory:
    """Registers as bytes. `hil.fakes.servo.servo` decides which writes are permitted and what effects they have."""

    def __init__(self, model: EmulatedModel) -> None:
        self.registers = model.registers
        self.data = bytearray(max(r.address + r.size for r in model.registers.values()))
        self._defined = {a: r for r in model.registers.values() for a in range(r.address, r.address + r.size)}
        self._readable: set[tuple[int, int]] = set()
        self._blocks = model.indirect
        self._points: dict[int, int] = {}
        """Target address of each indirect data byte, by the byte's own address."""

    def __contains__(self, name: str) -> bool:
        return name in self.registers

    def value(self, name: str) -> int:
        """Return the register's content; raises KeyError if the model has no such register."""
        return self._of(self.registers[name])

    def get(self, name: str, otherwise: int = 0) -> int:
        """Return the register's content, or `otherwise` if the model has no such register."""
        register = self.registers.get(name)
        return otherwise if register is None else self._of(register)

    def _of(self, register: Register) -> int:
        raw = self.data[register.address : register.address + register.size]
        return int.from_bytes(raw, "little", signed=register.signed)

    def set(self, name: str, value: int) -> None:
        """Store a value; do nothing if the model has no such register."""
        if name in self.registers:
            self.store(self.registers[name], value)

    def store(self, register: Register, value: int) -> None:
        end = register.address + register.size
        self.data[register.address : end] = value.to_bytes(register.size, "little", signed=register.signed)

    def read(self, address: int, length: int) -> bytes | None:
        """Return the bytes of an address range; None if the first or last address belongs to no register."""
        if (address, length) not in self._readable:
            if not (length > 0 and address in self._defined and address + length - 1 in self._defined):
                return None
            self._readable.add((address, length))  # this never changes
        if self._points and self.is_indirect(address, length):
            data, points = self.data, self._points
            return bytes([data[points.get(at, at)] for at in range(address, address + length)])
        return bytes(self.data[address : address + length])

    def read_plain(self, address: int, length: int) -> bytes | None:
        """Like `read`, but faster, and also returns None if the range includes indirect data."""
        if self._points or (address, length) not in self._readable:
            return None if self.is_indirect(address, length) else self.read(address, length)
        return bytes(self.data[address : address + length])

    def is_indirect(self, address: int, length: int) -> bool:
        """Return whether the range includes indirect data that refers to another address."""
        points = self._points
        return bool(points) and any(at in points for at in range(address, address + length))

    def follow_indirect_addresses(self) -> None:
        """Update the targets of the indirect addresses; must be called after one of them has been written."""
        self._points.clear()
        for first_address, first_data, count in self._blocks:
            for index in range(count):
                at = first_address + 2 * index
                target = self.data[at] | self.data[at + 1] << 8
                # Data whose indirect address points to indirect data (by default, to itself) are plain memory.
                if target != first_data + index and target in self._defined and not self._is_indirect_data(target):
                    self._points[first_data + index] = target

    def split(self, address: int, data: bytes) -> tuple[list[tuple[Register, int]], int]:
        """Split a write into registers and values; also return an error number if it violates register boundaries."""
        if not (self._points and self.is_indirect(address, len(data))):
            return self._split_stretch(address, data)
        writes: list[tuple[Register, int]] = []
        for start, stretch in self._stretches(address, data):
            part, error = self._split_stretch(start, stretch)
            if error:
                return writes, error
            writes += part
        return writes, StatusError.NONE

    def _is_indirect_data(self, address: int) -> bool:
        return any(first <= address < first + count for _, first, count in self._blocks)

    def _stretches(self, address: int, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the contiguous address ranges, with their data, that a write through indirect data actually covers."""
        start = end = -1
        stretch = b""
        for offset, byte in enumerate(data):
            at = self._points.get(address + offset, address + offset)
            if at != end:
                if stretch:
                    yield start, stretch
                start, stretch = at, b""
            stretch += bytes((byte,))
            end = at + 1
        yield start, stretch

    def _split_stretch(self, address: int, data: bytes) -> tuple[list[tuple[Register, int]], int]:
        writes: list[tuple[Register, int]] = []
        at, end = address, address + len(data)
        while at < end:
            register = self._defined.get(at)
            if register is None:
                return writes, StatusError.ACCESS
            if at != register.address or at + register.size > end:
                return writes, StatusError.DATA_LENGTH if register.writable else StatusError.ACCESS
            raw = data[at - address : at - address + register.size]
            writes.append((register, int.from_bytes(raw, "little", signed=register.signed)))
            at += register.size
        return writes, StatusError.NONE
