"""Arms from a second, wider distribution than that of population_arms.py: arms that other people might build.

models          any of seven, including the voltage-driven XL430; three in ten two-joint arms mix two models
joints          one (30 %) or two
orientation     hanging 40 %, tilted by 20 to 70 degrees 20 %, flat 20 %, upright 20 %
links           the first 0.06 to 0.25 m for an XM430, the second 0.3 to 3 times as long; both scaled by
                (stall torque)^0.4; 0.3 to 1.5 kg/m; half carry a payload of up to the link's mass at their end. Redrawn
                if gravity at full stretch exceeds 20 % of stall at any joint.
friction        Coulomb 0.5 to 7 % of stall, log-uniform; Stribeck rise 0 to 0.5 at 0.03 to 0.4 rad/s;
                viscous 0.1 to 4 % of stall per rad/s; offset up to 25 % of Coulomb; armature 0.8 to 6 g m^2 per N m
richer friction each in one in six arms: load dependence of 0.02 to 0.1; ripple of 0.5 to 2.5 % (3 to 16 cycles);
                presliding over 0.3 to 6 mrad
cable           one in six: up to 3 % of stall per radian, rest angle up to 0.5 rad away
torque          one in six saturates by up to 4 % at the current limit
backlash        one in ten: 0.3 to 1 mrad
warming         a quarter of the arms: friction falls by 3 to 25 % within 20 to 200 s
encoder         noise of up to 0.8 steps (a third), once- and twice-per-turn errors of up to 3 and 1.5 steps (a
                quarter), independent for each joint
rest            zeros off by up to 2.5 degrees; arm up to 6 degrees from its rest pose, held there by friction; servo
                zeros anywhere in a turn
experiment      rate 50 to 500 Hz, period 8 to 16 s, limits of 50 to 130 degrees, independent on each side
"""

import math
from typing import Any

import numpy as np

from benchmarks.drawn_arms.population_arms import (
    DEGREE,
    REFERENCE_STALL,
    SERVO_MASS,
    DrawnArm,
    joint_answers,
    stall_torque,
    stance,
)
from hil.drivers.servo_model import Mode, ServoModel, servo_model
from hil.fakes.servo.registers import load_model
from hil.setup.config_template import STANDARD_GRAVITY, ArmAnswers, JointAnswers, arm_toml

MODELS = ("XM430-W350", "XM430-W210", "XM540-W270", "XL330-M288", "XC330-T288", "XL430-W250", "XH430-W350")
MIXED = 0.3
ORIENTATIONS = {"hanging": 0.4, "tilted": 0.2, "flat": 0.2, "upright": 0.2}
GEAR_RATIO = 300.0
MOST_GRAVITY = 0.2
TURN = 4096


def draw(seed: int) -> DrawnArm:
    """Draw the arm for this seed."""
    random = np.random.default_rng((29, seed))
    joints = 1 if random.random() < 0.3 else 2
    models = _models(random, joints)
    orientation, tilt, rest, weight = stance(random, ORIENTATIONS, (20, 70))
    links = _links(random, models)
    while not _is_light(links, models):
        links = _links(random, models)
    scale = random.uniform(0.88, 1.12, joints)
    richer = [name for name in ("load", "ripple", "presliding", "cable", "saturation") if random.random() < 0.16]
    richer += ["backlash"] if random.random() < 0.1 and "presliding" not in richer else []
    drives = [_drive(random, model, factor, richer) for model, factor in zip(models, scale, strict=True)]
    if random.random() < 0.25:
        cold, seconds = random.uniform(0.03, 0.25), random.uniform(20, 200)
        drives = [drive | {"cold_coulomb": cold, "cold_viscous": cold, "warm_up_time": seconds} for drive in drives]
        richer.append("warming")
    encoders, kinds = _encoders(random, joints)
    counts = random.integers(600, TURN - 600, joints)
    zeros = random.uniform(-2.5, 2.5, joints) * DEGREE
    at_zero = [int(counts[i]) + round(zeros[i] / model.position_unit) for i, model in enumerate(models)]
    answers = joint_answers(random, models, links, at_zero, rest)
    start = [rest * (i == 0) + _held(random, drives[i], links, models, i, weight) for i in range(joints)]
    text = arm_toml(ArmAnswers("fake://", 1_000_000, answers, round(weight, 3), f"Arm {seed} of the others."))
    text = _other_experiment(random, text, answers)
    name = " ".join((orientation, f"{joints}x{'+'.join(dict.fromkeys(m.name for m in models))}", *richer, *kinds))
    fake = _fake(seed, models, links, drives, start, tilt, counts, encoders)
    has_current = all(model.default_mode is Mode.CURRENT for model in models)
    return DrawnArm(name, text + fake, float(1 / scale[0]), has_current)


