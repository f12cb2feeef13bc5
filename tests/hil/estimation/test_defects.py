"""What changed while a recording was made, and angles in a wrong scale, are named with their size and time."""

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.estimation.unsettled import defects
from hil.estimation.unsettled.defects import defect_said, likely_defect
from hil.estimator.baselines.idim import fit_inverse_dynamics
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.models.model import Model
from hil.estimator.selection.unsettled import QUICK
from tests.support.recorded_arm import STEP
from tests.support.recorded_motion import two_joints

RATE, SECONDS, PARTS = 100.0, 8.0, 20
MIDDLE = 0.5 * SECONDS


def pendulum(change: str = "", size: float = 1.0, seed: int = 2, seconds: float = SECONDS) -> Recording:
    """A hanging joint, simulated here. change: what is `size` times its value in the second half; for `torque`, what
    becomes it in the course of the recording, while the column stays the same.
    """
    time = np.arange(round(RATE * seconds)) / RATE
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * math.pi, 12)
    torque = 0.08 * np.sin(2.0 * math.pi * np.outer(time, 0.25 + 0.21 * np.arange(12)) + phases).sum(axis=1)
    angle, q, v, h = np.empty(time.size), -0.5 * math.pi, 0.0, 1.0 / (PARTS * RATE)
    for k, (now, given) in enumerate(zip(time.tolist(), torque.tolist(), strict=True)):
        angle[k] = q
        factor = {change: size} if now >= MIDDLE else {}
        inertia, gravity = (value * factor.get("load", 1.0) for value in (0.009, 0.37))
        viscous, coulomb = (value * factor.get("friction", 1.0) for value in (0.02, 0.015))
        driven = given * (1.0 + (size - 1.0) * now / SECONDS if change == "torque" else 1.0)
        for _ in range(PARTS):
            v += h * (driven - gravity * math.cos(q) - viscous * v - coulomb * math.tanh(v / 0.02)) / inertia
            q += h * v
    return Recording(time, torque[None], np.round(angle / STEP)[None] * STEP, np.array([STEP]), "held")


def named(recordings: Sequence[Recording], model: Model) -> str:
    """The sentence on the defect; empty if there is none."""
    start = fit_inverse_dynamics(recordings, 8.0, 0.05).value
    estimate: ShootingEstimate = estimate_by_shooting(recordings, model, start, zeros=True, options=QUICK)
    found = likely_defect(recordings, estimate, estimate, gravity=True)
    return "" if found is None else defect_said(found, [f"{letter}.csv" for letter in "abc"])


@pytest.mark.parametrize(
    ("change", "size", "said", "value"),
    [
        ("", 1.0, "", 0.0),
        ("load", 1.2, "The load seems to have been picked up at about ", MIDDLE),
        pytest.param(
            *("friction", 1.3, "The friction of joint 1 seems to have changed by +", 30.0), marks=pytest.mark.slow
        ),
        pytest.param(
            *("torque", 0.9, "The motor torque of joint 1 seems to change steadily", -10.0), marks=pytest.mark.slow
        ),
    ],
)
def test_a_change_in_the_course_of_a_recording_is_named(change: str, size: float, said: str, value: float) -> None:
    found = named([pendulum(change, size)], Model(1, "coulomb"))
    assert found.startswith(said) and bool(found) is bool(said)
    if said:
        numbers = found.removeprefix(said).replace("%", " ").split()
        first = next(float(each) for each in numbers if each.lstrip("+-").replace(".", "").isdigit())
        assert first == pytest.approx(value, abs=max(0.12 * abs(value), 0.6))


def test_a_torque_column_in_another_scale_than_that_of_the_other_file_is_named() -> None:
    first, other = (pendulum(seed=seed, seconds=5.0) for seed in (2, 3))
    found = named([first, replace(other, torque=1.25 * other.torque)], Model(1, "coulomb"))
    assert found.startswith("The motor torque of joint 1 seems to be 0.8") and "in b.csv" in found


@pytest.mark.slow
def test_angles_of_two_joints_in_wrong_scales_are_named_with_both_scales() -> None:
    motion = two_joints(8.0)
    recording = Recording(motion.time, motion.torque, motion.position, np.full(2, STEP), "held")
    model = Model(2, "stribeck", options=("torque_scale",))
    assert named([recording], model) == ""
    factor = np.array([1.15, 0.9])
    found = named([replace(recording, position=recording.position * factor[:, None])], model)
    scales = found.removeprefix("The angles of joints 1 and 2 seem to be ").split(" times")[0].split(" and ")
    assert np.array(scales, dtype=float) == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize(("given", "left", "named"), [(1.08, 1.03, False), (1.3, 1.0, True), (4.0, 3.5, False)])
def test_a_defect_that_hardly_changes_the_residual_is_not_named(
    monkeypatch: pytest.MonkeyPatch, given: float, left: float, named: bool
) -> None:
    found: Any = SimpleNamespace(
        fit=SimpleNamespace(left=left**2), given=SimpleNamespace(left=given**2), explained=0.9, hypothesis=None
    )
    monkeypatch.setattr(defects, "probable_defect", lambda *_: found)
    estimate: Any = SimpleNamespace(residual_over_noise=np.array([given]))
    assert (likely_defect([], estimate, estimate, True) is found) is named
