"""Typical arms drawn from a documented distribution, as the TOML files that `hil init` would write.

models          XM430-W350, XM540-W270, XL330-M288, XC330-T288, XL430-W250 (voltage-driven), equally likely;
                half of the two-joint arms with an XM540 shoulder have an XM430 elbow
joints          one (30 %) or two
orientation     hanging 50 %, tilted by 10 to 60 degrees 20 %, flat 15 %, upright 15 %
links           length 0.08 to 0.20 m and 0.5 to 2.2 kg/m, both times (stall torque / 4.1 N m)^0.4; centre of mass at
                0.4 to 0.9 of the length; inertia 0.5 to 1.6 times that of a rod. Redrawn if gravity at full stretch
                exceeds 18 % of the stall torque.
Coulomb         0.8 to 3 % of stall torque; 330 series and XL430 up to 7 %; independent for each joint
Stribeck        rise 0 to 0.6, velocity 0.05 to 0.3 rad/s; viscous 0.3 to 2 % of stall per rad/s; offset up to 15 % of
                Coulomb; armature 1.2 to 5 g m^2 per N m of stall; current lag 0.3 to 2 ms
richer friction a third of the arms have one to three of these effects: load dependence of 0.02 to 0.08; ripple of 0.3
                to 2 % (5 to 11 cycles); presliding over 0.5 to 5 mrad
zeros           each off by 1 to 2 degrees in either direction
torque constant each off by up to 12 %, uniformly distributed
rest            each joint starts up to 4 degrees from its rest pose, but only as far as friction can hold it
imperfect       each in a third of the arms: friction that falls by 5 to 20 % as grease warms; encoder noise of 0.2 to
                0.6 steps; once- and twice-per-turn encoder errors of up to 4 and 2 steps
limits          what `hil init` writes: 30 % of stall current or voltage, 10 rad/s, swing of 60 to 120 degrees
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from hil.drivers.servo_model import Mode, ServoModel, servo_model
from hil.fakes.servo.registers import load_model
from hil.setup.config_template import STANDARD_GRAVITY, ArmAnswers, JointAnswers, arm_toml

MODELS = ("XM430-W350", "XM540-W270", "XL330-M288", "XC330-T288", "XL430-W250")
SMALL = ("XL330-M288", "XC330-T288", "XL430-W250")
ORIENTATIONS = {"hanging": 0.5, "tilted": 0.2, "flat": 0.15, "upright": 0.15}
SERVO_MASS = {"XM430": 0.082, "XM540": 0.165, "XL330": 0.018, "XC330": 0.023, "XL430": 0.0572}
GEAR_RATIO = {"XM430": 353.5, "XM540": 272.5, "XL330": 288.35, "XC330": 288.35, "XL430": 258.5}
REFERENCE_STALL = 4.1  # N m
MOST_GRAVITY = 0.18  # relative to the stall torque, at full stretch
DEGREE = math.pi / 180


@dataclass(frozen=True)
class DrawnArm:
    """A drawn arm: its name, its file, and its torque unit.

    units: ratio of assumed to true torque constant of the first joint. All identified torques are in these units.
    """

    name: str
    toml: str
    units: float
    has_current: bool


def draw(seed: int) -> DrawnArm:
    """Draw the arm for this seed."""
    random = np.random.default_rng((13, seed))
    joints = 1 if random.random() < 0.3 else 2
    models = _models(random, joints)
    orientation, tilt, rest, weight = stance(random, ORIENTATIONS, (10, 60))
    while True:
        links = _links(random, models)
        if _holding_torque(links, models) <= MOST_GRAVITY * stall_torque(models[0]):
            break
    richer = _richer(random)
    scale = random.uniform(0.88, 1.12, joints)
    drives = [_drive(random, model, factor, richer) for model, factor in zip(models, scale, strict=True)]
    warming, encoder = _warming(random), _encoder(random)
    drives = [drive | warming for drive in drives]
    zeros = random.uniform(1, 2, joints) * random.choice((-1, 1), joints) * DEGREE
    start = _start(random, rest, links, drives, weight)
    counts = [2048 + round(zero / model.position_unit) for zero, model in zip(zeros, models, strict=True)]
    answers = joint_answers(random, models, links, counts, rest)
    head = f"Arm {seed} of the population."
    gravity = 0.0 if orientation == "flat" else round(weight, 3)
    text = arm_toml(ArmAnswers("fake://", 1_000_000, answers, gravity, head))
    name = f"{orientation} {joints}x{'+'.join(dict.fromkeys(model.name for model in models))}"
    imperfect = [*richer, *("warming",)[: bool(warming)], *dict.fromkeys(key.split("_")[0] for key in encoder)]
    name += "".join(f" {term}" for term in imperfect)
    fake = _fake(seed, models, links, drives, start, tilt, encoder)
    return DrawnArm(name, text + fake, float(1 / scale[0]), models[0].default_mode is Mode.CURRENT)


def _models(random: np.random.Generator, joints: int) -> list[ServoModel]:
    first = str(random.choice(MODELS))
    second = "XM430-W350" if first == "XM540-W270" and random.random() < 0.5 else first
    return [servo_model(name) for name in (first, second)[:joints]]


class Stance(NamedTuple):
    """How an arm is mounted.

    tilt: angle between its plane and the vertical [rad]. rest: rest angle of joint 1 [rad]. weight: gravity in the
    plane [m/s^2].
    """

    orientation: str
    tilt: float
    rest: float
    weight: float


def stance(random: np.random.Generator, shares: Mapping[str, float], degrees: tuple[float, float]) -> Stance:
    """Draw how an arm is mounted. shares: probability of each orientation. degrees: smallest and largest tilt."""
    orientation = str(random.choice(list(shares), p=list(shares.values())))
    tilt = DEGREE * random.uniform(*degrees) if orientation == "tilted" else math.pi / 2 * (orientation == "flat")
    rest = {"flat": 0.0, "upright": math.pi / 2}.get(orientation, -math.pi / 2)
    return Stance(orientation, tilt, rest, 0.0 if orientation == "flat" else STANDARD_GRAVITY * math.cos(tilt))


def joint_answers(
    random: np.random.Generator,
    models: Sequence[ServoModel],
    links: Sequence[Mapping[str, float]],
    counts: Sequence[int],
    rest: float,
) -> tuple[JointAnswers, ...]:
    """Return a person's answers to `hil init`. counts: what each encoder reads at its joint's zero [steps]."""
    return tuple(
        JointAnswers(
            ("shoulder", "elbow")[i],
            i + 1,
            model.name,
            counts[i],
            rest if i == 0 else 0.0,
            swing=float(random.uniform(60, 120)) * DEGREE,
            length=round(links[i]["length"], 3),
        )
        for i, model in enumerate(models)
    )


def stall_torque(model: ServoModel) -> float:
    """Stall torque at the median of the published voltages [N m]."""
    return sorted(each.torque for each in model.stalls)[len(model.stalls) // 2]


def _links(random: np.random.Generator, models: list[ServoModel]) -> list[dict[str, float]]:
    links = []
    for model in models:
        size = (stall_torque(model) / REFERENCE_STALL) ** 0.4
        length = size * random.uniform(0.08, 0.20)
        mass = length * size * math.exp(random.uniform(math.log(0.5), math.log(2.2)))
        centre = length * random.uniform(0.4, 0.9)
        inertia = mass * length**2 / 12 * random.uniform(0.5, 1.6)
        links.append({"length": length, "mass": mass, "centre": centre, "inertia": inertia})
    return links


def _servo_mass(model: ServoModel) -> float:
    return SERVO_MASS[model.name.split("-")[0]]


def _holding_torque(links: list[dict[str, float]], models: list[ServoModel]) -> float:
    """Gravity torque at joint 1 with the arm stretched out horizontally [N m]."""
    held = links[0]["mass"] * links[0]["centre"]
    if len(links) == 2:
        reach = links[0]["length"]
        held += _servo_mass(models[1]) * reach + links[1]["mass"] * (reach + links[1]["centre"])
    return STANDARD_GRAVITY * held


def _richer(random: np.random.Generator) -> list[str]:
    """Draw the additional friction effects, which a third of the arms have."""
    if random.random() > 1 / 3:
        return []
    count = int(random.integers(1, 4))
    return sorted(random.choice(("load", "ripple", "presliding"), count, replace=False).tolist())


def _drive(random: np.random.Generator, model: ServoModel, factor: float, richer: list[str]) -> dict[str, Any]:
    stall, family = stall_torque(model), model.name.split("-")[0]
    most = 0.07 if model.name in SMALL else 0.03
    coulomb = stall * math.exp(random.uniform(math.log(0.008), math.log(most)))
    facts = load_model(model.name)
    pwm = model.default_mode is Mode.PWM
    constant = model.torque_per_volt.value * facts.resistance_ohm if pwm else model.torque_per_ampere.value
    drive: dict[str, Any] = {
        "mass": _servo_mass(model),
        "rotor_inertia": stall * random.uniform(1.2e-3, 5e-3) / GEAR_RATIO[family] ** 2,
        "gear_ratio": GEAR_RATIO[family],
        # Rounded like in the file of `hil init`.
        "torque_constant": factor * float(f"{constant:.3g}"),
        "current_lag": random.uniform(0.3e-3, 2e-3),
        "viscous": stall * random.uniform(0.003, 0.02),
        "coulomb": coulomb,
        "stribeck_rise": random.uniform(0.0, 0.6),
        "stribeck_velocity": random.uniform(0.05, 0.3),
        "offset": coulomb * random.uniform(-0.15, 0.15),
    }
    if pwm:
        per_volt = float(f"{model.torque_per_volt.value:.3g}")
        drive["torque_constant"] = factor * per_volt * facts.resistance_ohm
    if "load" in richer:
        drive["load"] = random.uniform(0.02, 0.08)
    if "ripple" in richer:
        drive |= {"ripple": random.uniform(0.003, 0.02), "ripple_cycles": float(random.integers(5, 12))}
    if "presliding" in richer:
        stiffness = coulomb / math.exp(random.uniform(math.log(0.5e-3), math.log(5e-3)))
        drive |= {"presliding_stiffness": stiffness, "presliding_damping": stiffness * random.uniform(0.01, 0.03)}
    return drive


def _warming(random: np.random.Generator) -> dict[str, float]:
    """Draw the warm-up of friction, which a third of the arms have."""
    cold, seconds = random.uniform(0.05, 0.2), random.uniform(30, 120)
    if random.random() > 1 / 3:
        return {}
    return {"cold_coulomb": cold, "cold_viscous": cold, "warm_up_time": seconds}


def _encoder(random: np.random.Generator) -> dict[str, float]:
    """Draw encoder errors: a third of the arms have noise, and a third have nonlinearity."""
    noisy, bent = random.random(2) < 1 / 3
    encoder = {"noise_ticks": random.uniform(0.2, 0.6)} if noisy else {}
    if bent:
        encoder |= {
            "once_ticks": random.uniform(0, 4),
            "once_phase": random.uniform(0, 2 * math.pi),
            "twice_ticks": random.uniform(0, 2),
            "twice_phase": random.uniform(0, 2 * math.pi),
        }
    return encoder


def _start(
    random: np.random.Generator,
    rest: float,
    links: list[dict[str, float]],
    drives: list[dict[str, Any]],
    weight: float,
) -> list[float]:
    """Draw the initial pose [rad]: within 4 degrees of the rest pose, and within half the deflection at which friction
    can still hold the joint.
    """
    start = []
    for i, drive in enumerate(drives):
        moment = sum(link["mass"] * link["centre"] for link in links[i:])
        moment += links[0]["length"] * (links[1]["mass"] + drives[1]["mass"]) if i == 0 and len(links) == 2 else 0.0
        held = 0.5 * drive["coulomb"] / max(moment * weight, 1e-9)
        most = min(4 * DEGREE, held)
        start.append((rest if i == 0 else 0.0) + random.uniform(-most, most))
    return start


def _fake(
    seed: int,
    models: list[ServoModel],
    links: list[dict[str, float]],
    drives: list[dict[str, Any]],
    start: list[float],
    tilt: float,
    encoder: dict[str, float],
) -> str:
    lines = ["", "[fake]", f"seed = {seed}", "adapter_latency_us = 60.0"]
    for i, model in enumerate(models, start=1):
        lines += ["", "[[fake.servos]]", f"id = {i}", f'model = "{model.name}"', "zero_ticks = 2048"]
        if encoder:
            lines.append(f"encoder = {{ {', '.join(f'{name} = {value!r}' for name, value in encoder.items())} }}")
    lines += ["", "[fake.arm]", f"tilt = {tilt}", f"start = {start}"]
    for table, parts in (("links", links), ("drives", drives)):
        for part in parts:
            lines += ["", f"[[fake.arm.{table}]]", *(f"{name} = {float(value)!r}" for name, value in part.items())]
    return "\n".join(lines) + "\n"
