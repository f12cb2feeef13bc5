"""What a servo's ticks mean, by model: the facts that the SDK's control tables leave out.

Sources: ROBOTIS e-Manual, page of each model (current unit, resolution, Operating Mode, stall figures).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from drivers.errors import UnknownModel

VELOCITY_UNIT = 0.229 * 2 * math.pi / 60
"""rad/s per tick of Present Velocity."""

WATCHDOG_UNIT = 0.020
"""s per tick of Bus Watchdog."""


@dataclass(frozen=True, slots=True)
class ServoModel:
    """Units of one model with a current mode.

    current_unit: A per tick of Goal and Present Current.
    position_steps: ticks of Present Position per turn.
    watchdog_firmware: first firmware with a Bus Watchdog.
    fast_sync_read_firmware: first firmware that answers Fast Sync Read.
    """

    name: str
    current_unit: float
    position_steps: int = 4096
    watchdog_firmware: int = 38
    fast_sync_read_firmware: int = 45

    @property
    def position_unit(self) -> float:
        """rad per tick of Present Position."""
        return 2 * math.pi / self.position_steps


_MODELS = (
    ServoModel("XM430-W350", 2.69e-3),
    ServoModel("XM430-W210", 2.69e-3),
    ServoModel("XH430-W350", 2.69e-3),
    ServoModel("XH430-W210", 2.69e-3),
    ServoModel("XM540-W270", 2.69e-3),
    ServoModel("XM540-W150", 2.69e-3),
    ServoModel("XL330-M288", 1.0e-3, fast_sync_read_firmware=46),
    ServoModel("XL330-M077", 1.0e-3, fast_sync_read_firmware=46),
    ServoModel("XC330-T288", 1.0e-3, fast_sync_read_firmware=46),
)

CURRENT_MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _MODELS})
"""Models that can be commanded a current, by name."""


def servo_model(name: str) -> ServoModel:
    """The model's units; raises UnknownModel with the names that are possible."""
    try:
        return CURRENT_MODELS[name]
    except KeyError:
        raise UnknownModel(
            f"{name!r} is not a servo model with a current mode. Possible: {', '.join(CURRENT_MODELS)}."
        ) from None
