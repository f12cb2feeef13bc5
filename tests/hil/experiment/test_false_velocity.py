"""A servo that reports a false velocity in intact replies: the arm is stopped, and no brake drives the joint."""

import math

import numpy as np
import pytest

from benchmarks.fault_campaign.arms import Setting
from benchmarks.fault_campaign.attack import Attack, Kind
from benchmarks.fault_campaign.campaign import Outcome, Ready, inject_drawn, prepare
from benchmarks.fault_campaign.draw import Drawn
from benchmarks.fault_campaign.judge import DRIVES_MS
from hil.plan.recent_motion import RecentMotion

PERIOD_S = 1.0
BEYOND, WITHIN = 1100.0, 200.0  # ticks, 26 and 4.8 rad/s


def stopped(ready: Ready, velocity: float, *further: Attack) -> Outcome:
    """Replace the last joint's velocity by a constant [ticks] while it moves fastest."""
    joint = ready.config.joints[-1]
    false = Attack(Kind.CONSTANT, fastest(ready), math.inf, joint.id, amount=velocity, field="velocity")
    return inject_drawn(ready, Drawn((false, *further), ()), 0)


def fastest(ready: Ready) -> float:
    record = ready.undisturbed.record[:, -1]
    return float(record["time"][np.argmax(np.abs(record["velocity"]))])


@pytest.mark.parametrize("name", ["fake_pendulum", "xl430_two_link"], ids=["current", "PWM"])
@pytest.mark.parametrize("rate", [20, 100, 400])
def test_a_velocity_that_contradicts_the_position_is_no_reason_to_brake(name: str, rate: int) -> None:
    ready = prepare(Setting(name, rate), PERIOD_S)
    for sign in (1.0, -1.0):
        outcome = stopped(ready, sign * BEYOND)
        assert outcome.is_good and outcome.code == 1, str(outcome)
        assert outcome.verdict.drives_ms == 0.0, str(outcome)
        assert f"reports a velocity of {sign * 26.38:+.2f} rad/s that contradicts its position" in outcome.text
        assert "velocity limit" not in outcome.text and "peak_torque" not in outcome.text


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_brake_of_another_cause_does_not_follow_a_false_velocity(sign: float) -> None:
    """Ctrl-C just after the reading became false, before anything else can have noticed."""
    ready = prepare(Setting("fake_pendulum", 400), PERIOD_S)
    outcome = stopped(ready, sign * WITHIN, Attack(Kind.SIGINT, fastest(ready) + 0.004, math.inf))
    assert outcome.code == 130 and outcome.verdict.drives_ms == 0.0 and outcome.is_good, str(outcome)


def test_the_campaign_sees_a_brake_that_drives_a_joint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecentMotion, "believed", lambda _, state: list(state.velocity))
    monkeypatch.setattr(RecentMotion, "speeds", lambda _: [0.0])
    monkeypatch.setattr(RecentMotion, "contradicts", lambda *_: False)
    ready = prepare(Setting("fake_pendulum", 400), PERIOD_S)
    true = ready.undisturbed.record["velocity"][:, -1]
    outcome = stopped(ready, -math.copysign(BEYOND, true[np.argmax(np.abs(true))]))
    assert outcome.verdict.drives_ms > DRIVES_MS and outcome.verdict.unsafe
    assert "DRIVES a joint" in str(outcome)
