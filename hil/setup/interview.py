"""The questions of `hil init`, which reads what it can from the bus. Nothing is written to a servo."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from hil.drivers.control_table import load_control_table
from hil.drivers.port import Port
from hil.drivers.preparation.unsuitable import APPLY_HOMING, ignored_homing, unsuitable_drive_mode
from hil.drivers.servo import Servo
from hil.drivers.servo_model import SERVO_MODELS, servo_model
from hil.errors import ExperimentError
from hil.setup.config_template import STANDARD_GRAVITY, ArmAnswers, JointAnswers, usual_length
from hil.setup.scan import Found, Heard

Ask = Callable[[str, str], str]
"""Ask a question with a default answer; return the answer."""
Say = Callable[[str], None]

_NAMES = ("shoulder", "elbow")
_MOVED_TICKS = 30
_MOST_SWING = 175.0  # degrees
_MOST_TILT = 85.0  # degrees; beyond this, the arm counts as flat
_LENGTHS_MM = (10.0, 2000.0)
HANGING, UPRIGHT, FLAT = "hanging", "upright", "flat"
_REST = {HANGING: -math.pi / 2, UPRIGHT: math.pi / 2, FLAT: 0.0}
"""Angle of the first joint at rest [rad]."""
_POSE = {
    HANGING: "Let the arm hang at rest, and press Enter",
    UPRIGHT: "Hold the arm upright and straight, and press Enter",
    FLAT: "Lay the arm out straight, in the middle of its range, and press Enter",
}


def interview(port: Port, url: str, heard: Sequence[Heard], ask: Ask, say: Say) -> ArmAnswers:
    """Ask about the arm on an open port, given the result of a scan. Raises ExperimentError if no arm is usable."""
    baud, servos = _one_baud(heard)
    port.set_baud(baud)
    chosen = _choose(servos, ask, say)
    handles = [Servo(port, found.id, load_control_table(str(found.model))) for found in chosen]
    if left := [f"ID {each.id}: {each.left}" for each in chosen if each.left]:
        restore = next((f" Type: {each.restore}" for each in chosen if each.restore), "")
        raise ExperimentError(f"{' '.join(left)}{restore}")
    for servo in handles:
        if servo.read("Torque Enable"):
            raise ExperimentError(f"{servo.title} still has its torque on. Power-cycle it, then start again.")
    if modes := [f"{one.title}: {mode}" for one in handles if (mode := unsuitable_drive_mode(one)) is not None]:
        raise ExperimentError(
            f"Drive Mode must be 0; otherwise directions and zeros found now will be wrong later ({'; '.join(modes)}). "
            "Set it to 0 with DYNAMIXEL Wizard 2.0, then run the same command again."
        )
    if homing := [f"{one.title}: {offset}" for one in handles if (offset := ignored_homing(one))]:
        raise ExperimentError(
            f"Homing Offset is currently ignored ({'; '.join(homing)}). {APPLY_HOMING}, with hil init."
        )
    names = _different_names(chosen, ask, say)
    stance = _stance(ask, say)
    tilt = (
        0.0
        if stance == FLAT
        else math.radians(
            _number(
                "By how many degrees is the arm's plane of motion tilted from the vertical",
                "0",
                (0.0, _MOST_TILT),
                ask,
                say,
            )
        )
    )
    directions = [_direction(servo, name, ask, say) for servo, name in zip(handles, names, strict=True)]
    hanging = _at_rest(handles, names, stance, ask, say)
    joints = []
    for number, (found, name) in enumerate(zip(chosen, names, strict=True)):
        rest = _REST[stance] if number == 0 else 0.0
        unit = directions[number] * servo_model(str(found.model)).position_unit
        zero = hanging[number] - round(rest / unit)
        beyond = "the tip" if number == len(chosen) - 1 else names[number + 1]
        usual = f"{1e3 * usual_length(str(found.model)):.0f}"
        length = 1e-3 * _number(f"Length from {name} to {beyond} in mm", usual, _LENGTHS_MM, ask, say)
        question = f"How far may {name} swing from its rest angle to either side, in degrees"
        swing = math.radians(_number(question, "90", (5.0, _MOST_SWING), ask, say))
        answers = JointAnswers(name, found.id, str(found.model), zero, rest, directions[number], swing, length)
        joints.append(replace(answers, voltage=found.voltage))
    head = (
        "Written by hil init. Before the first run: read each line, then run `hil check` on this file.\n"
        "NOT yet run on this arm: the limits are conservative guesses from the servo models."
    )
    gravity = 0.0 if stance == FLAT else round(STANDARD_GRAVITY * math.cos(tilt), 3)
    return ArmAnswers(url, baud, tuple(joints), gravity, head)


def _at_rest(handles: Sequence[Servo], names: Sequence[str], stance: str, ask: Ask, say: Say) -> list[int]:
    """Return the Present Positions in the rest pose. Friction may hold the joints of a hanging arm away from the
    vertical, so they are read again after each has been pushed to the other side.
    """
    ask(_POSE[stance], "")
    first = [servo.read("Present Position") for servo in handles]
    if stance != HANGING:
        return first
    ask(
        "Friction may hold the arm to one side: push each joint slightly to the other side, let go, and press Enter", ""
    )
    second = [servo.read("Present Position") for servo in handles]
    for name, before, after in zip(names, first, second, strict=True):
        if abs(after - before) > _MOVED_TICKS:
            say(
                f"{name} came to rest at two positions {abs(after - before)} steps apart, because friction holds it. "
                "Their midpoint is taken as hanging straight down; if it is not, correct zero_ticks in the file."
            )
    return [round((before + after) / 2) for before, after in zip(first, second, strict=True)]


def _one_baud(heard: Sequence[Heard]) -> tuple[int, list[Found]]:
    """Return the baud rate at which servos of supported models answered, and these servos."""
    answered = {each.baud: [found for found in each.servos if found.model in SERVO_MODELS] for each in heard}
    usable = {baud: servos for baud, servos in answered.items() if servos}
    if not usable:
        raise ExperimentError(
            "No servo that hil can drive answered. Try `hil scan`; supported models: " + ", ".join(SERVO_MODELS) + "."
        )
    if len(usable) > 1:
        found = "; ".join(f"{baud}: ID {', '.join(str(one.id) for one in servos)}" for baud, servos in usable.items())
        raise ExperimentError(
            f"Servos answer at more than one baud rate ({found}). Set them all to the same rate with hil setup."
        )
    return next(iter(usable.items()))


def _choose(servos: list[Found], ask: Ask, say: Say) -> list[Found]:
    by_id = {found.id: found for found in servos}
    listed = ", ".join(f"{found.id} ({found.model})" for found in servos)
    usual = " ".join(str(found.id) for found in servos[:2])
    while True:
        answer = ask(f"IDs of the arm's joints (one or two), from the base outwards; found: {listed}", usual)
        words = answer.replace(",", " ").split()
        if 1 <= len(words) <= 2 and len(set(words)) == len(words) and all(_known(word, by_id) for word in words):
            _say_who_is_left_out([each for number, each in by_id.items() if str(number) not in words], say)
            return [by_id[int(word)] for word in words]
        say(f"{answer!r}: enter one or two different IDs from {', '.join(map(str, by_id))}; for example: {usual}")


def _say_who_is_left_out(others: Sequence[Found], say: Say) -> None:
    if others:
        ids = ", ".join(str(found.id) for found in others)
        say(
            f"LEFT OUT: ID {ids}. hil init describes planar arms of one or two joints; the other servos are neither "
            "read nor moved, so hold or clamp their joints. An arm with more joints, or one that is not planar, needs "
            "its URDF or MJCF: copy configs/open_manipulator_x.toml, name the description in [arm] urdf, then type: "
            "hil pose YOUR_FILE.toml"
        )


def _known(word: str, by_id: dict[int, Found]) -> bool:
    return word.isdecimal() and int(word) in by_id


def _different_names(chosen: Sequence[Found], ask: Ask, say: Say) -> list[str]:
    """Ask for the name of each joint, again if another joint has it."""
    names: list[str] = []
    for number, found in enumerate(chosen):
        usual = next(each for each in (*_NAMES[number:], *_NAMES) if each not in names)
        while (name := ask(f"Name of the joint with ID {found.id}", usual)[:20] or usual) in names:
            say(f"Another joint is already named {name}: give this one a different name.")
        names.append(name)
    return names


def _direction(servo: Servo, name: str, ask: Ask, say: Say) -> int:
    """Determine in which direction Present Position increases; return +1 if counter-clockwise, otherwise -1.

    The arm is viewed from the side from which it points to the right when it is lifted from its hanging pose.
    """
    before = servo.read("Present Position")
    given = {"1": 1, "+1": 1, "-1": -1}
    turn = f"Turn {name} slightly counter-clockwise by hand, at most a quarter turn, hold it there and press Enter"
    again = f"{name} did not move. {turn}; or type its direction, 1 or -1, if you know it"
    for question, usual in ((turn, ""), (again, "1")):
        answer = ask(question, usual)
        moved = servo.read("Present Position") - before
        if abs(moved) >= _MOVED_TICKS:
            return 1 if moved > 0 else -1
    while answer not in given:
        answer = ask(f"{answer!r}: {name} did not move; type its direction, 1 or -1 (1 if you do not know it)", "1")
    say(f"{name} did not move: direction = {answer}. Correct it in the file if the servo turns the other way.")
    return given[answer]


def _stance(ask: Ask, say: Say) -> str:
    question = "Is the arm hanging (it comes to rest by itself), upright (it would fall over) or flat (horizontal)"
    while True:
        answer = ask(question, HANGING).lower()
        if answer in _REST:
            return answer
        say(f"{answer!r}: enter one of {', '.join(_REST)}")


def _number(question: str, usual: str, bounds: tuple[float, float], ask: Ask, say: Say) -> float:
    low, high = bounds
    while True:
        answer = ask(question, usual)
        try:
            number = float(answer)
        except ValueError:
            number = math.nan
        if low <= number <= high:
            return number
        say(f"{answer!r}: enter a number from {low:g} to {high:g}")
