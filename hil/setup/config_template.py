"""Generate an arm's TOML file, with comments, from `ArmAnswers`."""

import json
import math
from dataclasses import dataclass

from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode, Published, servo_model
from hil.drivers.servo_prior import stall_torque

STANDARD_GRAVITY = 9.81
_OF_STALL = 0.3  # initial limit, as a fraction of the stall current or the supply voltage
_FASTEST = 10.0  # rad/s, initial limit of servos that could turn faster
_USUAL_STALL = 4.1  # N m, stall torque of an XM430
_CYCLE_BYTES = 39  # per servo on the wire: goal, request and reply
RATES = (400, 300, 250, 200, 160, 125, 100, 80, 64, 50, 40, 32, 25, 20)
"""Sample rates [Hz] for a new file. They are so closely spaced that rounding down to one of them costs at most a
quarter of the possible rate.
"""


@dataclass(frozen=True)
class JointAnswers:
    """Answers about one joint.

    rest: angle at rest [rad]. swing: allowed deviation from rest to either side [rad]. length: distance from this joint
    to the next one, or to the tip [m]. voltage: supply voltage of its servo [V]; None if it was not read.
    """

    name: str
    id: int
    model: str
    zero_ticks: int
    rest: float
    direction: int = 1
    swing: float = math.pi / 2
    length: float = 0.12
    voltage: float | None = None

    @property
    def joint(self) -> Joint:
        servo = servo_model(self.model)
        return Joint(self.name, self.id, servo, self.direction, self.zero_ticks, servo.default_mode)


@dataclass(frozen=True)
class MeasuredBus:
    """Result of measuring the bus.

    rate: sample rate to use [Hz]. sustained: the rate that the bus can sustain [Hz]. one_write, fast: values of
    port.one_write and port.fast_sync_read during the measurement.
    """

    rate: float
    sustained: float
    one_write: bool
    fast: bool


@dataclass(frozen=True)
class ArmAnswers:
    """Answers about one arm.

    gravity: component of gravity in the plane of the arm [m/s^2]. head: comment at the top of the file. measured:
    result of measuring the bus; without it, the sample rate follows from the baud rate.
    """

    url: str
    baud: int
    joints: tuple[JointAnswers, ...]
    gravity: float
    head: str
    measured: MeasuredBus | None = None


def usual_length(model: str) -> float:
    """Typical length [m] of a link that is driven by a servo of this model; used as the default answer."""
    stall: float = stall_torque(servo_model(model))
    return float(round(0.13 * (stall / _USUAL_STALL) ** 0.4, 2))


def arm_toml(arm: ArmAnswers) -> str:
    rate = _rate(arm) if arm.measured is None else arm.measured.rate
    head = [f"# {line}" for line in arm.head.splitlines()]
    port = ["[port]", f"url = {json.dumps(arm.url)}", f"baud = {arm.baud}", *_exchange(arm)]
    mechanism = [
        "[arm]",
        _line(f"gravity = {arm.gravity:g}", "m/s^2; 0 if the arm moves in a horizontal plane"),
        _line(f"rest_pose = {_list([joint.rest for joint in arm.joints], 4)}", _rest_meaning(arm)),
        _line(
            f"link_lengths = {_list([joint.length for joint in arm.joints], 3)}", "m: joint to joint, and to the tip"
        ),
    ]
    experiment = [
        "[experiment]",
        _line(f"rate = {rate:.1f}", _rate_meaning(arm)),
        _line("period = 10.0", "s"),
        _line(
            f"band = [0.1, {min(5.0, rate / 20):.1f}]",
            "Hz: excitation band; its spectral lines are assigned to the joints in turn",
        ),
        _line("pilot = true", "finds the torque: starts with a small one and raises it up to the limits"),
        _line("ramp = 1.0", "s, torque ramp at start and end"),
        "seed = 1",
    ]
    model = [
        "[model]",
        _line('friction = "auto"', "tries several friction models and keeps the one that predicts best"),
        _line('drive = "lag"', '"delay": a pure delay instead of a current loop'),
    ]
    if len(arm.joints) == 2:
        model.append(_line("torque_scale = true", "estimates the second torque constant relative to the first"))
    safety = ["[safety]", _line("watchdog = 0.08", "s, time without packets after which a servo stops by itself")]
    tables = [head, port, *(_joint(joint) for joint in arm.joints), mechanism, experiment, model, safety]
    return "\n\n".join("\n".join(table) for table in tables) + "\n"


