"""Check the bus before anything moves: the servos' own limits, and one second of exchanges with torque off."""

import numpy as np

from hil import fakes
from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.rate import FixedRate
from hil.drivers.servo_model import VELOCITY_UNIT, VOLTAGE_UNIT, Mode
from hil.setup.session.servo_session import servo_session

_SECONDS = 1.0


def quiet_stream(config: Config) -> tuple[str, ...]:
    """Return lines of text about the servos' limits and the timing of exchanges. Raises DriverError."""
    fakes.register_for(config.url)
    with servo_session(config) as bus:
        return (*_limits(config, bus), _timing(config, bus))


def _limits(config: Config, bus: ServoBus) -> list[str]:
    lines = []
    for joint, described in zip(bus.joints, config.joints, strict=True):
        servo = bus.servo(joint)
        supply, least, most = (
            VOLTAGE_UNIT * servo.read(name)
            for name in ("Present Input Voltage", "Min Voltage Limit", "Max Voltage Limit")
        )
        parts = [
            f"supply {supply:.1f} V (allowed: {least:.1f} to {most:.1f} V)",
            f"{servo.read('Present Temperature')} degrees C (limit: {servo.read('Temperature Limit')})",
            f"velocity limit {VELOCITY_UNIT * servo.read('Velocity Limit'):.1f} rad/s (not enforced in current mode)",
        ]
        if joint.mode is Mode.CURRENT:
            own = servo.read("Current Limit") * abs(joint.drive_unit(0.0))
            short = ": TOO LOW, goals would be refused" if own < described.goal_limit else ""
            parts.insert(0, f"own current limit {own:.2f} A, current_limit {described.goal_limit:g} A{short}")
        lines.append(f"{joint.title}: {'; '.join(parts)}.")
    return lines


def _timing(config: Config, bus: ServoBus) -> str:
    rate = config.experiment.rate
    ticks = FixedRate(bus.port.clock, rate)
    nothing = [0.0] * len(bus.joints)
    lateness, round_trip, missing = [], [], 0
    for _ in range(round(_SECONDS * rate)):
        tick = ticks.wait()
        if tick.missed:
            continue
        state = bus.exchange(nothing)
        lateness.append(1e6 * (state.time_before_write - tick.deadline))
        round_trip.append(1e6 * (state.time_after_read - state.time_before_write))
        missing += any(state.missing)
    late, there = (float(np.quantile(values, 0.99)) for values in (lateness, round_trip))
    return (
        f"At {rate:g} cycles per second with torque off: lateness p99 {late:.0f} us, round trip p99 {there:.0f} us "
        f"(period: {1e6 / rate:.0f} us), {ticks.missed} missed deadlines, {missing} lost replies."
    )