def _models(random: np.random.Generator, joints: int) -> list[ServoModel]:
    first = str(random.choice(MODELS))
    second = str(random.choice(MODELS)) if random.random() < MIXED else first
    return [servo_model(name) for name in (first, second)[:joints]]


def _links(random: np.random.Generator, models: list[ServoModel]) -> list[dict[str, float]]:
    ratio = math.exp(random.uniform(math.log(0.3), math.log(3.0)))
    first = math.exp(random.uniform(math.log(0.06), math.log(0.25)))
    links = []
    for model, bare in zip(models, (first, first * ratio), strict=False):
        size = (stall_torque(model) / REFERENCE_STALL) ** 0.4
        length = min(max(size * bare, 0.02), 0.4)
        mass = length * size * random.uniform(0.3, 1.5)
        payload = mass * random.uniform(0.0, 1.0) * (random.random() < 0.5)
        centre = length * random.uniform(0.35, 0.6)
        both = (mass * centre + payload * length) / (mass + payload)
        inertia = mass * (length**2 / 12 + (centre - both) ** 2) + payload * (length - both) ** 2
        links.append({"length": length, "mass": mass + payload, "centre": both, "inertia": inertia})
    return links


def _moment(links: list[dict[str, float]], models: list[ServoModel], joint: int) -> float:
    """First moment about a joint with the arm stretched out [kg m]."""
    own = links[joint]["mass"] * links[joint]["centre"]
    if joint + 1 == len(links):
        return own
    reach = links[joint]["length"]
    return own + _mass(models[1]) * reach + links[1]["mass"] * (reach + links[1]["centre"])


def _is_light(links: list[dict[str, float]], models: list[ServoModel]) -> bool:
    each = zip(range(len(links)), models, strict=True)
    return all(STANDARD_GRAVITY * _moment(links, models, i) <= MOST_GRAVITY * stall_torque(model) for i, model in each)


def _mass(model: ServoModel) -> float:
    return SERVO_MASS[model.name.split("-")[0].replace("XH430", "XM430")]


def _drive(random: np.random.Generator, model: ServoModel, factor: float, richer: list[str]) -> dict[str, Any]:
    def evenly(low: float, high: float) -> float:
        return math.exp(random.uniform(math.log(low), math.log(high)))

    stall, coulomb = stall_torque(model), stall_torque(model) * evenly(0.005, 0.07)
    pwm = model.default_mode is Mode.PWM
    constant = model.torque_per_ampere.value
    if pwm:
        constant = float(f"{model.torque_per_volt.value:.3g}") * load_model(model.name).resistance_ohm
    drive: dict[str, Any] = {
        "mass": _mass(model),
        "rotor_inertia": stall * evenly(0.8e-3, 6e-3) / GEAR_RATIO**2,
        "gear_ratio": GEAR_RATIO,
        "torque_constant": factor * (constant if pwm else float(f"{constant:.3g}")),
        "current_lag": random.uniform(0.2e-3, 2.5e-3),
        "viscous": stall * evenly(0.001, 0.04),
        "coulomb": coulomb,
        "stribeck_rise": random.uniform(0.0, 0.5),
        "stribeck_velocity": evenly(0.03, 0.4),
        "offset": coulomb * random.uniform(-0.25, 0.25),
    }
    if "load" in richer:
        drive["load"] = random.uniform(0.02, 0.1)
    if "ripple" in richer:
        drive |= {"ripple": random.uniform(0.005, 0.025), "ripple_cycles": float(random.integers(3, 17))}
    if "presliding" in richer:
        stiffness = coulomb / evenly(0.3e-3, 6e-3)
        drive |= {"presliding_stiffness": stiffness, "presliding_damping": stiffness * random.uniform(0.005, 0.03)}
    if "cable" in richer:
        drive |= {"cable_stiffness": stall * random.uniform(0, 0.03), "cable_angle": random.uniform(-0.5, 0.5)}
    if "saturation" in richer:
        most = 0.3 * stall / drive["torque_constant"]
        drive |= {"saturation": random.uniform(0, 0.04), "saturation_current": most}
    if "backlash" in richer:
        drive["backlash"] = random.uniform(0.3e-3, 1e-3)
    return drive


