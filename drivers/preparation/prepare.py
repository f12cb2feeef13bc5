"""Preparation for the control cycle: measure the adapter's delay, check that the bus is quiet, set servo modes."""

from contextlib import suppress

from hil.drivers.errors import BusOverheard, BusShared, NoReply, ServoFault, WrongReply, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.others.read_back import Overruled
from hil.drivers.packet import Framer, HardwareError
from hil.drivers.port import Port
from hil.drivers.preparation.settings import arms_itself
from hil.drivers.preparation.unsuitable import APPLY_HOMING, ignored_homing, unsuitable_drive_mode
from hil.drivers.servo import NO_ERROR, Servo, describe_error
from hil.drivers.servo_model import Mode

LISTEN_S = 0.05
"""How long the bus must be quiet before this program starts to use it [s]."""

SLOWEST_S = 0.1
"""Delay of the slowest supported adapter [s]."""

_TRIPS = 5
_TIMES, _APART_S = 6, 0.05
"""Number of repeated measurements before slow replies are attributed to the adapter, and the time between two
measurements [s].
"""

_PING_BYTES = 24  # on the wire: the ping and its status
_STATUS_BYTES = 14
_MARGIN = 1.25
_MOST_HEARD_BYTES = 4096
_SLOWER_THAN_KNOWN_S = 1.5e-3


def learn_latency(servo: Servo) -> None:
    """Increase the port's reply timeout if this servo's replies are slow, as over Bluetooth or a network.

    If the measured latency exceeds what this kind of adapter should need, the port's `latency` is raised to the
    measured value plus a margin. A full-speed USB adapter needs 1 to 2.5 ms.
    """
    port, usual = servo.port, servo.port.latency
    trips = latest = _trips(servo)
    if not trips and port.read(_STATUS_BYTES, SLOWEST_S):  # no reply in time, but a late one
        port.discard_input()
        port.latency = SLOWEST_S
        trips = latest = _trips(servo)
    bytes_s = port.wire_time(_PING_BYTES)
    for _ in range(_TIMES):
        if min(trips, default=0.0) - bytes_s < usual + _SLOWER_THAN_KNOWN_S:
            break
        # A busy computer delays replies as well, for some ms at a time; an adapter delays every one of them.
        port.clock.wait_until(port.clock.now() + _APART_S)
        latest = _trips(servo)
        trips = trips + latest
    taken, longest = min(trips, default=0.0) - bytes_s, max(latest, default=0.0) - bytes_s
    port.off_wire = max(0.0, taken)
    # If nobody replies, the next request raises an error that says so.
    port.latency_measured = taken >= usual + _SLOWER_THAN_KNOWN_S
    if not port.latency_measured:
        # The delay of a full-speed USB adapter depends on when a request is made within a frame of 1 ms.
        taken = min(longest, usual + _SLOWER_THAN_KNOWN_S)
    port.latency = max(usual, _MARGIN * taken)


def _trips(servo: Servo) -> list[float]:
    """Return the durations of a few pings [s], stopping at the first without a valid reply."""
    clock, trips = servo.port.clock, []
    with suppress(NoReply, WrongReply):
        for _ in range(_TRIPS):
            start = clock.now()
            servo.ping(attempts=1)
            trips.append(clock.now() - start)
    return trips


def check_quiet(port: Port) -> None:
    """Raise BusShared if another master's instructions are received."""
    port.discard_input()
    port.strangers = 0
    heard = list(Framer().feed(port.read(_MOST_HEARD_BYTES, LISTEN_S)))
    targets = sorted({packet.id for packet in heard if not packet.is_status})
    if targets:
        raise overheard(f"is sending instructions to ID {', '.join(map(str, targets))}")


def overheard(what: str) -> BusOverheard:
    """Return the error for a bus on which another master is active; `what` says what that master is doing."""
    return BusOverheard(
        f"Another master {what} on this bus, or the adapter echoes what this program sends. Two masters corrupt each "
        "other's packets, and the other master's goals would move the arm too. Stop the other program or unplug the "
        "other controller; if there is none, switch off the adapter's echo."
    )


