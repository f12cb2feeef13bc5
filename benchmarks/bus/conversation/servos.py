"""What the host of a conversation knows about its servos, and the registers that have special rules."""

from dataclasses import dataclass, field

from benchmarks.bus.servo_rules import (
    BAUD,
    SERVO_ID,
    TORQUE_ENABLE,
    Rules,
)

BAUD_RATES = (9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
NUMBERS = {
    **{"XM430-W350": 1020, "XM430-W210": 1030, "XH430-W350": 1000, "XH430-W210": 1010, "XD430-T350": 1001},
    **{"XD430-T210": 1011, "XW430-T333": 1270, "XM540-W270": 1120, "XM540-W150": 1130, "XH540-W270": 1100},
    **{"XH540-W150": 1110, "XD540-T270": 1101, "XD540-T150": 1111, "XW540-T260": 1170, "XW540-T140": 1180},
    **{"XL330-M288": 1200, "XL330-M077": 1190, "XC330-M181": 1230, "XC330-M288": 1240, "XC330-T181": 1210},
    **{"XC330-T288": 1220, "XL430-W250": 1060, "XC430-W150": 1070, "XC430-W240": 1080},
}
DELAY, SHADOW, LEVEL, WATCHDOG = 9, 12, 68, 98
APART = (SERVO_ID, BAUD, DELAY, SHADOW, 20, 31, 32, 34, LEVEL, WATCHDOG, 116)
"""Registers that are tested separately, and limits that would shut a servo down if they were changed."""
UNDEFINED = (15, 72, 94, 150)
NOBODY = 251
QUIET_S, BOOT_S, PAUSE_S = 0.02, 0.4, 2e-3
GOALS, KEPT_IN_BACKUP = (100, 102, 104, 116), (SERVO_ID, BAUD, TORQUE_ENABLE, WATCHDOG)
SPECIAL = b"\xff\xff\xfd"
ALERT = 0x80
ERRORS = set(range(1, 8))


class Still:
    """Joints that never move."""

    def __init__(self, joints: int) -> None:
        self.joints = joints
        self.position = self.velocity = self.current = [0.0] * joints

    def advance(self, until: float, current: object) -> None:
        """Do nothing."""


@dataclass
class Servo:
    """One servo as the manual describes it.

    backup: contents of its backup; None if there is no backup. alert: whether it has a hardware error. indirect: its
    indirect data.
    """

    model: str
    firmware: int
    rules: Rules
    backup: dict[int, int] | None = None
    alert: bool = False
    indirect: bytearray = field(default_factory=lambda: bytearray(20))

    @property
    def id(self) -> int:
        return self.rules.held[SERVO_ID]

    @property
    def level(self) -> int:
        """Status Return Level."""
        return self.rules.held[LEVEL]

    @property
    def shadow(self) -> int | None:
        """Secondary ID."""
        own = self.rules.held[SHADOW]
        return own if own <= 252 else None

    @property
    def is_330(self) -> bool:
        return "330" in self.model

    @property
    def has_fast_reads(self) -> bool:
        return self.firmware >= (46 if self.is_330 else 45)

    @property
    def indirect_data(self) -> int:
        return 208 if self.is_330 and self.firmware == 52 else 224
