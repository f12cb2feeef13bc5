"""The one mistake in a spatial arm's columns is found; none is claimed for sound columns or for other mistakes."""

from dataclasses import replace

import numpy as np
import pytest

from hil.estimator.chain.column_changes import ColumnChange, ColumnSearch, Suspected
from hil.estimator.data.recording import Recording
from tests.estimator.chain.test_column_faults import LINKS, checked, model, recorded

ZERO, GAINS = np.array([0.0, 0.3, 0.0]), np.array([1.0, 1.5, 2.0])
QUARTER = 0.5 * np.pi


def searched(recording: Recording) -> Suspected | None:
    return ColumnSearch(checked(recording, model()), LINKS, ZERO, GAINS, "rad").suspected()


def changed(recording: Recording, change: ColumnChange) -> Recording:
    position, torque = change.on_position(recording.position, ZERO), change.on_torque(recording.torque, GAINS)
    return replace(recording, position=position, torque=torque)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_sound_columns_are_left_alone(seed: int) -> None:
    assert searched(recorded(model(), seed)) is None


@pytest.mark.parametrize(
    ("made", "undone"),
    [
        (each, each)
        for each in (
            ColumnChange("exchange", (1, 2)),
            ColumnChange("exchange", (0, 1), "torque"),
            ColumnChange("exchange", (0, 2), "both"),
            ColumnChange("direction", (2,)),
            ColumnChange("direction", (1,), "torque"),
            ColumnChange("direction", (1,), "both"),
        )
    ]
    + [
        (ColumnChange("zero", (2,), turned=QUARTER), ColumnChange("zero", (2,), turned=-QUARTER)),
        (ColumnChange("ratio", (1,), factor=1.5), ColumnChange("ratio", (1,), factor=2.0 / 3.0)),
        (
            ColumnChange("unit", factor=0.5 / np.pi),
            ColumnChange("unit", factor=2.0 * np.pi, units=("rad", "turns")),
        ),
    ],
)
def test_the_one_mistake_is_found(made: ColumnChange, undone: ColumnChange) -> None:
    found = searched(changed(recorded(model(), 3), made))
    assert found is not None
    assert found.change == undone
    assert found.residuals[0] < 0.1


def test_a_change_that_is_undone_leaves_the_columns_as_they_were() -> None:
    good = recorded(model(), 3)
    for change in (ColumnChange("exchange", (0, 2), "both"), ColumnChange("direction", (1,), "both")):
        twice = changed(changed(good, change), change)
        np.testing.assert_allclose(twice.position, good.position)
        np.testing.assert_allclose(twice.torque, good.torque)


@pytest.mark.parametrize("mistake", ["torque constant", "times", "late torque", "small zero"])
def test_no_change_is_claimed_for_another_mistake(mistake: str) -> None:
    good = recorded(model(), 3)
    second = np.array([[False], [True], [False]])
    bad = {
        "torque constant": replace(good, torque=np.where(second, 1.6, 1.0) * good.torque),
        "times": replace(good, time=2.0 * good.time),
        "late torque": replace(good, torque=np.where(second, np.roll(good.torque, 3, axis=1), good.torque)),
        "small zero": replace(good, position=good.position + np.where(second, 0.4, 0.0)),
    }[mistake]
    assert searched(bad) is None
