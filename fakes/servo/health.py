"""Effects of a servo's own current: heating and overload. Both are off unless described.

Source of the errors: ROBOTIS e-Manual, Shutdown and Hardware Error Status. How the firmware decides on an overload is
not published (unsure): here it is a current held above a threshold for a time, which forgets as fast as it counts.
"""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class Thermal(BaseModel):
    """One lump of heat: the motor's I^2 R warms it, the surroundings cool it."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    resistance_k_w: Annotated[float, Field(gt=0, allow_inf_nan=False, description="from motor to surroundings [K/W]")]
    time_s: Annotated[float, Field(gt=0, allow_inf_nan=False, description="time constant [s]")]
    ambient_c: Annotated[float, Field(ge=-40, le=100, description="surroundings [C]")] = 25.0


class Overload(BaseModel):
    """A current that may not be held for long."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    current_a: Annotated[float, Field(gt=0, allow_inf_nan=False, description="motor current above which it counts [A]")]
    time_s: Annotated[float, Field(gt=0, allow_inf_nan=False, description="how long that may last [s]")]


class Health:
    """Temperature and overload of one servo over time."""

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
        """Whether time does anything here."""
        return self._thermal is not None or self._overload is not None

    def step(self, step_s: float, current_a: float) -> bool:
        """Let time pass with this motor current; whether the servo is overloaded at its end."""
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
        """Forget the overload, as a reboot does; warmth stays."""
        self._overloaded_s = 0.0
