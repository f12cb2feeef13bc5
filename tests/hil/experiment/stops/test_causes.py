"""Every cause of a guard stop, provoked on the fake arm: the emulated servos must end without torque."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil.drivers.bus import ServoBus
from hil.errors import Cause, SafetyStop
from hil.experiment.checks import work
from hil.experiment.model_watch import ModelWatch
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan, make_plan
from hil.runs.recording import Phase
from hil.runs.run_folder import RunFolder
from tests.support.stops.stopped_runs import (
    STIFF_GUARD,
    Arm,
    assert_stopped,
    fault,
    once,
    run_until_stopped,
    stall,
    swing_elbow,
    turn_round,
)

CAUSES: list[tuple[Cause, str, Callable[[list[Any]], None]]] = [
    (Cause.TEMPERATURE, r"'shoulder'.*at 50 degrees C", lambda p: setattr(p[0].bus.servos[1], "temperature_c", 50.0)),
    (
        Cause.VOLTAGE,
        r"'elbow'.*has a supply voltage of 10\.5 V",
        lambda p: setattr(p[0].bus.servos[2], "input_voltage_v", 10.5),
    ),
    (Cause.ALERT, r"'elbow'.*overload", lambda p: fault(p, FaultKind.OVERLOAD, servo=2)),
    (Cause.MISSING, r"'elbow'.*missed 6 replies", lambda p: fault(p, FaultKind.LOST_REPLY, servo=2, duration=0.1)),
    (
        Cause.MISSING,
        r"missed .*\. Replies did arrive, but too late: .*, the USB hub",
        lambda p: fault(p, FaultKind.LATE_REPLY, amount=0.06, duration=0.003),
    ),
    (Cause.LATE, r"deadlines in a row", lambda p: stall(p, 0.06)),
    (
        Cause.JUMP,
        r"'elbow'.*reports an angle that changed by -0",
        lambda p: fault(p, FaultKind.ENCODER_JUMP, servo=2, amount=-120),
    ),
    (
        Cause.TORQUE_OFF,
        r"'shoulder'.*has lost its torque.*Symptom: .*carries 0\.000",
        lambda p: p[0].bus.servos[1].write(64, b"\x00"),
    ),
    (Cause.WRONG_SIGN, r"against its command", lambda p: turn_round(p, 0)),
]


@pytest.mark.parametrize(("cause", "said", "happens"), CAUSES, ids=[cause.name for cause, *_ in CAUSES])
def test_what_goes_wrong_in_a_period_stops_the_arm_for_that_cause(
    arm: Arm,
    tmp_path: Path,
    ports: list[Any],
    plan: Plan,
    cause: Cause,
    said: str,
    happens: Callable[[list[Any]], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if cause in (Cause.TORQUE_OFF, Cause.WRONG_SIGN):
        # Every layer must stop the arm alone; the model detects a disobedient motor too, and may be first.
        monkeypatch.setattr(ModelWatch, "look", lambda *_: None)
    low = () if cause is not Cause.TORQUE_OFF else (("current_limit = 1.2", "current_limit = 0.5"),)
    stop, samples = run_until_stopped(arm(STIFF_GUARD, *low), tmp_path / "run", once(lambda: happens(ports)), plan)
    assert stop.cause is cause and re.search(said, str(stop))
    assert_stopped(ports[0])
    assert (Phase.BRAKING in samples["phase"]) == stop.cause.allows_braking


@pytest.mark.parametrize(
    "said", ["Shortly before this, Goal Current of joint 'elbow' was -9 although 3 had been written.", ""]
)
def test_a_foreign_goal_just_before_a_stop_is_noted(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServoBus, "commanded_by_another", said)
    monkeypatch.setattr(ModelWatch, "look", lambda *_: None)
    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lambda: swing_elbow(ports, 25.0)), plan)
    assert stop.cause is Cause.VELOCITY
    assert stop.overruled == bool(said) and (said in stop.__notes__) == bool(said)


@pytest.mark.parametrize(
    ("happens", "said"),
    [
        (lambda ports: turn_round(ports, 0), "any arm"),
        (lambda ports: fault(ports, FaultKind.STUCK_JOINT, servo=1), "is not moving|any arm"),
    ],
)
def test_the_model_alone_stops_a_motor_that_does_not_do_as_told(
    arm: Arm,
    tmp_path: Path,
    ports: list[Any],
    plan: Plan,
    monkeypatch: pytest.MonkeyPatch,
    happens: Callable[[list[Any]], None],
    said: str,
) -> None:
    monkeypatch.setattr(work, "TOLERANCE_RAD", math.inf)
    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lambda: happens(ports)), plan)
    assert stop.cause is Cause.UNEXPECTED and re.search(said, str(stop))
    assert_stopped(ports[0])


def test_a_joint_that_is_elsewhere_than_a_period_before_is_said_so(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short push that the model does not detect; here, the model check is disabled."""
    monkeypatch.setattr(ModelWatch, "look", lambda *_: None)

    def push() -> None:
        swing_elbow(ports, ports[0].bus.plant.velocity[1] + 2.0)

    plan = replace(plan, periods=3)
    run = RunFolder.create(tmp_path / "run", config := arm())
    late = once(push, after=200 + 200 + 4 * 400 + 100)
    with pytest.raises(SafetyStop, match=r"does not repeat its motion: under the same torque") as stop:
        run_experiment(config, run, config.path, late, plan)
    assert stop.value.cause is Cause.UNLIKE_BEFORE
    assert_stopped(ports[0])


def test_a_computer_that_stalls_beyond_the_watchdogs_time_finds_the_arm_stopped(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    tripped: list[bool] = []

    def sleep() -> None:
        stall(ports, 0.3)
        tripped.extend(servo.watchdog_tripped for servo in ports[0].bus.servos.values())

    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(sleep), plan)
    assert tripped == [True, True]
    assert stop.cause is Cause.LATE
    assert_stopped(ports[0])


def test_commands_too_far_apart_for_the_watchdogs(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    config = arm(("rate = 400.0", "rate = 40.0"), ("[experiment]\n", "[safety]\nwatchdog = 0.02\n\n[experiment]\n"))
    stop, samples = run_until_stopped(config, tmp_path / "run", lambda _: None, make_plan(config))
    # Whichever is detected first: the gap, or the servo's own status.
    assert (stop.cause is Cause.LATE and "25 ms passed between two commands" in str(stop)) or (
        stop.cause is Cause.WATCHDOG and "received nothing for 20 ms" in str(stop)
    )
    assert len(samples) <= 2
    assert_stopped(ports[0])
