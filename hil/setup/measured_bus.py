"""Measure, with torque off, the sample rate that a new arm's bus can sustain."""

from pathlib import Path

from hil import fakes
from hil.config.schema import parse_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import DriverError
from hil.setup.bus_rate import CYCLES, choose_mode, measure_modes, shared_with_another
from hil.setup.config_template import RATES, ArmAnswers, MeasuredBus, arm_toml


def measured_bus(arm: ArmAnswers, path: Path) -> tuple[MeasuredBus | None, str]:
    """Measure the bus of the described arm. path: path of the file to be written, for messages.

    Returns:
        The measurement, or None if it failed, and a message about it for the user.
    """
    config = parse_config(arm_toml(arm), path)
    fakes.register_for(config.url)
    try:
        with ServoBus.connect(config.bus) as bus:
            bus.learn_latency()
            modes = measure_modes(bus)
            mode, rate = choose_mode(bus, modes, RATES)
    except DriverError as error:
        return None, f"The rate of this bus was not measured: {error}"
    # Servos without Fast Sync Read are read without it anyway, so the file need not disable it.
    fast = mode.fast or not any(each.fast for each in modes)
    found = MeasuredBus(float(rate), mode.rate, mode.one_write, fast)
    said = f"This bus can sustain {mode.whole_rate} Hz with {mode.name}; rate = {rate:g} is set in the file."
    if shared := shared_with_another(modes):
        said += f" But the measurement was disturbed. {shared}"
    elif mode.lost:
        said += (
            f" But {mode.lost} of {CYCLES} replies were lost: check cables, supply and termination, and whether other "
            "programs keep this computer busy."
        )
    return found, said
