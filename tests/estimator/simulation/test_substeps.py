"""Steps near standstill are divided as finely as each joint needs, which changes nothing in the motion."""

import numpy as np
import pytest

from hil.estimator.arrays import Array
from hil.estimator.models.parameters import Physics
from hil.estimator.simulation import arm
from tests.estimator.simulation.test_closed_loop import ARM, POSE, RATE, wave

STICKING, WIDE = 2e-4, 1.0
STEP = 8e-4


@pytest.mark.parametrize(("widths", "which"), [((STICKING, WIDE), 0), ((WIDE, STICKING), 1)])
def test_only_the_joint_that_sticks_needs_many(widths: tuple[float, float], which: int) -> None:
    physics = Physics.of(ARM | {"coulomb_width_1": widths[0], "coulomb_width_2": widths[1]})
    pieces = arm.finer_pieces(physics, STEP)
    assert pieces[which] == arm.MAX_SUBSTEPS and pieces[1 - which] == 1


def test_a_joint_without_inertia_is_not_divided_by_zero() -> None:
    weightless = Physics.of(ARM | {"inertia_2": 0.0, "armature_2": 0.0, "coulomb_2": 0.0, "coulomb_width_2": 0.01})
    assert weightless.free_inertias()[1] == 0.0
    assert (arm.finer_pieces(weightless, STEP) >= 1).all()


@pytest.mark.parametrize("widths", [(STICKING, WIDE), (WIDE, STICKING), (STICKING, 0.01)])
def test_the_motion_is_that_of_the_finest_substeps_for_both(
    widths: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    physics = Physics.of(ARM | {"coulomb_width_1": widths[0], "coulomb_width_2": widths[1]})
    steps = arm.steps_per_sample(RATE)
    torque = np.repeat(wave(0.5).torque[:, :, None], steps, axis=2)
    start = np.stack((POSE, np.zeros(2)))
    found, _ = arm.simulate(physics, start, torque, 1 / (RATE * steps))
    chosen = arm.finer_pieces(physics, 1 / (RATE * steps))
    assert chosen.min() < chosen.max()
    monkeypatch.setattr(arm, "finer_pieces", lambda *_: np.full(2, chosen.max()))
    finest, _ = arm.simulate(physics, start, torque, 1 / (RATE * steps))
    assert 0.0 < np.abs(found - finest).max() < 3e-5, "rad, a fiftieth of an encoder step"


@pytest.mark.parametrize(
    ("acceleration", "left", "stiffness", "taken"),
    [
        pytest.param(1e-3, 63, 0.0, 63, id="held by friction"),
        pytest.param(1e-3, 64, 0.0, 1, id="new torque"),
        pytest.param(20.0, 63, 0.0, 1, id="reversing"),
        pytest.param(1e-3, 63, 12.0, 1, id="bristles"),
    ],
)
def test_a_joint_that_is_held_by_friction_takes_long_substeps(
    acceleration: float, left: int, stiffness: float, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    steady, now = (getattr(each, "py_func", each) for each in (arm.pieces_while_steady, arm.pieces_now))
    monkeypatch.setattr(arm, "pieces_while_steady", steady)
    physics = Physics.of(ARM | {"coulomb_width_1": STICKING, "coulomb_width_2": WIDE})
    vector = physics.vector.copy()
    vector[arm.STIFFNESS] = stiffness
    slow = 0.1 * STICKING
    pieces = np.array([64, 1])
    assert now(vector, slow, 0.0, acceleration, 0.0, STEP / 64, pieces, left, True) == taken
    assert now(vector, slow, 0.0, acceleration, 0.0, STEP / 64, pieces, left, False) == 1


def test_breaking_away_from_standstill_is_that_of_much_shorter_steps() -> None:
    physics = Physics.of(ARM | {"gravity_1": 0.0, "gravity_2": 0.0, "coulomb_width_1": 3e-4, "coulomb_width_2": 3e-4})
    time = np.arange(200) / RATE
    torque = np.stack((0.09 * np.sin(7.0 * time), 0.08 * np.sin(11.0 * time)))[:, :, None]
    start, finer = np.zeros((2, 2)), 64

    def moved(steps: int) -> Array:
        return arm.simulate(physics, start, np.repeat(torque, steps, axis=2), 1 / (RATE * steps), held=True)[0]

    found, finest = moved(2), moved(2 * finer)
    still = np.abs(np.diff(finest, axis=1)) < 1e-5
    assert still.mean(axis=1).min() > 0.2 and np.ptp(finest, axis=1).min() > 0.05
    assert np.abs(found - finest).max() < 1e-4, "rad, a fifteenth of an encoder step"
