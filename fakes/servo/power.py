"""A servo's supply and temperature monitoring: registers, limits, and the shutdown they cause."""

from abc import ABC, abstractmethod

from hil.drivers.packet import HardwareError
from hil.fakes.servo.health import Health
from hil.fakes.servo.memory import Memory
from hil.fakes.servo.registers import EmulatedModel


class Powered(ABC):
    """A servo's supply and temperature. Limit violations remain set in Hardware Error Status until a reboot."""

    def __init__(self, model: EmulatedModel, memory: Memory, health: Health, input_voltage_v: float) -> None:
        self.model = model
        self.memory = memory
        self.health = health
        self._input_voltage_v = input_voltage_v
        self._sag_v = 0.0
        self._dip_v = 0.0

    @abstractmethod
    def _derive(self) -> None:
        """Recompute the values that depend on registers."""

    @property
    def supply_v(self) -> float:
        """The voltage at the servo's connector [V]."""
        return max(0.0, self._input_voltage_v - self._sag_v - self._dip_v)

    @property
    def input_voltage_v(self) -> float:
        """The supply's no-load voltage [V]."""
        return self._input_voltage_v

    @input_voltage_v.setter
    def input_voltage_v(self, volt: float) -> None:
        self._input_voltage_v = volt
        self._check_health()
        self._derive()

    @property
    def sag_v(self) -> float:
        """The voltage drop due to the load [V]."""
        return self._sag_v

    @sag_v.setter
    def sag_v(self, volt: float) -> None:
        self._sag_v = volt
        if round(10 * self.supply_v) != self.memory.get("Present Input Voltage"):
            self._check_health()
            self._derive()

    def dip(self, volt: float) -> None:
        """Reduce the supply voltage by this much [V]; 0 ends the dip."""
        self._dip_v = volt
        self._check_health()
        self._derive()

    @property
    def temperature_c(self) -> float:
        return self.health.temperature_c

    @temperature_c.setter
    def temperature_c(self, celsius: float) -> None:
        self.health.temperature_c = celsius
        self._check_health()
        self._derive()

    def heat(self, celsius: float) -> None:
        """Begin a fault that heats the servo to this temperature [C]."""
        self.health.heat(celsius)
        self._check_health()
        self._derive()

    def cool(self) -> None:
        """End a fault that heats the servo; see `Health.cool`."""
        self.health.cool()
        self._derive()

    def _check_health(self) -> None:
        """Compare supply and temperature with their limits; violations remain set in Hardware Error Status."""
        memory = self.memory
        decivolt, celsius = max(0, round(10 * self.supply_v)), max(0, min(255, round(self.temperature_c)))
        memory.set("Present Input Voltage", decivolt)
        memory.set("Present Temperature", celsius)
        if not self.model.operating_modes:
            return  # its limits are unknown
        error = memory.value("Hardware Error Status")
        if not memory.value("Min Voltage Limit") <= decivolt <= memory.value("Max Voltage Limit"):
            error |= HardwareError.INPUT_VOLTAGE
        if celsius > memory.value("Temperature Limit"):
            error |= HardwareError.OVERHEATING
        memory.set("Hardware Error Status", error)
        self._shut_down_if_masked()

    def _shut_down_if_masked(self) -> None:
        if self.memory.get("Hardware Error Status") & self.memory.get("Shutdown"):
            self.memory.set("Torque Enable", 0)
