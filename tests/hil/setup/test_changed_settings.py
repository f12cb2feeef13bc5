"""What is said of settings that differ from those before the run."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from hil.drivers.joint import Joint
from hil.drivers.servo_model import Mode, servo_model
from hil.errors import Cause
from hil.setup.changed_settings import changed_settings, settings_now

SHOULDER, ELBOW = (Joint(name, number, servo_model("XM430-W350")) for number, name in ((1, "shoulder"), (2, "elbow")))
LIMIT = "Current Limit"


@pytest.mark.parametrize(("shoulder", "elbow"), [(298, 447), (596, 447), (298, 100)])
def test_a_servo_with_anothers_settings_may_have_its_id(shoulder: int, elbow: int) -> None:
    before = {(SHOULDER, LIMIT): 447, (ELBOW, LIMIT): 298}
    after = {(SHOULDER, LIMIT): shoulder, (ELBOW, LIMIT): elbow}
    assert "their IDs may have been swapped" in changed_settings(before, after)


@pytest.mark.parametrize(("before", "after"), [((447, 298), (447, 100)), ((447, 447), (447, 100)), ((0, 1), (1, 1))])
def test_one_that_differs_from_all_before_has_not(before: tuple[int, int], after: tuple[int, int]) -> None:
    settings = [dict(zip(((SHOULDER, LIMIT), (ELBOW, LIMIT)), each, strict=True)) for each in (before, after)]
    said = changed_settings(settings[0], settings[1])
    assert LIMIT in said and ("swapped" in said) == (before == (0, 1))


def test_a_protection_is_named_beside_the_cause_of_a_stop_but_is_none() -> None:
    before = {(SHOULDER, LIMIT): 447, (ELBOW, "Shutdown"): 52}
    alone = {**before, (ELBOW, "Shutdown"): 0}
    assert changed_settings(before, alone, Cause.POSITION) == ""
    assert "Shutdown from 52 to 0" in changed_settings(before, alone)
    assert changed_settings(
        {(ELBOW, "Secondary(Shadow) ID"): 255}, {(ELBOW, "Secondary(Shadow) ID"): 1}, Cause.POSITION
    )
    both = {**alone, (SHOULDER, LIMIT): 100}
    assert all(
        each in changed_settings(before, both, Cause.POSITION)
        for each in ("Shutdown from 52 to 0", "Limit from 447 to 100")
    )


def test_a_servo_of_another_model_that_answers_with_anothers_settings_may_have_its_id() -> None:
    other = Joint("elbow", 2, servo_model("XL430-W250"), mode=Mode.PWM)
    both = "PWM Limit", "Operating Mode"
    before = dict.fromkeys(((joint, name) for joint in (SHOULDER, other) for name in both), 885)
    before |= {(SHOULDER, LIMIT): 447, (SHOULDER, both[1]): 0, (other, both[1]): 16}
    assert "swapped" not in changed_settings(before, {**before, (other, both[0]): 400}, Cause.JUMP)
    after = {**before, (other, both[1]): 0}
    assert changed_settings(before, after, Cause.JUMP) == (
        "Another program changed the settings of a servo during the run. Joint 'elbow' (ID 2, XL430-W250) now has the "
        "settings that joint 'shoulder' (ID 1, XM430-W350) had: their IDs may have been swapped."
    )


@pytest.mark.parametrize("register", ["PWM Limit", LIMIT, "Goal PWM"])
def test_a_raised_limit_stops_nothing(register: str) -> None:
    before, after = {(ELBOW, register): 400}, {(ELBOW, register): 800}
    assert changed_settings(before, after, Cause.JUMP) == ""
    assert f"{register} from 400 to 800" in changed_settings(before, after), "it is named beside the cause"
    assert f"{register} from 800 to 400" in changed_settings(after, before, Cause.JUMP)


class Late:
    """A servo whose replies are `late` requests old."""

    def __init__(self, late: int) -> None:
        self.id, self.answered_pings_only = 2, False
        self.table = {"ID": 2, "Operating Mode": 16, "Drive Mode": 0, "Homing Offset": 0, "Return Delay Time": 0}
        self._replies = [0] * late

    def read(self, register: str, attempts: int) -> int:
        self._replies.append(self.table[register])
        return self._replies.pop(0)


@pytest.mark.parametrize("late", [0, 1, 2])
def test_settings_are_unknown_if_replies_are_late(late: int) -> None:
    """Several settings are 0, and would be taken for another that is not."""
    servo = Late(late)
    found = settings_now(cast(Any, SimpleNamespace(drives={ELBOW: servo}, torque_off_report=None)))
    known = {(ELBOW, name): value for name, value in servo.table.items() if name != "ID"}
    assert found == ({} if late else known)
