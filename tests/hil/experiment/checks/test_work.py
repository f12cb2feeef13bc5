"""When a motor that takes work out of the arm counts as turned round: how much, and which work is known."""

import numpy as np
import pytest

from hil.drivers.state import State
from hil.experiment.checks import work
from hil.experiment.checks.joint_checks import CHECKS, FINE, JOINT, WORK, JointChecks

ANY = 1e9
INTERVAL = 2.0**-8
"""Time between two exchanges [s]: sums of it are not rounded."""

PLANNED = 1.0  # A; at 1 N m/A, 0.04 J may be taken out


class Arm:
    """An arm of which only the work is checked. Each joint is moved by hand, against or with the goal that it holds."""

    def __init__(self, joints: int) -> None:
        self.records = np.zeros(joints, JOINT)
        self.records["low"], self.records["high"] = -ANY, ANY
        self.records["fastest"] = self.records["farthest"] = ANY
        self.records["is_worked"] = True
        for record in self.records:
            work.begin(record["work"], 1.0, PLANNED)
        self.checks = JointChecks(self.records, INTERVAL)
        self.position = np.zeros(joints)
        self.now = 0.0

    def look(self, goal: list[float], moved: list[float], intervals: float = 1.0, missed: int = 0) -> int:
        """Pass on a state in which the joints have moved by `moved` [rad] since the last one; return what is found."""
        self.now += intervals * INTERVAL
        self.position += moved
        # Just as fast as the position says, so that nothing else is found.
        velocity = tuple(each / INTERVAL for each in moved)
        count = len(goal)
        state = State(
            *(self.now, self.now, tuple(goal), tuple(goal), velocity, tuple(self.position)),
            *((0,) * count, (False,) * count),
        )
        if not missed:
            return self.checks.look(state, ANY)
        found = [self.checks.look_at(joint, state, ANY, missed) for joint in range(count)]
        return next((each for each in found if each != FINE), FINE)


@pytest.mark.parametrize(("taken", "found"), [(0.0399, FINE), (0.0401, WORK)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_work_of_the_planned_peak_over_the_tolerance_may_be_taken_out(
    sign: float, taken: float, found: int
) -> None:
    arm = Arm(1)
    assert arm.look([sign * PLANNED], [0.0]) == FINE
    assert arm.look([0.0], [-sign * taken]) == found
    if found == WORK:
        assert arm.records["found"][0] == pytest.approx(taken)


@pytest.mark.parametrize(("taken", "found"), [(0.539, FINE), (0.541, WORK)])
def test_half_of_what_other_motors_have_put_in_may_be_taken_out(taken: float, found: int) -> None:
    """The second joint puts in 1 J. What the third has taken out is no part of that."""
    arm = Arm(3)
    assert arm.look([PLANNED, PLANNED, PLANNED], [0.0, 0.0, 0.0]) == FINE
    assert arm.look([PLANNED, 0.0, 0.0], [0.0, 1.0, -0.03]) == FINE
    assert arm.look([0.0, 0.0, 0.0], [-taken, 0.0, 0.0]) == found


@pytest.mark.parametrize(
    ("intervals", "missed", "done"), [(1.0, 0, -0.03), (2.9, 0, -0.03), (3.1, 0, 0.0), (2.0, 1, 0.0)]
)
def test_work_is_unknown_if_other_goals_may_have_acted_in_between(intervals: float, missed: int, done: float) -> None:
    """After a long gap or a missing reply: whatever the goal, neither work done nor work taken out counts."""
    for sign in (1.0, -1.0):
        arm = Arm(1)
        assert arm.look([sign * PLANNED], [0.0]) == FINE
        assert arm.look([0.0], [-sign * 0.03], intervals, missed) == FINE
        assert arm.records["work"]["done"][0] == pytest.approx(done)


def test_the_second_joint_of_three_is_named() -> None:
    arm = Arm(3)
    assert arm.look([0.0, PLANNED, 0.0], [0.0, 0.0, 0.0]) == FINE
    assert arm.look([0.0, 0.0, 0.0], [0.0, -0.05, 0.0]) == CHECKS + WORK
