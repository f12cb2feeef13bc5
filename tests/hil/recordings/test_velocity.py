"""Velocity columns that contradict the positions are named: nothing else shows a wrong time scale."""

import re
from collections.abc import Sequence

import numpy as np
import pytest

from hil.config.csv_columns import Columns
from hil.recordings.convert import Converted, convert
from hil.recordings.table import Table

TIME = np.arange(0.0, 24.0, 0.01)
EVERY = range(TIME.size)


def converted(
    scale: float = 1.0, of_one: float = 1.0, late: float = 0.0, slow: float = 1.0, rows: Sequence[int] = EVERY
) -> Converted:
    """Two joints; velocities of `scale`, the second of `of_one` times that, `late` [s]; times `slow` times theirs.

    rows: numbers of the rows that the file holds, in its order.
    """
    random = np.random.default_rng(1)
    position = [np.sin(3.0 * TIME) + 0.3 * np.sin(11.0 * TIME), 0.8 * np.cos(4.3 * TIME)]
    then = TIME - late
    velocity = [3.0 * np.cos(3.0 * then) + 3.3 * np.cos(11.0 * then), -3.44 * np.sin(4.3 * then)]
    velocity = [scale * each + random.normal(0.0, 0.05, TIME.size) for each in (velocity[0], of_one * velocity[1])]
    torque = [np.cos(TIME), np.sin(TIME)]
    columns = dict(
        zip(("t", "q1", "q2", "dq1", "dq2", "tau1", "tau2"), (slow * TIME, *position, *velocity, *torque), strict=True)
    )
    return convert(Table("arm.csv", {name: each[rows] for name, each in columns.items()}), Columns())


@pytest.mark.parametrize("scale", [1.0, 180.0 / np.pi, 30.0 / np.pi])
def test_velocities_that_fit_cause_no_doubt_in_whatever_unit(scale: float) -> None:
    assert converted(scale).doubts == ()


def test_times_in_a_wrong_scale_are_named_with_the_factor() -> None:
    (said,) = converted(slow=1.25).doubts
    assert "The velocity columns are 1.25 times the rates" in said and "inertias are 1.56 times too large" in said


@pytest.mark.parametrize(
    "rows",
    [
        [*range(700), 699, *range(700, TIME.size)],
        [*range(700), 701, 700, *range(702, TIME.size)],
        [*EVERY, TIME.size - 1],
        [*range(900), *range(2100, TIME.size)],
    ],
    ids=["a row twice", "rows out of order", "the last time twice", "a gap of 12 s"],
)
def test_nor_do_rows_that_are_left_out_hide_it(rows: Sequence[int]) -> None:
    found = converted(slow=1.3, rows=rows)
    assert "The velocity columns are 1.3 times the rates" in found.doubts[0] and found.unusable


def test_a_velocity_of_one_joint_in_a_wrong_scale_is_named() -> None:
    (said,) = converted(of_one=0.75).doubts
    assert re.match(r"Column 'dq2' is 0\.7(5|49|51) times the rate at which the position of joint 2 changes", said)


def test_late_velocities_are_noted() -> None:
    found = converted(late=0.06)
    assert found.doubts == () and any("'dq1' is 60 ms behind the position" in said for said in found.notes)
