"""What can go wrong between the computer and the servos.

DriverError
├── UnknownModel        a model name or number that no control table describes
├── PortNotOpened       the port does not exist, is taken, or cannot do this baud
│   └── NotPermitted    the port exists, but this user may not open it
├── PortLost            the port was open and then failed: cable pulled, adapter gone
├── NoReply             a servo did not answer: wrong ID, wrong baud rate, no power
├── WrongReply          a servo's reply does not match the request
├── ServoRefused        a servo answered with an error code: access, range, limit
├── ServoFault          a servo reports a hardware error: overload, overheating, voltage
├── BusShared           another program is master of the same bus
├── WrongModel          another model, or one whose firmware is too old, answers at this ID
├── WrongSetting        a register holds a value with which no experiment may start
│   └── TorqueHeld      torque is already on: another program holds or drives the arm
└── TorqueNotOff        a servo could not be confirmed to be without torque
"""


class DriverError(Exception):
    """Anything that went wrong between the computer and the servos.

    last_samples: the last samples an experiment recorded before it, if one was running.
    """

    last_samples: object = None


class UnknownModel(DriverError):
    """No control table describes this model. Example: `model = "XM430-W351"` in the TOML."""


class PortNotOpened(DriverError):
    """The port could not be opened. Example: the adapter is unplugged, or another program has the port."""


class NotPermitted(PortNotOpened):
    """The user may not open the port. Example: a new user who is not in group `dialout`."""


class PortLost(DriverError):
    """The port failed after it was open. Example: the USB cable was pulled while the arm moved."""


class NoReply(DriverError):
    """A servo did not answer in time. Example: no power on the bus, or a baud rate that is not the servo's."""


class WrongReply(DriverError):
    """The reply was corrupted or did not match the request. Example: two servos with the same ID reply at once."""


class ServoRefused(DriverError):
    """The servo understood and refused. Example: an EEPROM register written while torque is on."""


class ServoFault(DriverError):
    """The servo reports a hardware error. Example: overload, after which it stays without torque until rebooted."""


class BusShared(DriverError):
    """Another master sends instructions on this bus. Example: a controller board plugged in beside the adapter."""


class WrongModel(DriverError):
    """Not the servo that the configuration describes. Example: an XL430 where an XM430-W350 should be."""


class WrongSetting(DriverError):
    """A register forbids the experiment. Example: Drive Mode with Torque On by Goal Update."""


class TorqueHeld(WrongSetting):
    """A servo already has torque on. Example: another program holds the arm up."""


class TorqueNotOff(DriverError):
    """Torque off could not be confirmed for every servo. Example: the cable was pulled: cut the supply."""
