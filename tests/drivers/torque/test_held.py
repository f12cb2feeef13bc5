"""Tests of what counts as a joint that something holds."""

from typing import cast

import pytest

from hil.drivers.servo import Servo
from hil.drivers.torque.held import is_held


class Replies:
    """Answers reads of Torque Enable with these values, one after the other, and everything else with 0."""

    def __init__(self, *values: int) -> None:
        self.values = list(values)

    def read(self, register: str) -> int:
        return self.values.pop(0) if register == "Torque Enable" else 0


@pytest.mark.parametrize(("values", "held"), [((0,), False), ((1, 1), True), ((1, 0), False)])
def test_one_reply_does_not_prove_that_torque_is_on(values: tuple[int, ...], held: bool) -> None:
    """It may be the late reply to the request before."""
    replies = Replies(*values)
    assert is_held(cast(Servo, replies)) is held and not replies.values
