"""One supply for all servos: its voltage sags under their currents, and they boot when it breaks down."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from hil.fakes.servo.servo import Servo


class Supply(BaseModel):
    """Cable and power supply. The voltage without load is each servo's `input_voltage_v`."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    resistance_ohm: Annotated[float, Field(ge=0, le=100, description="of supply and cable [ohm]")]
    brownout_v: Annotated[float, Field(ge=0, le=100, description="a servo boots when its voltage is below [V]")] = 0.0

    def load(self, servos: Sequence[Servo], current: Sequence[float], now: float) -> None:
        """Give every servo the voltage that is left under these motor currents [A]; now: bus time [s].

        The bridge of a servo takes from the supply the share of the motor's current in which it is on.
        """
        drawn = sum(
            abs(servo.supply_share(amp) * amp)
            for servo, amp in zip(servos, current, strict=True)
            if servo.torque_enabled
        )
        for servo in servos:
            servo.sag_v = self.resistance_ohm * drawn
            if servo.supply_v < self.brownout_v and now >= servo.ready_at:
                servo.sag_v = 0.0  # nothing draws any more when it boots
                servo.reboot(now)
