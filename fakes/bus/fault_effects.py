"""The effects of faults on packets, servos and joints."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hil.drivers.packet import HardwareError
from hil.fakes.bus.faults import Fault, FaultKind, Faults
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.plant import CanJam, Plant
from hil.fakes.servo.servo import EmulatedServo

if TYPE_CHECKING:
    from hil.fakes.bus.wire import Wire


def begin(fault: Fault, servos: Sequence[EmulatedServo], joints: Sequence[int], plant: Plant, now: float) -> None:
    """Apply a fault to servos and joints; do nothing for kinds that only affect packets.

    joints: for each servo, the index of the joint it moves. now: bus time [s].
    """
    for joint, servo in zip(joints, servos, strict=True):
        if not fault.concerns(servo.id):
            continue
        match fault.kind:
            case FaultKind.SILENT_SERVO:
                servo.connected = False
            case FaultKind.REBOOT:
                servo.reboot(now, fault.size)
            case FaultKind.OVERHEATING:
                servo.heat(servo.memory.get("Temperature Limit", 80) + fault.size)
            case FaultKind.OVERLOAD:
                servo.fail(HardwareError.OVERLOAD)
            case FaultKind.LOW_VOLTAGE:
                lowest = servo.memory.get("Min Voltage Limit", 95) / 10
                servo.dip(servo.input_voltage_v - (lowest - fault.size))
            case FaultKind.STUCK_JOINT:
                jam(plant, joint, jammed=True)
            case FaultKind.ENCODER_JUMP:
                servo.present.jump_ticks += round(fault.size)


def end(fault: Fault, servos: Sequence[EmulatedServo], joints: Sequence[int], plant: Plant) -> None:
    """Undo a fault if its effect is temporary. A heated servo begins to cool; an error remains until a reboot."""
    for joint, servo in zip(joints, servos, strict=True):
        if not fault.concerns(servo.id):
            continue
        match fault.kind:
            case FaultKind.SILENT_SERVO:
                servo.connected = True
            case FaultKind.OVERHEATING:
                servo.cool()
            case FaultKind.LOW_VOLTAGE:
                servo.dip(0.0)
            case FaultKind.STUCK_JOINT:
                jam(plant, joint, jammed=False)
            case FaultKind.ENCODER_JUMP:
                servo.present.jump_ticks -= round(fault.size)


def put_with_faults(faults: Faults, wire: "Wire", servo_id: int, data: bytes, start: float, now: float) -> float:
    """Put a reply on the wire as modified by the active faults; return the time at which the transmission ends.

    start: start of the transmission, on the clock [s]. now: the same time, counted from the creation of the bus [s].
    """
    late_s = 0.0
    copies = 1
    random = faults.random
    before = b""
    for fault in faults.on_replies:
        if not faults.strikes(fault, servo_id, now):
            continue
        match fault.kind:
            case FaultKind.LOST_REPLY:
                copies = 0
            case FaultKind.CORRUPTED_REPLY:
                bits = range(8 * len(data))
                data = _flipped(data, random.sample(bits, min(round(fault.size), len(bits))))
            case FaultKind.TRUNCATED_REPLY:
                data = data[: random.randrange(1, len(data))]
            case FaultKind.DUPLICATED_REPLY:
                copies *= 2
            case FaultKind.LATE_REPLY:
                late_s += fault.size
            case FaultKind.NOISE:
                before = random.randbytes(round(fault.size))
    end = start + len(data) * wire.byte_s
    if not copies:
        wire.occupy(end)
        return end
    end = wire.put(before + data, start, late_s)
    for _ in range(copies - 1):
        end = wire.put(data, end, late_s)
    return end


def _flipped(data: bytes, bits: Sequence[int]) -> bytes:
    changed = bytearray(data)
    for bit in bits:
        changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def jam(plant: Plant, joint: int, *, jammed: bool) -> None:
    """Block a joint or release it; raises PlantError if the plant does not support this."""
    if not isinstance(plant, CanJam):
        raise PlantError(f"{type(plant).__name__} has no jam(joint, jammed), needed by the fault stuck_joint")
    plant.jam(joint, jammed)
