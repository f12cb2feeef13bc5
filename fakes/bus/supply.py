"""One supply for all servos: its voltage sags under load, and servos reboot when it is too low."""

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from hil.fakes.servo.servo import EmulatedServo
from hil.toml_errors import Described


class Supply(Described):
    """Cable and power supply. The no-load voltage is each servo's `input_voltage_v`."""

    resistance_ohm: Annotated[float, Field(ge=0, le=100, description="resistance of supply and cable [ohm]")]
    brownout_v: Annotated[float, Field(ge=0, le=100, description="voltage below which a servo reboots [V]")] = 0.0

    def load(self, servos: Sequence[EmulatedServo], current: Sequence[float], now: float) -> None:
        """Set every servo's supply voltage for these motor currents [A]. now: bus time [s].

        The current that a servo draws from the supply is its motor current times the duty cycle of its bridge.
        """
        drawn = sum(
            abs(servo.supply_share(amp) * amp)
            for servo, amp in zip(servos, current, strict=True)
            if servo.torque_enabled
        )
        for servo in servos:
            servo.sag_v = self.resistance_ohm * drawn
            if servo.supply_v < self.brownout_v and now >= servo.ready_at:
                servo.sag_v = 0.0  # a rebooting servo draws no current
                servo.reboot(now)