def overruled(joint: Joint, found: Overruled) -> BusShared:
    """Return the error for a servo that holds a goal or a setting that this program did not write."""
    by, before, check = "is being commanded", f"but {found.written} was written", ""
    is_goal = found.register == joint.mode.goal_register
    if not is_goal and found.register != "Operating Mode":
        by, before = "was changed", f"and read {found.written} before the start"
    if is_goal:
        check = " If there is none, goals are being altered in transit: check the adapter and the cable."
    return BusShared(
        f"{joint.title[0].upper()}{joint.title[1:]} {by} by another program: its {found.register} reads "
        f"{found.value}, {before}. Stop that program, or unplug its controller.{check}"
    )


def prepare_servo(joint: Joint, servo: Servo, others: set[int]) -> None:
    """Prepare a servo whose torque is off: check it for faults and unsuitable settings, and set its operating mode.

    others: IDs of the arm's other servos. Raises ServoFault, WrongSetting, and the errors of `Servo.write`.
    """
    fault = servo.hardware_error()
    if fault != HardwareError(0):
        raise ServoFault(fault_text(joint, describe_error(fault), shuts_down=shuts_down(servo, fault)))
    if (drive_mode := unsuitable_drive_mode(servo)) is not None:
        raise WrongSetting(
            f"{joint.title}: Drive Mode is {drive_mode} but must be 0 (no reverse, no torque on by goal "
            "update). Set it with DYNAMIXEL Wizard 2.0; if the servo was reversed, determine `direction` and "
            "zero_ticks again."
        )
    if offset := ignored_homing(servo):
        raise WrongSetting(f"{joint.title}: Homing Offset is {offset}. {APPLY_HOMING}.")
    secondary = servo.read("Secondary(Shadow) ID")
    if secondary in others:
        raise WrongSetting(
            f"{joint.title}: its Secondary ID is {secondary}, so it also obeys commands to that ID. Clear this ID with "
            f"hil setup {servo.port.url} --id {joint.id} --secondary-id 255."
        )
    if arms_itself(servo):
        raise WrongSetting(
            f"{joint.title}: Startup Configuration switches its torque on at every power-up or "
            "reboot. Set that register to 0 with DYNAMIXEL Wizard 2.0."
        )
    if servo.read("Operating Mode") != joint.mode:
        servo.write("Operating Mode", joint.mode)
    if servo.read("Bus Watchdog"):
        servo.write("Bus Watchdog", 0)  # goals are read-only while it is tripped
    if joint.mode is Mode.CURRENT:
        servo.write("Goal Current", 0)  # a change of mode leaves it at Current Limit
        # Goal PWM also limits the output in current mode, and another program may have left it at zero.
        if servo.read("Goal PWM") != servo.read("PWM Limit"):
            servo.write("Goal PWM", servo.read("PWM Limit"))


def shuts_down(servo: Servo, error: HardwareError) -> bool:
    """Whether the servo's Shutdown register makes it cut its torque for one of these errors."""
    return bool(HardwareError(servo.read("Shutdown")) & error)


def fault_text(joint: Joint, cause: str, *, shuts_down: bool = True) -> str:
    """Return the message for a servo that has raised its alert.

    shuts_down: whether its Shutdown register makes it cut its torque in this case.
    """
    if cause == NO_ERROR:
        return (
            f"{joint.title} raised its alert, but reports no hardware error now. Check its supply and connector, then "
            "power-cycle it."
        )
    raised = f"{joint.title} raised its alert; hardware error: {cause}."
    if not shuts_down:
        return f"{raised} Its Shutdown setting leaves its torque on. Find the cause, then power-cycle it."
    return f"{raised} Its torque stays off until it is rebooted: find the cause, then power-cycle it."
