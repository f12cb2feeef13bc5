"""Errors raised by the servo drivers, all of them subclasses of DriverError; `hil.errors` gives their exit codes."""

__all__ = [
    "BusOverheard",
    "BusShared",
    "DriverError",
    "InconsistentReplies",
    "NoControlTables",
    "NoReply",
    "NotPermitted",
    "PortLost",
    "PortNotOpened",
    "ServoFault",
    "ServoRefused",
    "TorqueDoubted",
    "TorqueHeld",
    "TorqueNotOff",
    "UnknownModel",
    "WrongModel",
    "WrongReply",
    "WrongSetting",
]


class DriverError(Exception):
    """Base class of all errors raised by the servo drivers.

    last_samples: the last samples recorded before the error, if an experiment was running. in_doubt: the registers that
    may not have been restored; empty unless all other registers are known to have been restored. after_torque: whether
    the error occurred after torque had been switched on, in which case it does not count as wrong input.
    """

    last_samples: object = None
    in_doubt: tuple[str, ...] = ()
    after_torque: bool = False


class UnknownModel(DriverError):
    """No control table describes this model. Example: `model = "XM430-W351"` in the TOML."""


class NoControlTables(DriverError):
    """The installed dynamixel-sdk has no control tables. Example: a package that needs version 3 was installed later,
    into the same environment.
    """


class PortNotOpened(DriverError):
    """The port could not be opened. Example: the adapter is unplugged, or another program has the port open."""


class NotPermitted(PortNotOpened):
    """The user is not permitted to open the port. Example: a new user who is not in the group `dialout`."""


class PortLost(DriverError):
    """The port failed after it was opened. Example: the USB cable was unplugged while the arm was moving."""


class NoReply(DriverError):
    """A servo did not reply in time. Example: no power on the bus, or a baud rate other than the servo's."""


class WrongReply(DriverError):
    """The reply was corrupted or did not match the request. Example: two servos with the same ID reply at once."""


class InconsistentReplies(WrongReply):
    """Readings of one register differ. Example: a device between adapter and servo repeats earlier replies."""


class ServoRefused(DriverError):
    """The servo understood an instruction and refused it. Example: writing an EEPROM register while torque is on.

    code: the error number in its status packet; 0 if the servo reported no error but does not hold the value written.
    """

    def __init__(self, message: str, code: int = 0) -> None:
        super().__init__(message)
        self.code = code


class TorqueDoubted(ServoRefused):
    """Torque Enable reads as off, but the EEPROM is locked as if torque were on. Example: a servo that keeps its torque
    on although the register reads 0.
    """


class ServoFault(DriverError):
    """The servo reports a hardware error. Example: overload, after which its torque stays off until it is rebooted."""


class BusShared(DriverError):
    """Another master is sending instructions on this bus, or has written goals or modes. Example: a controller board
    wired next to the adapter.
    """


class BusOverheard(BusShared):
    """Packets from another master were heard, but nothing shows that it has written anything. Example: a program
    that polls the servos' temperatures.
    """


class WrongModel(DriverError):
    """The servo is not the one that the configuration describes. Example: an XL430 instead of an XM430-W350."""


class WrongSetting(DriverError):
    """The value of a register rules out an experiment. Example: Drive Mode with Torque On by Goal Update."""


class TorqueHeld(WrongSetting):
    """A servo's torque is already on. Example: another program is holding the arm up."""


class TorqueNotOff(DriverError):
    """Torque off could not be confirmed for every servo, so the power must be cut. Example: the cable was unplugged."""
