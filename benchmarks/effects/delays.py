"""Estimates from recordings of planar arms whose joints have different delays: values, intervals and verdicts.

    python benchmarks/effects/delays.py [--json] [--arms 10] [--first 0] [--law delay|lag|logged] [--longest 3]

delay: each joint's torque comes late; lag: each joint's torque passes a first-order filter; logged: the position of
joint 2 is logged later than that of joint 1.

Each arm has links, friction and a multisine torque drawn at random. Its positions come from this script's own
equations of motion in absolute angles, integrated with steps of 20 us. Noise is added, and some recordings are rounded
to encoder steps. Each file is then estimated like any recording, with the default choices.
"""

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

import hil
from benchmarks.machine import machine
from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled, inner

LAWS = ("delay", "lag", "logged")
STEP_S = 2e-5
SECONDS = {100: 40.0, 200: 20.0, 500: 12.0}
"""Length of a recording by its rate [Hz]."""

FORMAT = """[columns]
between = "held"
zeros_unknown = false
zero = [0.0, 0.0]
time = "time"
position = ["q1 [rad]", "q2 [rad]"]
torque = ["tau1", "tau2"]
"""


@dataclass(frozen=True)
class Arm:
    """links: masses of links 1 and 2 and of the elbow [kg], length 1, centres of mass [m], inertias and armatures
    [kg m^2], gravity [m/s^2]. friction (2, 6): viscous, Coulomb, width, Stribeck rise and velocity, load dependence.
    """

    links: Array
    friction: Array

    def truth(self) -> dict[str, float]:
        """The parameters' values, by the names in result.json [SI units]."""
        m1, m2, elbow, length, c1, c2, j1, j2, a1, a2, g = self.links
        found = {
            "inertia_1": j1 + m1 * c1**2 + (m2 + elbow) * length**2 + a1,
            "coupling": m2 * length * c2,
            "inertia_2": j2 + m2 * c2**2,
            "armature_2": a2,
            "gravity_1": (m1 * c1 + (m2 + elbow) * length) * g,
            "gravity_2": m2 * c2 * g,
        }
        for joint, (viscous, coulomb, *_) in enumerate(self.friction, start=1):
            found |= {f"viscous_{joint}": viscous, f"coulomb_{joint}": coulomb, f"offset_{joint}": 0.0}
        return {name: float(value) for name, value in found.items()}


def drawn_arm(random: np.random.Generator) -> Arm:
    """Draw links of 0.12 to 0.3 m and one of three friction laws: two have a Stribeck rise, and one of these also
    depends on load."""
    m1, m2, elbow = random.uniform((0.1, 0.08, 0.06), (0.35, 0.3, 0.1))
    l1, l2 = random.uniform(0.12, 0.3, 2)
    c1, c2 = random.uniform(0.3, 0.6) * l1, random.uniform(0.35, 0.6) * l2
    armatures = random.uniform(0.003, 0.012, 2)
    links = np.array([m1, m2, elbow, l1, c1, c2, m1 * l1**2 / 12, m2 * l2**2 / 12, *armatures, 9.81])
    law = int(random.integers(3))
    low = (0.02, 0.02, 0.01, 0.15 * (law > 0), 0.1, 0.02 * (law > 1))
    high = (0.06, 0.07, 0.05, 0.5 * (law > 0), 0.3, 0.08 * (law > 1))
    return Arm(links, random.uniform(low, high, (2, 6)))


def drawn_torque(random: np.random.Generator, arm: Arm, rate: int) -> Array:
    """For each joint, ten sines from 0.15 to 4 Hz, with a peak of about the gravity torque (2, samples) [N m]."""
    time_s = np.arange(round(SECONDS[rate] * rate)) / rate
    truth = arm.truth()
    found = []
    for weight in (truth["gravity_1"] + truth["gravity_2"], truth["gravity_2"]):
        frequency, phase = random.uniform(0.15, 4.0, 10), random.uniform(0.0, 2 * np.pi, 10)
        sines = np.sin(2 * np.pi * frequency[:, None] * time_s + phase[:, None])
        wave = random.uniform(0.5, 1.0, 10) @ sines
        found.append(wave / np.abs(wave).max() * (random.uniform(0.7, 1.1) * weight + 0.15))
    return np.array(found)


@inner
def _loss(velocity: float, torque: float, law: Array) -> float:
    viscous, coulomb, width, rise, decay, load = law
    level = coulomb * (1.0 + rise * np.exp(-((velocity / decay) ** 2))) + load * abs(torque)
    return float(viscous * velocity + level * np.tanh(velocity / width))


@inner
def _rates(state: Array, torque: Array, links: Array, friction: Array) -> Array:
    """Derivative of joint angles and velocities, from Lagrange's equations in the links' absolute angles."""
    m1, m2, elbow, length, c1, c2, j1, j2, armature_1, armature_2, g = links
    angle, turned = state[0], state[0] + state[1]
    speed, turning = state[2], state[2] + state[3]
    k = m2 * length * c2
    cosine, sine = np.cos(angle - turned), np.sin(angle - turned)
    a = j1 + m1 * c1 * c1 + (m2 + elbow) * length * length + armature_1 + armature_2
    b, c = j2 + m2 * c2 * c2 + armature_2, k * cosine - armature_2
    first = torque[0] - _loss(state[2], torque[0], friction[0])
    second = torque[1] - _loss(state[3], torque[1], friction[1])
    weight = (m1 * c1 + (m2 + elbow) * length) * g * np.cos(angle)
    p = first - second - weight - k * sine * turning * turning
    q = second - m2 * c2 * g * np.cos(turned) + k * sine * speed * speed
    determinant = a * b - c * c
    absolute = (b * p - c * q) / determinant, (a * q - c * p) / determinant
    return np.array([state[2], state[3], absolute[0], absolute[1] - absolute[0]])


