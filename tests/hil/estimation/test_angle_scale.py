"""Angles in a wrong scale are told from the spring that imitates them, and springs from a wrong scale."""

import json
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hil.estimation.unsettled.recordings import estimate_recordings
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant
from tests.support.recorded_arm import SERVO, STEP

RATE, SECONDS = 100.0, 4.0
HANGING = -math.pi / 2
DRIVE = {**SERVO, "viscous": 0.03, "coulomb": 0.02, "coulomb_width": 0.02, "offset": 0.002}
LINK = {"length": 0.2, "mass": 0.25, "centre": 0.15, "inertia": 1e-3}
GRAVITY = 9.81 * LINK["mass"] * LINK["centre"]
MODEL = '[model]\nfriction = "coulomb"\ncable = true\n'


@cache
def motion(stiffness: float, slack_at: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], torque [N m] and true angle [rad] of a hanging joint with a spring."""
    drive = DRIVE | {"cable_stiffness": stiffness, "cable_angle": slack_at}
    plant = make_plant(Arm.model_validate({"start": (HANGING,), "links": [LINK], "drives": [drive]}))
    time = np.arange(round(RATE * SECONDS)) / RATE
    phases = np.random.default_rng(1).uniform(0.0, 2.0 * math.pi, 12)
    frequencies = 0.25 + 0.21 * np.arange(12)
    torque = 0.08 * np.sin(2.0 * math.pi * np.outer(time, frequencies) + phases).sum(axis=1)
    angle = np.empty(time.size)
    for k, command in enumerate((torque / SERVO["torque_constant"]).tolist()):
        angle[k] = plant.position[0]
        plant.advance(float(time[k] + 1.0 / RATE), [command])
    return time, torque, angle


@pytest.mark.parametrize(
    ("stiffness", "slack_at", "factor", "zero", "said"),
    [
        (0.0, 0.0, 1.1, None, "without the fitted spring and encoder zero"),
        (0.0, 0.0, 1.1, HANGING, "if the arm has such a spring, this model is right"),
        (0.06, 0.0, 1.0, None, ""),
        (0.06, -0.8, 1.0, HANGING, ""),
    ],
)
def test_a_wrong_scale_is_named_and_a_spring_is_not(
    tmp_path: Path, stiffness: float, slack_at: float, factor: float, zero: float | None, said: str
) -> None:
    time, torque, angle = motion(stiffness, slack_at)
    column = np.round((angle - (zero or 0.0)) * factor / STEP) * STEP
    head = "t,q1,tau1"
    np.savetxt(tmp_path / "arm.csv", np.column_stack((time, column, torque)), delimiter=",", header=head, comments="")
    columns = '[columns]\nbetween = "held"\n' + ("" if zero is None else f"zero = [{json.dumps(zero)}]\n")
    (tmp_path / "arm.toml").write_text(f"{MODEL}{columns}", encoding="utf-8")
    result = estimate_recordings([tmp_path / "arm.csv"], tmp_path / "arm.toml", None)
    assert result.verdict is not None
    found = [each for each in result.verdict.sentences if "times the true one" in each]
    if not said:
        assert not found and result.parameters["gravity_1"].value == pytest.approx(GRAVITY, rel=0.05)
        return
    assert result.verdict.trust == "with care" and len(found) == 1 and said in found[0]
    assert float(found[0].split("seems to be ")[1].split(" times")[0]) == pytest.approx(factor, abs=0.01)
    assert float(found[0].split("gravity_1 is ")[1].split(" ")[0]) == pytest.approx(GRAVITY, rel=0.03)
    assert abs(result.parameters["gravity_1"].value / GRAVITY - 1.0) > 0.05
