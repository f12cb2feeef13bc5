"""Spatial arms with four and six joints: accuracy of the estimator and of filtered least squares on the same data.

    python benchmarks/chain.py [--json] [--seeds N] [--joints 4 6] [--peers]

The descriptions of the arms are configs/open_manipulator_x_like.urdf and configs/viperx_300_like.urdf. Each mass of a
true arm is 20 % above or below the described one (at random), its centres of mass are shifted by up to 1 cm, and its
drives are drawn at random: static friction with a Stribeck rise, and a current-loop lag of 1 ms. Each arm follows a
finite Fourier path of 10 s at 400 Hz, controlled by feed-forward from the inaccurate model and by a software spring and
damper. Angles are rounded to 4096 steps per turn, and currents to the servo's ticks. One settled period is recorded; a
second path is held out.

Figures for each number of joints, worst over all seeds:

torque_error_percent   rigid-body torque on the held-out path: RMS error divided by RMS torque, worst joint
base_median_percent    median error of the base parameters that contribute at least a tenth of some joint's torque
residual_ticks         residual of stage 2, worst joint; rounding alone leaves 0.289
held_out_percent       closed-loop prediction of the held-out motion: RMS error divided by motion RMS, worst joint
coverage_95            share of base parameters within their 95 % intervals, over all seeds
seconds                wall time of both stages on one core, without compilation
processor_seconds      processor time of both stages
iterations             number of simulations that include all sensitivities
share_of_classic       ratio of the torque error to that of the classic method on the same recording
classic                the same figures for filtered inverse-dynamics least squares: the best of three cut-offs, chosen
                       by comparison with the truth; it has no one-step-ahead residual

mujoco_sysid           with --peers: torque and base parameter errors of mujoco.sysid on the first seed's recording,
                       its number of parameters, its processor time on all cores, and the ratio of this time to ours

`--json` prints {"arms": {"4": {...}, "6": {...}}} and nothing else.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.machine import machine
from benchmarks.spatial.mujoco_chain import fit_chain_with_mujoco
from benchmarks.spatial.remembered import remembered
from hil.description.urdf import read_urdf
from hil.estimator.chain.excitation.fourier_path import Path as Motion
from hil.estimator.chain.excitation.fourier_path import design_path
from hil.estimator.chain.fit.regression import fit_filtered
from hil.estimator.chain.fit.stage1 import COULOMB_WIDTH
from hil.estimator.chain.identify import identify_chain
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.dynamics import inverse_dynamics, mass_matrix
from hil.estimator.chain.model.geometry import Chain
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.simulation.prediction import predict
from hil.estimator.data.recording import Recording
from hil.estimator.data.relative_error import relative_error
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import PeriodicityError
from hil.estimator.simulation.closed_loop import Feedback, Stabilised
from hil.fakes.plants.arm import Drive, armature
from hil.fakes.plants.chain import SpatialChain
from hil.fakes.plants.chain_arm import ChainArm
from hil.study.jobs import each

CONFIGS = Path(__file__).parents[1] / "configs"
RATE, PERIOD = 400.0, 10.0
TICK, CURRENT_TICK = 2 * np.pi / 4096, 2.69e-3
HIGHEST = 1.5  # Hz
SPRING, DAMPING = 3.0, 0.7  # Hz, natural frequency of the software spring with the described inertia; damping ratio
CUTOFFS = (4.0, 8.0, 16.0)  # Hz
LARGE = 0.1
ARMATURE = 0.01  # kg m^2, assumed by the feed-forward


@dataclass(frozen=True)
class Bench:
    """An arm's path and drives: torque constants [N m/A], current limits [A], typical Coulomb friction [N m]."""

    urdf: str
    centre: tuple[float, ...]
    swing: tuple[float, ...]
    speed: tuple[float, ...]
    torque_constant: tuple[float, ...]
    limit: tuple[float, ...]
    coulomb: tuple[float, ...]