@compiled
def _motion(command: Array, interval: float, late: Array, links: Array, friction: Array) -> Array:
    """Positions at the times of the commands (2, samples) [rad]. The arm initially hangs; each command is held.

    late (3, 2): delay and lag of each joint's torque, and delay with which its position is logged [s].
    """
    steps = round(interval / STEP_S)
    h, samples = interval / steps, command.shape[1]
    state = np.array([-0.5 * np.pi, 0.0, 0.0, 0.0])
    filtered = command[:, 0].copy()
    position = np.empty((2, samples))
    delay, lag = late[0], late[1]
    logged = np.array([round(seconds / h) for seconds in late[2]])
    for step in range(samples * steps + steps):
        for joint in range(2):
            sample = step - logged[joint]
            if sample % steps == 0 and 0 <= sample < samples * steps:
                position[joint, sample // steps] = state[joint]
            # Evaluated at the middle of the step: a change within the step acts from its beginning or end, at most 10
            # us off.
            at = int(np.floor(((step + 0.5) * h - delay[joint]) / interval))
            goal = command[joint, min(max(at, 0), samples - 1)]
            decay = np.exp(-h / lag[joint]) if lag[joint] > 0.0 else 0.0
            filtered[joint] = goal + (filtered[joint] - goal) * decay
        k1 = _rates(state, filtered, links, friction)
        k2 = _rates(state + 0.5 * h * k1, filtered, links, friction)
        k3 = _rates(state + 0.5 * h * k2, filtered, links, friction)
        k4 = _rates(state + h * k3, filtered, links, friction)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return position


def measure(seed: int, law: str, longest_ms: float) -> dict[str, Any]:
    """Estimate the recording of one drawn arm: verdict, deviations in standard errors, errors, processor time."""
    random = np.random.default_rng([seed, 77])
    arm = drawn_arm(random)
    rate = int(random.choice(list(SECONDS)))
    torque = drawn_torque(random, arm, rate)
    seconds = 1e-3 * random.uniform(0.0, longest_ms, 2)
    if law == "logged":
        seconds[0] = 0.0
    late = np.zeros((3, 2))
    late[LAWS.index(law)] = seconds
    position = _motion(torque, 1.0 / rate, late, arm.links, arm.friction)
    position += 10.0 ** random.uniform(-4.7, -3.6) * random.standard_normal(position.shape)
    turn = int(random.choice([0, 4096, 65536]))
    if turn:
        position = np.round(position * turn / (2 * np.pi)) * 2 * np.pi / turn
    with tempfile.TemporaryDirectory() as folder:
        file, config = Path(folder) / "arm.csv", Path(folder) / "arm.toml"
        columns = np.column_stack((np.arange(torque.shape[1]) / rate, *position, *torque))
        np.savetxt(file, columns, "%.9g", ",", header="time,q1 [rad],q2 [rad],tau1,tau2", comments="")
        config.write_text(FORMAT, encoding="utf-8")
        began = time.process_time()
        hil.estimate(file, config=config, out=Path(folder) / "result")
        took = time.process_time() - began
        result = json.loads((Path(folder) / "result" / "result.json").read_text(encoding="utf-8"))
    truth, found = arm.truth(), result["parameters"]
    known = {name: each for name, each in found.items() if name in truth}
    return {
        "seed": seed,
        "late_ms": (1e3 * seconds).round(2).tolist(),
        "trust": result["verdict"]["trust"],
        "deviations": {name: (each["value"] - truth[name]) / each["std"] for name, each in known.items()},
        "worst_error": max(abs(each["value"] / truth[name] - 1) for name, each in known.items() if truth[name]),
        "cpu_s": took,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--arms", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--law", choices=LAWS, default="delay")
    parser.add_argument("--longest", type=float, default=3.0, help="longest of these times [ms]")
    options = parser.parse_args()
    every = []
    for seed in range(options.first, options.first + options.arms):
        one = measure(seed, options.law, options.longest)
        every.append(one)
        if not options.json:
            worst = max(one["deviations"].values(), key=abs)
            print(
                f'arm {seed}: {options.law} {one["late_ms"]} ms, "{one["trust"]}", worst {worst:+.1f} standard '
                f"errors, {100 * one['worst_error']:.2g} %, {one['cpu_s']:.0f} s",
                flush=True,
            )
    if options.json:
        print(json.dumps(every))
        return
    for trust in sorted({one["trust"] for one in every}):
        some = [abs(each) for one in every if one["trust"] == trust for each in one["deviations"].values()]
        print(f'"{trust}": {sum(each < 1.96 for each in some)} of {len(some)} values within their 95 % intervals')
    print(machine())


if __name__ == "__main__":
    main()
