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


class Health:
    """Temperature and overload state of one servo."""

    def __init__(
        self, resistance_ohm: float, temperature_c: float, thermal: Thermal | None, overload: Overload | None
    ) -> None:
        self.temperature_c = temperature_c
        self._resistance_ohm = resistance_ohm
        self._thermal = thermal
        self._overload = overload
        self._overloaded_s = 0.0

    @property
    def changes(self) -> bool:
        """Whether the state changes with time."""
        return self._thermal is not None or self._overload is not None

    def step(self, step_s: float, current_a: float) -> bool:
        """Advance by `step_s` [s] with this motor current [A]; return whether the servo is then overloaded."""
        thermal = self._thermal
        if thermal is not None:
            end = thermal.ambient_c + thermal.resistance_k_w * self._resistance_ohm * current_a**2
            self.temperature_c += (end - self.temperature_c) * min(step_s / thermal.time_s, 1.0)
        overload = self._overload
        if overload is None:
            return False
        above = abs(current_a) > overload.current_a
        self._overloaded_s = max(0.0, self._overloaded_s + (step_s if above else -step_s))
        return self._overloaded_s > overload.time_s

    def rest(self) -> None:
        """Reset the overload timer, as a reboot does; the temperature remains."""
        self._overloaded_s = 0.0
