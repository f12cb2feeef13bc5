"""Factory Reset and Control Table Backup: their effect on a control table.

Source: ROBOTIS e-Manual, protocol2. The contents of a backup are uncertain; here, a backup holds every writable
register except ID, Baud Rate, Torque Enable, Bus Watchdog and the goals.
"""

from hil.drivers.packet import StatusError
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.write_rules import GOALS

RESET_ALL, KEEP_ID, KEEP_ID_AND_BAUD = 0xFF, 0x01, 0x02

_BACK_UP, _RESTORE = 0x01, 0x02
_SIGNATURE = b"CTRL"
_FIXED = ("Model Number", "Model Information", "Firmware Version")
_NOT_BACKED_UP = GOALS | {"ID", "Baud Rate", "Torque Enable", "Bus Watchdog"}


def factory_reset(memory: Memory, body: bytes) -> int:
    """Reset the registers to their factory values; return the error number. The caller must then reboot the servo."""
    if len(body) != 1:
        return StatusError.DATA_LENGTH
    if body[0] not in (RESET_ALL, KEEP_ID, KEEP_ID_AND_BAUD):
        return StatusError.DATA_RANGE
    kept = set(_FIXED)
    if body[0] != RESET_ALL:
        kept.add("ID")
    if body[0] == KEEP_ID_AND_BAUD:
        kept.add("Baud Rate")
    for register in memory.registers.values():
        if register.name not in kept:
            memory.store(register, register.initial)
    return StatusError.NONE


class Backup:
    """A copy of the control table in the servo's flash memory, which survives power-off."""

    def __init__(self) -> None:
        self._values: dict[str, int] | None = None

    def execute(self, memory: Memory, body: bytes) -> int:
        """Execute the instruction Control Table Backup; return the error number."""
        if len(body) != 1 + len(_SIGNATURE):
            return StatusError.DATA_LENGTH
        if body[1:] != _SIGNATURE or body[0] not in (_BACK_UP, _RESTORE):
            return StatusError.DATA_RANGE
        if memory.get("Torque Enable"):
            return StatusError.RESULT_FAIL
        if body[0] == _BACK_UP:
            self._values = {
                register.name: memory.value(register.name)
                for register in memory.registers.values()
                if register.writable and register.name not in _NOT_BACKED_UP
            }
            self.mark(memory)
            return StatusError.NONE
        if self._values is None:
            return StatusError.RESULT_FAIL
        self.restore(memory, eeprom=True)
        return StatusError.NONE

    def restore(self, memory: Memory, *, eeprom: bool) -> None:
        """Write the copy back, including its EEPROM area if `eeprom` is set; do nothing if there is no copy."""
        for name, value in (self._values or {}).items():
            register = memory.registers[name]
            if eeprom or not register.eeprom:
                memory.store(register, value)
        memory.follow_indirect_addresses()

    def mark(self, memory: Memory) -> None:
        """Set the register Backup Ready to 1 if there is a copy, otherwise to 0."""
        memory.set("Backup Ready", int(self._values is not None))