BENCHES = {
    4: Bench(
        "open_manipulator_x_like",
        (0, -0.3, 0.3, 0.2),
        (0.9, 0.6, 0.6, 0.8),
        (4.8,) * 4,
        (1.8,) * 4,
        (1.2,) * 4,
        (0.05,) * 4,
    ),
    6: Bench(
        "viperx_300_like",
        (0, -0.4, 0.4, 0, 0.3, 0),
        (0.9, 0.5, 0.5, 0.9, 0.8, 1.0),
        (3.1,) * 6,
        (2.4, 4.8, 2.4, 1.8, 1.8, 1.8),
        (4.0, 8.0, 4.0, 2.3, 2.3, 2.3),
        (0.1, 0.2, 0.1, 0.05, 0.05, 0.05),
    ),
}


@dataclass(frozen=True)
class Setup:
    """A true arm, and what is known about it before the experiment."""

    arm: ChainArm
    base: BaseParameters
    prior: Prior
    described: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        """True base parameters [SI]."""
        links = np.stack([body.parameters for body in self.arm.bodies])
        rotors = [armature(drive) for drive in self.arm.drives]
        return self.base.of_all(np.column_stack((links, rotors)).reshape(-1))


def set_up(bench: Bench, seed: int) -> Setup:
    """Draw a true arm that differs randomly from the description."""
    rng = np.random.default_rng(seed)
    path = CONFIGS / f"{bench.urdf}.urdf"
    names = [joint.name for joint in read_urdf(path).joints]
    drives = [
        Drive(
            mass=0.0,
            rotor_inertia=8e-8 * rng.uniform(0.8, 1.2),
            gear_ratio=353.5 if constant < 4 else 500.0,
            torque_constant=constant,
            current_lag=1e-3,
            viscous=0.9 * coulomb * rng.uniform(0.8, 1.2),
            coulomb=coulomb * rng.uniform(0.8, 1.2),
            stribeck_rise=rng.uniform(0.3, 0.5),
            stribeck_velocity=rng.uniform(0.1, 0.2),
            offset=0.1 * coulomb * rng.uniform(-1, 1),
        )
        for constant, coulomb in zip(bench.torque_constant, bench.coulomb, strict=True)
    ]
    arm = ChainArm(
        urdf=str(path),
        joints=tuple(names),
        start=tuple(map(float, bench.centre)),
        drives=tuple(drives),
        mass_scale=tuple(map(float, 1 + 0.2 * rng.choice([-1, 1], len(names)))),
        centre_shift=tuple(map(float, 0.01 * rng.uniform(-1, 1, len(names)))),
    )
    description = arm.description
    base = BaseParameters.of(Chain(*description.geometry, arm.gravity_vector))
    described = np.column_stack((description.parameters, np.full(len(names), ARMATURE))).reshape(-1)
    return Setup(arm, base, Prior.of(base, description.parameters), described)


@remembered
def path_of(bench: Bench, setup: Setup, seed: int, seconds: float = PERIOD) -> Motion:
    centre, swing, speed = (np.array(each, dtype=float) for each in (bench.centre, bench.swing, bench.speed))
    return design_path(setup.base, setup.prior, RATE, seconds, HIGHEST, centre, swing, speed, seed)


