"""Whether the arm stays where it was first read until torque comes on."""

from types import SimpleNamespace
from typing import Any

import pytest

from hil.drivers.joint import Joint
from hil.drivers.servo_model import servo_model
from hil.errors import ExperimentError
from hil.setup.unmoved import has_stirred, refuse_moved

ELBOW = Joint("elbow", 2, servo_model("XM430-W350"), direction=-1)


def reads(ticks: int) -> Any:
    """A bus on which the elbow reports this position."""
    return SimpleNamespace(drives={ELBOW: SimpleNamespace(read=lambda register: ticks)})


@pytest.mark.parametrize(("ticks", "stirs"), [(0, False), (2, False), (3, True)])
def test_noise_is_no_motion_and_a_little_motion_is_no_reason_to_refuse(ticks: int, stirs: bool) -> None:
    assert has_stirred({ELBOW: 100}, {ELBOW: 100 + ticks}) is stirs
    refuse_moved({ELBOW: 100}, {ELBOW: 100 + ticks}, reads(100))


def test_a_joint_that_turned_is_refused_whatever_its_turn() -> None:
    refuse_moved({ELBOW: 100}, {ELBOW: 100 + 4096 + 32}, reads(100))
    with pytest.raises(ExperimentError, match=r"Joint 'elbow' .* has turned by -0\.051 rad"):
        refuse_moved({ELBOW: 100}, {ELBOW: 100 - 8192 + 33}, reads(133))


def test_nothing_is_known_of_a_servo_that_was_not_read_before() -> None:
    assert not has_stirred({}, {ELBOW: 7})
    refuse_moved({}, {ELBOW: 7}, reads(7))


def test_a_reply_to_an_earlier_request_is_not_blamed_on_a_hand() -> None:
    with pytest.raises(ExperimentError, match="replies come one request late") as refused:
        refuse_moved({ELBOW: 2048}, {ELBOW: 0}, reads(2050))
    assert "hand" not in str(refused.value)


def test_a_joint_that_hardly_moves_between_the_two_readings_is_no_late_reply() -> None:
    with pytest.raises(ExperimentError, match=r"has turned by -0\.051 rad .* a hand or a cable"):
        refuse_moved({ELBOW: 100}, {ELBOW: 100 + 33}, reads(100 + 32))
