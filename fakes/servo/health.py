"""Effects of a servo's own current: heating and overload. Both are off unless the description specifies them.

Source of the error bits: ROBOTIS e-Manual, Shutdown and Hardware Error Status. The firmware's criterion for an overload
is not published; here, it is a current above a threshold for a given time.
"""

from typing import Annotated

from pydantic import Field

from hil.toml_errors import Described


class Thermal(Described):
    """A single thermal mass, heated by the motor's I^2 R and cooled by the surroundings."""

    resistance_k_w: Annotated[
        float,
        Field(gt=0, le=1000, allow_inf_nan=False, description="thermal resistance from motor to surroundings [K/W]"),
    ]
    time_s: Annotated[float, Field(gt=0, le=36000, allow_inf_nan=False, description="time constant [s]")]
    ambient_c: Annotated[
        float, Field(ge=-40, le=100, allow_inf_nan=False, description="temperature of the surroundings [C]")
    ] = 25.0


class Overload(Described):
    """Shutdown after the current has been high for too long."""

    current_a: Annotated[
        float,
        Field(gt=0, le=100, allow_inf_nan=False, description="motor current above which the overload timer runs [A]"),
    ]
    time_s: Annotated[
        float, Field(gt=0, le=3600, allow_inf_nan=False, description="longest permitted time above that current [s]")
    ]


COOLING_K_S = 10.0
"""Rate at which a servo without [thermal] table cools after a fault has heated it [K/s].

This rate was chosen so that tests need not wait long; a real servo takes minutes.
"""


class Health:
    """Temperature and overload state of one servo."""

    def __init__(
        self, resistance_ohm: float, temperature_c: float, thermal: Thermal | None, overload: Overload | None
    ) -> None:
        self._temperature_c = temperature_c
        self._unheated_c = temperature_c
        self._heated_by = 0
        """Number of faults that currently heat the servo."""
        self._resistance_ohm = resistance_ohm
        self._thermal = thermal
        self._overload = overload
        self._overloaded_s = 0.0

    @property
    def temperature_c(self) -> float:
        return self._temperature_c

    @temperature_c.setter
    def temperature_c(self, celsius: float) -> None:
        self._temperature_c = self._unheated_c = celsius

    @property
    def changes(self) -> bool:
        """Whether the state changes with time."""
        return self._thermal is not None or self._overload is not None or self._cools

    @property
    def _cools(self) -> bool:
        return not self._heated_by and self._temperature_c != self._unheated_c

    def heat(self, celsius: float) -> None:
        """Begin a fault that heats the servo to this temperature [C].

        With a thermal model, the servo then cools by itself; without one, it stays hot until `cool` is called.
        """
        if self._thermal is not None:
            self.temperature_c = celsius
        else:
            self._temperature_c = celsius
            self._heated_by += 1

    def cool(self) -> None:
        """End a fault that heats the servo.

        Without a thermal model, the servo then returns to its temperature before the fault, at the rate `COOLING_K_S`.
        """
        self._heated_by = max(0, self._heated_by - 1)

    def step(self, step_s: float, current_a: float) -> bool:
        """Advance by `step_s` [s] with this motor current [A]; return whether the servo is then overloaded."""
        thermal = self._thermal
        if thermal is not None:
            end = thermal.ambient_c + thermal.resistance_k_w * self._resistance_ohm * current_a**2
            self.temperature_c += (end - self.temperature_c) * min(step_s / thermal.time_s, 1.0)
        elif self._cools:
            self._temperature_c = max(self._unheated_c, self._temperature_c - COOLING_K_S * step_s)
        overload = self._overload
        if overload is None:
            return False
        above = abs(current_a) > overload.current_a
        self._overloaded_s = max(0.0, self._overloaded_s + (step_s if above else -step_s))
        return self._overloaded_s > overload.time_s

    def rest(self) -> None:
        """Reset the overload timer, as a reboot does; the temperature is unchanged."""
        self._overloaded_s = 0.0
