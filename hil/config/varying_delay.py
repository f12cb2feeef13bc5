"""Detection of sample rates at which a voltage-driven servo applies its goals with a slowly varying delay.

Such a servo applies a goal the next time its control loop runs. If the sample interval is almost a whole number of the
loop's periods, the delay slowly rises by one period, falls back, and rises again. This is a slow beat, to which the arm
responds. If the sample rate divides the loop's rate, or the beat is much faster than the arm's motion, the delay acts
like a constant one.
"""

from typing import TYPE_CHECKING

from hil.drivers.servo_model import Mode

if TYPE_CHECKING:
    from hil.config.schema import Config

_LOOP_HZ = 1000
"""Assumed rate of the servos' control loop [Hz], which ROBOTIS does not publish; the fake servos use the same rate."""

_FASTEST = 4.0
"""A beat is noticeable only if its frequency is below this multiple of the highest excited frequency."""

_CHOICES = (20, 25, 40, 50, 100, 125, 200, 250, 500, 1000)
"""Sample rates without a beat [Hz]."""


def varying_delay(config: "Config") -> str:
    """Return a sentence about a slow beat between the sample rate and the control loops; "" if there is none."""
    if all(joint.drive_mode is not Mode.PWM for joint in config.joints):
        return ""
    rate = config.experiment.rate
    left = _LOOP_HZ % rate
    beat = min(left, rate - left)
    if not 1e-6 * rate < beat < _FASTEST * _highest(config):
        return ""
    often = "once" if beat == 1.0 else f"{beat:g} times"
    choices = [f"{max(each for each in _CHOICES if each < rate)}"]
    choices += [f"{each}" for each in _CHOICES if each > rate][:1]
    return (
        f"At experiment.rate = {rate:g}, the delay of the goals probably varies by up to 1 ms, {often} a second, "
        f"because servos without current mode apply a goal at the next step of their control loop, about once per ms. "
        f"Choose a rate that divides 1000, such as {' or '.join(choices)}."
    )


def _highest(config: "Config") -> float:
    """Return the highest excited frequency [Hz]."""
    experiment = config.experiment
    if experiment.band is not None:
        return experiment.band[1]
    return max(max(each) for each in experiment.lines or [[1]]) / experiment.period
