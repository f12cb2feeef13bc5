"""Conversion from ticks to SI units, including replies of servos that refused or were silent."""

import math

import pytest

from hil.drivers.exchange import Reply
from hil.drivers.joint import Joint
from hil.drivers.servo_model import servo_model
from hil.drivers.state import Converter, State

JOINTS = (
    Joint("shoulder", 1, servo_model("XM430-W350"), zero_ticks=3072),
    Joint("elbow", 2, servo_model("XM430-W350"), direction=-1, zero_ticks=2048),
)


def converted(reply: Reply) -> State:
    converter = Converter(JOINTS, [joint.drive_unit(12.0) for joint in JOINTS])
    return converter.state(converter.ticks([0.269, 0.269]), reply)


def test_units_and_senses_are_those_of_the_manual() -> None:
    state = converted(Reply(1.0, 1.5, 0, [(0, 100, 10, 2048), (0x80, 100, 10, 3072)]))
    # e-Manual, XM430-W350: 2.69 mA, 0.229 rpm, 4096 steps a turn.
    assert state.current == pytest.approx((0.269, -0.269))
    assert state.velocity == pytest.approx((10 * 0.229 * math.tau / 60, -10 * 0.229 * math.tau / 60))
    assert state.position == pytest.approx((-math.pi / 2, -math.pi / 2))
    assert state.goal_current == pytest.approx((0.269, 0.269))
    assert (state.error, state.missing, state.slow) == ((0, 0x80), (False, False), None)
    assert (state.time_before_write, state.time_after_read) == (1.0, 1.5)


def test_a_silent_servo_and_one_that_refused_have_no_numbers_but_the_error_byte() -> None:
    state = converted(Reply(0.0, 0.0, 0, [None, (7,)]))
    for values in (state.current, state.velocity, state.position):
        assert len(values) == 2 and all(math.isnan(value) for value in values)
    assert (state.error, state.missing) == ((0, 7), (True, True))


def test_the_servos_clock_stands_before_the_state_and_health_behind_it() -> None:
    ticking = converted(Reply(0.0, 0.0, 1, [(0, 1500, 100, 10, 3072), None]))
    assert ticking.slow is not None and ticking.position[0] == 0.0
    assert ticking.slow.tick[0] == 1.5 and math.isnan(ticking.slow.tick[1])
    assert math.isnan(ticking.slow.temperature[0])
    healthy = converted(Reply(0.0, 0.0, 2, [(0, 100, 10, 3072, 118, 41), (7,)]))
    assert healthy.slow is not None and healthy.position[0] == 0.0
    assert healthy.slow.voltage[0] == pytest.approx(11.8) and math.isnan(healthy.slow.voltage[1])
    assert healthy.slow.temperature[0] == 41.0 and math.isnan(healthy.slow.tick[0])
