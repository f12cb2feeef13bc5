"""Identification and prediction of an arm simulated by MuJoCo instead of by equations like the estimator's.

    python benchmarks/rigid_body_engine.py [--json] [--seeds N]        (needs the package mujoco)

The links, servos and friction of the fake arm are modelled in MuJoCo, where dry friction is a constraint
(frictionloss), not a function of velocity. Positions are rounded to encoder steps and currents to current steps. The
friction model is chosen by hil. The output gives the worst of N seeds, and how many of the N x 12 parameters lie
outside their 99 % intervals (1 % is expected). Seeds whose phases swing the arm over the top, in the fitted or the
held-out period, are counted and skipped, because the motion is then not periodic.
"""

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import mujoco
import numpy as np

from benchmarks.machine import machine
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import RecordingError
from hil.estimator.excitation.multisine import design_multisine, zippered_lines
from hil.estimator.selection.settled import choose
from hil.estimator.selection.trial import Choice
from hil.fakes.plants.arm import Arm, base_parameters
from tests.support.recorded_arm import BAND, COMMAND_TO_SAMPLE, CURRENT_STEP, DRIVES, LINKS, PERIOD, RATE, SERVO, STEP

PEAK = (0.80, 0.42)  # N m
# s. The engine's integrator is of first order, and its error must not be blamed on the estimate: at 2e-5 s, the
# inertias are 1.5 standard errors too large and all motion is 1e-5 s too early; at 5e-6 s, a quarter of that.
TIMESTEP = 2e-6
GROUPS = {
    "inertia": ("inertia_1", "coupling", "inertia_2", "armature_2"),
    "gravity": ("gravity_1", "gravity_2"),
    "friction": ("viscous_1", "viscous_2", "coulomb_1", "coulomb_2"),
}
TWO_SIDED_99 = 2.576


def engine() -> mujoco.MjModel:
    """The arm in MuJoCo's convention: x forwards, z up, joints about -y, so that angles increase with z."""
    rotor = SERVO["rotor_inertia"] * SERVO["gear_ratio"] ** 2
    joint = (
        '<joint name="j{n}" type="hinge" axis="0 -1 0" damping="{viscous}" frictionloss="{coulomb}" armature="'
        + str(rotor)
        + '" solreffriction="{time} 1"/>'
    )
    joints = [joint.format(n=n, time=2.0 * TIMESTEP, **drive) for n, drive in enumerate(DRIVES, start=1)]
    bodies = [
        '<inertial pos="{centre} 0 0" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>'.format(**link)
        for link in LINKS
    ]
    length = LINKS[0]["length"]
    elbow = (
        f'<body pos="{length} 0 0"><inertial pos="0 0 0" mass="{SERVO["mass"]}" diaginertia="1e-9 1e-9 1e-9"/></body>'
    )
    text = (
        f'<mujoco><option timestep="{TIMESTEP}" gravity="0 0 -9.81" integrator="implicitfast" solver="Newton" '
        'tolerance="1e-12" iterations="50"/><worldbody><body>'
        f'{joints[0]}{bodies[0]}{elbow}<body pos="{length} 0 0">{joints[1]}{bodies[1]}</body>'
        "</body></worldbody></mujoco>"
    )
    return mujoco.MjModel.from_xml_string(text)


def record(seed: int) -> SettledPeriod:
    """Simulate one period for settling; return the next one."""
    wave = design_multisine(RATE, PERIOD, zippered_lines(PERIOD, BAND, 2), PEAK, seed)
    constant = SERVO["torque_constant"]
    torque = np.round(wave.torque / constant / CURRENT_STEP) * CURRENT_STEP * constant
    offset = np.array([drive["offset"] for drive in DRIVES])
    model = engine()
    data = mujoco.MjData(model)
    data.qpos[:] = (-math.pi / 2, 0.0)
    steps = round(1.0 / (RATE * TIMESTEP))
    sample = round(COMMAND_TO_SAMPLE / TIMESTEP)
    position = np.empty((2, wave.samples))
    for _ in range(2):
        for k in range(wave.samples):
            data.qfrc_applied[:] = torque[:, k] - offset
            mujoco.mj_step(model, data, sample)
            position[:, k] = data.qpos
            mujoco.mj_step(model, data, steps - sample)
    rounded = np.round(position / STEP) * STEP
    return SettledPeriod(RATE, torque, rounded, COMMAND_TO_SAMPLE, np.full(2, STEP))


def figures(choice: Choice, truth: dict[str, float]) -> dict[str, Any]:
    estimate = choice.estimate
    std = dict(zip(estimate.names, estimate.std.tolist(), strict=True))
    found = estimate.parameters
    errors = {
        f"{group}_error": max(abs(found[name] / truth[name] - 1) for name in names) for group, names in GROUPS.items()
    }
    in_std = {name: abs(found[name] - value) / std[name] for name, value in truth.items()}
    outside = sum(value > TWO_SIDED_99 for value in in_std.values())
    return {
        **errors,
        "worst_in_std": max(in_std.values()),
        "outside_99": outside,
        "residual_ticks": float(estimate.residual_steps.max()),
        "held_out_rms": float(np.max(choice.chosen.held_out)) if choice.chosen.held_out is not None else math.nan,
        "seconds": sum(trial.seconds for trial in choice.trials),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    drives = [{**SERVO, **drive} for drive in DRIVES]
    arm = Arm.model_validate({"start": (-math.pi / 2, 0.0), "links": LINKS, "drives": drives})
    truth = base_parameters(arm)
    runs: list[dict[str, Any]] = []
    chosen = []
    turned_over = 0
    while len(runs) < options.seeds:
        seed = 1 + len(runs) + turned_over
        try:
            periods = record(seed), record(seed + 100)
        except RecordingError:
            turned_over += 1
            continue
        choice = choose([periods[0]], periods[1], "delay")
        runs.append(figures(choice, truth))
        chosen.append(choice.chosen.model.description)
    worst = {key: max(run[key] for run in runs) for key in runs[0]}
    worst["outside_99"] = sum(run["outside_99"] for run in runs)
    worst |= {"intervals": len(runs) * len(truth), "seeds_turned_over": turned_over}
    if options.json:
        print(json.dumps({**worst, "models": chosen, "seeds": options.seeds}))
        return
    print(f"{machine()}; MuJoCo {mujoco.__version__}; worst of {options.seeds} seeds; chosen: {', '.join(chosen)}")
    for key, value in worst.items():
        print(f"  {key:18s} " + (f"{100 * value:.3f} %" if key.endswith(("_error", "_rms")) else f"{value:.3g}"))


if __name__ == "__main__":
    main()