@remembered
def record(bench: Bench, setup: Setup, path: Motion, noise: float | np.ndarray = 0.0) -> SettledPeriod:
    """Simulate the true arm on `path` and return its second period.

    noise: white noise of the encoders before rounding (joints,) [encoder steps].
    """
    shaken = np.random.default_rng(7)
    chain = setup.base.chain
    constant, limit, coulomb = (np.array(each) for each in (bench.torque_constant, bench.limit, bench.coulomb))
    stiffness = np.diag(mass_matrix(chain, setup.described, np.array(bench.centre, dtype=float)))
    turn = 2 * np.pi * SPRING
    stiffness, damping = stiffness * turn**2, 2 * DAMPING * stiffness * turn
    pose = np.array(bench.centre, dtype=float)
    forward = inverse_dynamics(chain, setup.described, path.position, path.velocity, path.acceleration)
    forward += coulomb[:, None] * (0.7 * np.tanh(path.velocity / 0.1) + 0.7 * path.velocity)
    excitation = forward + stiffness[:, None] * (path.position - pose[:, None]) + damping[:, None] * path.velocity
    plant = SpatialChain(setup.arm.model_copy(update={"start": tuple(map(float, path.position[:, 0]))}))
    joints, samples = path.position.shape
    position, torque = np.empty((2, joints, samples))
    measured, speed = np.round(path.position[:, 0] / TICK) * TICK, np.zeros(joints)
    for k in range(2 * samples):
        wanted = excitation[:, k % samples] + stiffness * (pose - measured) - damping * speed
        current = np.clip(np.round(wanted / constant / CURRENT_TICK) * CURRENT_TICK, -limit, limit)
        ticks = np.array(plant.position) / TICK + noise * shaken.standard_normal(joints)
        measured = np.round(ticks) * TICK
        speed = np.round(np.array(plant.velocity) / 0.024) * 0.024
        position[:, k % samples], torque[:, k % samples] = measured, current * constant
        plant.advance((k + 1) / RATE, current)
    feedback = Feedback(stiffness, damping, pose, limit * constant)
    former = np.stack((position[:, -1], np.zeros(joints)))
    stabilised = Stabilised(feedback, excitation, former, torque[:, -1])
    return SettledPeriod(RATE, torque, position, 0.0, np.full(joints, TICK), stabiliser=stabilised)


def errors(setup: Setup, value: np.ndarray, path: Motion) -> dict[str, float]:
    """Errors of the base parameters `value`, evaluated on the held-out path."""
    Y = setup.base.regressor(path.position, path.velocity, path.acceleration)
    truth = setup.truth
    right = Y @ truth
    level = np.sqrt(np.mean(right**2, axis=1))
    wrong = np.sqrt(np.mean((Y @ value - right) ** 2, axis=1)) / level
    part = np.max(np.sqrt(np.mean(Y**2, axis=1)) * np.abs(truth) / level[:, None], axis=0)
    large = part > LARGE
    return {
        "torque_error_percent": 100 * float(wrong.max()),
        "base_median_percent": 100 * float(np.median(np.abs(value - truth)[large] / np.abs(truth)[large])),
    }


def classic(setup: Setup, period: SettledPeriod, held_out: SettledPeriod, path: Motion) -> dict[str, float | None]:
    """Filtered least squares with the cut-off that gives the smallest torque error."""
    model = ChainModel(setup.base, friction="coulomb")
    at = np.arange(period.samples) / period.rate
    recording = Recording(at, period.torque, period.position, period.position_step, between="held")
    count = setup.base.count
    tried: list[dict[str, Any]] = []
    for cutoff in CUTOFFS:
        started = time.perf_counter()
        value, std = fit_filtered([recording], model, setup.prior, cutoff, 1e-3)
        seconds = time.perf_counter() - started
        away = np.abs(value[:count] - setup.truth) / std[:count]
        named = dict(zip(model.linear_names, value.tolist(), strict=True)) | {"lag": 1e-3}
        named |= {f"coulomb_width_{joint + 1}": COULOMB_WIDTH for joint in range(model.joints)}
        tried.append(
            {
                **errors(setup, value[:count], path),
                "residual_ticks": None,
                "held_out_percent": foretold(model, named, held_out),
                "coverage_95": float(np.mean(away < 1.96)),
                "seconds": seconds,
            }
        )
    return min(tried, key=lambda each: each["torque_error_percent"])


