"""Why the model does not explain a settled motion, if the configuration or the motion itself reveals the cause."""

from contextlib import suppress

from hil.config.schema import Config
from hil.config.varying_delay import varying_delay
from hil.estimation.unsettled.causes import stop_in
from hil.estimation.unsettled.slips import reversal_said, unexplained
from hil.estimator.baselines.signs import suspect_signs
from hil.estimator.data.joined_periods import joined
from hil.estimator.data.recording import Recording
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import RecordingError
from hil.estimator.selection.validation import Validation
from hil.estimator.selection.verdict import MUCH_LEFT


def cause_of_residual(config: Config, period: SettledPeriod, validation: Validation) -> str:
    """Return sentences about a sample rate that beats with the servos' loops, a wrong direction or an end stop;
    "" if none applies."""
    said = [varying_delay(config)]
    if float(validation.residual_over_floor.max()) > MUCH_LEFT:
        with suppress(RecordingError):  # a joint that hardly moved
            recording = joined(period, 1)
            said.append(_reversed(config, recording) or stop_in([recording]))
    return " ".join(filter(None, said))


def _reversed(config: Config, recording: Recording) -> str:
    """Return a sentence about a joint with a wrong sign; "" if there is none.

    If the directions of both joints were wrong, the motion would be that of a mirror-image arm, and nothing would
    contradict it. The motion therefore reveals only that the two directions are inconsistent, not which one is wrong.
    """
    names = [joint.name for joint in config.joints]
    found = suspect_signs([recording])
    if found is None:
        return ""
    effect = unexplained(found.residual, found.residual_given)
    if found.signs.torque == found.signs.position == (1, -1):
        first, second = names
        return (
            f"The direction of {first} or {second} is probably wrong: with the angle and torque of {second} reversed, "
            f"{effect}. With torque off, turn both joints by hand in the same direction. If one angle increases and "
            "the other decreases, correct direction (and zero_ticks) of the joint whose angle changes the wrong way."
        )
    said = reversal_said(found.signs, names)
    return f"{said[0].upper()}{said[1:]}, {effect}. Check the wiring of the motors, direction and torque_constant."
