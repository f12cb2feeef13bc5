"""If the replies of two servos are swapped during a run, the message says so and blames no encoder or horn."""

import re
from collections.abc import Callable
from math import isnan, nan
from pathlib import Path
from unittest import mock

import pytest

import hil
from hil.drivers.exchange import Reply
from hil.drivers.joint import Joint, SecondServo
from hil.drivers.servo_model import Mode, servo_model
from hil.drivers.state import Converter, State
from hil.errors import Cause, SafetyStop
from hil.experiment.checks.swapped import SwappedReplies
from tests.support.edits import QUICK, replaced, with_second_servo
from tests.support.paths import CONFIGS

XM, XL = servo_model("XM430-W350"), servo_model("XL430-W250")
ARM = (
    Joint("waist", 1, XM, 1, 2048, near=0.0),
    Joint("hip", 2, XL, -1, 1000, Mode.PWM),
    Joint("knee", 3, XM, 1, 512),
    Joint("tip", 4, XM, -1, -2000),
)


def read(*ticks: float, joints: tuple[Joint, ...] = ARM) -> State:
    """The state in which the joints' servos report these positions [ticks]; NaN for a servo that does not reply."""
    angles = tuple((at - joint.zero_ticks) * joint.position_unit for at, joint in zip(ticks, joints, strict=True))
    nothing = (0.0,) * len(angles)
    missing = tuple(isnan(at) for at in ticks)
    return State(0.0, 0.001, nothing, nothing, nothing, angles, (0,) * len(angles), missing)


BEFORE = read(2100.0, 1400.0, 900.0, 3000.0)


@pytest.mark.parametrize(
    ("now", "pair"),
    [
        ((1400.0, 2100.0, 900.0, 3000.0), (1, 2)),
        ((1420.0, 2080.0, 900.0, 3000.0), (1, 2)),
        ((3000.0, 1400.0, 900.0, 2100.0), (1, 4)),
        ((1400.0 + 4096.0, 2100.0, 900.0, 3000.0), (1, 2)),
        ((1400.0, 1400.0, 900.0, 3000.0), None),
        ((1400.0, 2800.0, 900.0, 3000.0), None),
        ((1700.0, 1800.0, 900.0, 3000.0), None),
        ((1400.0, nan, 900.0, 3000.0), None),
    ],
    ids=[
        *("swapped", "moving", "not neighbours", "zero shifted by a turn"),
        *("one jumps onto the other", "both jump alike", "both jump half way", "the other one is silent"),
    ],
)
def test_both_servos_must_land_where_the_other_one_was(now: tuple[float, ...], pair: tuple[int, int] | None) -> None:
    assert SwappedReplies(ARM).look(0, read(*now), [BEFORE] * 4) == pair


def test_servos_a_few_ticks_apart_prove_nothing() -> None:
    assert SwappedReplies(ARM).look(0, read(2100.0, 2103.0, 0.0, 0.0), [read(2103.0, 2100.0, 0.0, 0.0)] * 4) is None


@pytest.mark.parametrize("direction", [1, -1])
def test_the_two_servos_of_one_joint_may_be_swapped(direction: int) -> None:
    hip = Joint("hip", 2, XM, 1, 1000, seconds=(SecondServo(7, direction),))
    first, second = hip.drives

    def pair(ticks: int, other: int) -> State:
        state = read(ticks, joints=(first,))
        return state._replace(apart=((second.angle(other) - first.angle(ticks),),))

    assert SwappedReplies([hip]).look(0, pair(1700, 1400), [pair(1400, 1700)]) == (2, 7)
    assert SwappedReplies([hip]).look(0, pair(1700, 1700), [pair(1400, 1700)]) is None


def swapping(first: int, second: int, since: float) -> Callable[[Converter, tuple[int, ...], Reply], State]:
    """Return a `Converter.state` that exchanges the answers of two servos, counted from 0, from a given time on [s]."""
    convert = Converter.state

    def state(self: Converter, ticks: tuple[int, ...], reply: Reply) -> State:
        if reply.time_before_write >= since:
            servos = list(reply.servos)
            servos[first], servos[second] = servos[second], servos[first]
            reply = reply._replace(servos=tuple(servos))
        return convert(self, ticks, reply)

    return state


@pytest.mark.parametrize("servos", [(0, 1), (0, 2), (1, 2)])
def test_a_run_names_the_two_servos_and_no_encoder(tmp_path: Path, servos: tuple[int, int]) -> None:
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    text = text.replace("zero_ticks = 2048", "zero_ticks = 2700")
    short = ("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]"), *QUICK
    arm = tmp_path / "arm.toml"
    arm.write_text(with_second_servo(replaced(text, *short), zero_ticks=300), encoding="utf-8")
    with (
        mock.patch.object(Converter, "state", swapping(*servos, since=4.0)),
        pytest.raises(SafetyStop) as stopped,
    ):
        hil.record(arm, out=tmp_path / "run")
    ids = sorted((1, 3, 2)[place] for place in servos)
    named = re.search(r"replies of IDs (\d) and (\d) seem to be swapped", str(stopped.value))
    assert named and sorted(map(int, named.groups())) == ids
    assert "encoder" not in str(stopped.value) and "horn" not in str(stopped.value)
    assert stopped.value.cause is Cause.JUMP