def _encoders(random: np.random.Generator, joints: int) -> tuple[list[dict[str, float]], list[str]]:
    noisy, bent = random.random() < 1 / 3, random.random() < 1 / 4
    encoders = []
    for _ in range(joints):
        encoder = {"noise_ticks": random.uniform(0.1, 0.8)} if noisy else {}
        for times, most in (("once", 3.0), ("twice", 1.5)) if bent else ():
            encoder |= {f"{times}_ticks": random.uniform(0, most), f"{times}_phase": random.uniform(0, 2 * math.pi)}
        encoders.append(encoder)
    return encoders, ["noise"] * noisy + ["bent"] * bent


def _held(
    random: np.random.Generator,
    drive: dict[str, Any],
    links: list[dict[str, float]],
    models: list[ServoModel],
    joint: int,
    weight: float,
) -> float:
    """Draw the initial pose [rad]: off the rest pose by at most 6 degrees, but only as far as friction can hold it."""
    held: float = 0.6 * drive["coulomb"] / max(_moment(links, models, joint) * weight, 1e-9)
    return float(random.uniform(-1, 1)) * min(6 * DEGREE, held)


def _other_experiment(random: np.random.Generator, text: str, answers: tuple[JointAnswers, ...]) -> str:
    rate = float(random.choice((50.0, 100.0, 200.0, 250.0, 400.0, 500.0)))
    period = float(random.integers(8, 17))
    top = min(5.0, rate / 20)
    lines = []
    sides = iter(tuple(random.uniform(50, 130, 2) * DEGREE) for _ in answers)
    rests = iter(answers)
    changed = {
        "rate": f"rate = {rate}",
        "period": f"period = {period}",
        "band": f"band = [{max(1 / period, 0.1):.4f}, {top}]",
    }
    for line in text.splitlines():
        key = line.split("=")[0].strip()
        if key == "position_limit":
            (below, above), rest = next(sides), next(rests).rest
            changed[key] = f"position_limit = [{rest - below:.2f}, {rest + above:.2f}]"
        lines.append(changed.get(key, line))
    return "\n".join(lines) + "\n"


def _fake(
    seed: int,
    models: list[ServoModel],
    links: list[dict[str, float]],
    drives: list[dict[str, Any]],
    start: list[float],
    tilt: float,
    counts: Any,
    encoders: list[dict[str, float]],
) -> str:
    lines = ["", "[fake]", f"seed = {seed}", "adapter_latency_us = 60.0"]
    for i, (model, encoder) in enumerate(zip(models, encoders, strict=True)):
        lines += ["", "[[fake.servos]]", f"id = {i + 1}", f'model = "{model.name}"', f"zero_ticks = {int(counts[i])}"]
        if encoder:
            lines.append(f"encoder = {{ {', '.join(f'{name} = {value!r}' for name, value in encoder.items())} }}")
    lines += ["", "[fake.arm]", f"tilt = {tilt}", f"start = {start}"]
    for table, parts in (("links", links), ("drives", drives)):
        for part in parts:
            lines += ["", f"[[fake.arm.{table}]]", *(f"{name} = {float(value)!r}" for name, value in part.items())]
    return "\n".join(lines) + "\n"
