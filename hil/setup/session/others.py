"""Servos on the bus that are not part of the arm: found, reported, and left alone."""

from typing import NamedTuple

from hil.drivers.bus import ServoBus
from hil.drivers.clock import WallClock
from hil.drivers.control_table import load_control_table
from hil.drivers.errors import DriverError, WrongSetting
from hil.drivers.servo import Servo
from hil.setup.scan import Found, listen
from hil.setup.session.leftovers import about_leftovers

_AT_ONCE_S = 0.005
"""Listening time on a virtual bus [s], where replies are immediate; real servos may wait for their time slots."""


class Other(NamedTuple):
    """A servo that is not part of the arm.

    name: its ID and model. described: the same, and whether its torque is on. left: a message about what a killed run
    left on it; "" if nothing.
    """

    name: str
    described: str
    left: str = ""


def others_on_the_bus(bus: ServoBus) -> list[Other]:
    """Describe each servo at this baud rate that is not part of the arm.

    Raises PortLost, or WrongSetting if one of them obeys commands meant for a servo of the arm.
    """
    ours = {drive.id for drive in bus.drives}
    heard = listen(bus.port) if isinstance(bus.port.clock, WallClock) else listen(bus.port, _AT_ONCE_S)
    return [_describe(bus, found) for found in heard.servos if found.id not in ours]


def _describe(bus: ServoBus, found: Found) -> Other:
    name = f"ID {found.id}, {found.model or f'model number {found.model_number}'}"
    if found.model is None:
        return Other(name, name)
    servo = Servo(bus.port, found.id, load_control_table(found.model))
    try:
        secondary = servo.read("Secondary(Shadow) ID")
        torque = servo.read("Torque Enable")
    except (DriverError, KeyError):
        return Other(name, name)
    for drive in bus.drives:
        if drive.id == secondary:
            raise WrongSetting(
                f"{name}: its Secondary ID is {secondary}, so it obeys torque and goal commands for {drive} in its "
                "own mode, without a watchdog, although it is not configured. Remove the Secondary ID: "
                f"hil setup {bus.port.url} --id {found.id} --secondary-id 255. If it moves the same joint, list both "
                "IDs in the configuration."
            )
    left = about_leftovers(servo)
    return Other(name, f"{name}, torque {'on' if torque else 'off'}", "" if left is None else str(left))