def foretold(model: ChainModel, parameters: dict[str, float], held_out: SettledPeriod) -> float | None:
    """Prediction error on the held-out path [%], worst joint; None if the simulation with these parameters diverges."""
    try:
        return 100 * float(relative_error(held_out.position, predict(model, parameters, held_out)).max())
    except PeriodicityError:
        return None


def measure(joints: int, seed: int) -> dict[str, Any]:
    bench, setup = BENCHES[joints], set_up(BENCHES[joints], seed)
    played, other = path_of(bench, setup, 100 + seed), path_of(bench, setup, 200 + seed)
    period, held_out = record(bench, setup, played), record(bench, setup, other)
    model = ChainModel(setup.base, lags=True)
    started, worked = time.perf_counter(), time.process_time()
    estimate = identify_chain(period, model, setup.prior)
    seconds, processor = time.perf_counter() - started, time.process_time() - worked
    count = setup.base.count
    away = np.abs(estimate.value[:count] - setup.truth) / estimate.std[:count]
    return {
        **errors(setup, estimate.value[:count], other),
        "residual_ticks": float(estimate.residual_steps.max()),
        "held_out_percent": foretold(model, estimate.parameters, held_out),
        "coverage_95": float(np.mean(away < 1.96)),
        "seconds": seconds,
        "processor_seconds": processor,
        "iterations": estimate.iterations,
        "classic": classic(setup, period, held_out, other),
    }


def peer(joints: int) -> dict[str, Any]:
    """The figures of mujoco.sysid on the first seed's recording; raises MissingExtra without it."""
    bench, setup = BENCHES[joints], set_up(BENCHES[joints], 1)
    period = record(bench, setup, path_of(bench, setup, 101))
    model = ChainModel(setup.base, lags=True)
    worked = time.process_time()
    identify_chain(period, model, setup.prior)
    ours = time.process_time() - worked
    value, seconds, count = fit_chain_with_mujoco(period, setup.base, setup.prior, setup.described)
    found = errors(setup, value, path_of(bench, setup, 201))
    return {**found, "parameters": count, "processor_seconds": seconds, "times_ours": seconds / ours}


_COMPILED: set[int] = set()


def _compiled(joints: int, seed: int) -> dict[str, Any]:
    """Call `measure`; in each worker, an extra call first compiles everything."""
    if joints not in _COMPILED:
        measure(joints, 1)
        _COMPILED.add(joints)
    return measure(joints, seed)


def worst(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the worst value of each figure over all seeds (None if a seed lacks it); for the coverage, the mean."""
    result: dict[str, Any] = {}
    for key, first in found[0].items():
        each = [one[key] for one in found]
        if isinstance(first, dict):
            result[key] = worst(each)
        elif key == "coverage_95":
            result[key] = float(np.mean(each))
        else:
            result[key] = None if None in each else max(each)
    if "classic" in result:
        shares = (one["torque_error_percent"] / one["classic"]["torque_error_percent"] for one in found)
        result["share_of_classic"] = max(shares)
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument(
        "--jobs", type=int, default=1, help="number of workers; with more than one, timings are unreliable"
    )
    parser.add_argument("--peers", action="store_true", help="also run mujoco.sysid (hil[peers]), for some minutes")
    parser.add_argument("--joints", type=int, nargs="+", default=[4, 6], choices=sorted(BENCHES))
    given = parser.parse_args()
    result: dict[str, Any] = {"arms": {}}
    for joints in given.joints:
        seeds = range(1, given.seeds + 1)
        result["arms"][str(joints)] = worst(each(partial(_compiled, joints), seeds, count=given.jobs))
        if given.peers:
            result["arms"][str(joints)]["mujoco_sysid"] = peer(joints)
    if given.json:
        print(json.dumps(result))
        return
    print(machine())
    for joints, found in result["arms"].items():
        print(f"{joints} joints:")
        for key, value in found.items():
            print(f"  {key}: {round(value, 4) if isinstance(value, float) else value}")


if __name__ == "__main__":
    main()