def _line(setting: str, meaning: str) -> str:
    return f"{setting:<30} # {meaning}"


def _joint(answers: JointAnswers) -> list[str]:
    servo = servo_model(answers.model)
    pwm = servo.default_mode is Mode.PWM
    published = servo.torque_per_volt if pwm else servo.torque_per_ampere
    constant, limit = ("torque_per_volt", "voltage_limit") if pwm else ("torque_constant", "current_limit")
    unit = "V" if pwm else "A"
    figures = f"{published.low:.3g} to {published.high:.3g}" if published.high > published.low else "a single value"
    ends = [answers.rest - answers.swing, answers.rest + answers.swing]
    return [
        "[[joints]]",
        f"name = {json.dumps(answers.name, ensure_ascii=False)}",
        f"id = {answers.id}",
        f"model = {json.dumps(answers.model)}",
        _line(f"direction = {answers.direction}", "-1 where the servo turns opposite to the joint"),
        _line(f"zero_ticks = {answers.zero_ticks}", "Present Position where the joint's angle is 0"),
        _line(f"{constant} = {published.value:.3g}", f"N m/{unit} at the output shaft; published: {figures}"),
        _line(
            f"{constant}_std = {_spread(published):.2g}",
            "all identified values of the joint scale with this constant",
        ),
        _line(f"position_limit = {_list(ends, 2)}", "rad"),
        _line(f"velocity_limit = {_velocity_limit(answers):g}", "rad/s"),
        _line(f"{limit} = {_goal_limit(answers):.2g}", f"{unit}: {_OF_STALL * 100:.0f} % of stall"),
    ]


def _spread(published: Published) -> float:
    """Standard deviation of a published constant: half the published range, but at least a tenth of the value."""
    return max(0.1 * published.value, (published.high - published.low) / 2)


def _velocity_limit(answers: JointAnswers) -> float:
    """Initial velocity limit [rad/s]: at most the no-load speed at the supply voltage."""
    servo = servo_model(answers.model)
    volts = servo.no_load.voltage if answers.voltage is None else answers.voltage
    fastest = volts / servo.back_emf
    return min(_FASTEST, math.floor(10.0 * fastest) / 10.0)


def _goal_limit(answers: JointAnswers) -> float:
    """Initial goal limit [A or V]: a fraction of the stall value at the nominal supply voltage."""
    servo = servo_model(answers.model)
    stall = servo.stalls[len(servo.stalls) // 2]
    most = _OF_STALL * (stall.voltage if servo.default_mode is Mode.PWM else stall.current)
    return float(f"{most:.2g}")


def _rest_meaning(arm: ArmAnswers) -> str:
    if not arm.gravity:
        return "rad: the joint's angle at the start; hil keeps the arm near this pose"
    if arm.joints[0].rest > 0:
        return "rad: upright; support it by hand until hil holds it, and again at the end"
    return "rad: where it hangs; hil checks this first"


def _rate(arm: ArmAnswers) -> float:
    """Return the highest of `RATES` at which the bus is idle at least half of the time."""
    cycle = _CYCLE_BYTES * len(arm.joints) * 10 / arm.baud + 0.4e-3
    return float(next((rate for rate in RATES if 2 * cycle < 1 / rate), RATES[-1]))


def _rate_meaning(arm: ArmAnswers) -> str:
    if arm.measured is None:
        return "samples per second, not measured; hil check measures what this bus can sustain"
    return f"samples per second; this bus was measured to sustain {arm.measured.sustained:.0f}"


def _exchange(arm: ArmAnswers) -> list[str]:
    """Return the [port] settings that the measured rate requires, except those that are the default."""
    if arm.measured is None:
        return []
    one_write = [] if arm.measured.one_write else [_line("one_write = false", "this bus is faster with two writes")]
    fast = [] if arm.measured.fast else [_line("fast_sync_read = false", "this bus is faster with Sync Read")]
    return one_write + fast


def _list(values: list[float], decimals: int) -> str:
    return f"[{', '.join(f'{value:.{decimals}f}' for value in values)}]"
