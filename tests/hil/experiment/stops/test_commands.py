"""Goals that are sent or refused, and torque off that not every servo hears."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.drivers.bus import ServoBus
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from tests.support.stops.stopped_runs import Arm, assert_stopped, fault, once, run_until_stopped


def test_torque_off_is_repeated_until_a_deaf_servo_hears_it(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its watchdog does not act, because another program has switched it off."""
    deaf_s = 0.5
    begun: list[float] = []
    ends: list[float] = []
    repeat = ServoBus.repeat_torque_off

    def deafen() -> None:
        servo = ports[0].bus.servos[2]
        servo.memory.set("Bus Watchdog", 0)
        servo._derive()
        fault(ports, FaultKind.LOST_INSTRUCTION, servo=2, duration=deaf_s)
        begun.append(ports[0].bus.time)

    def note(bus: ServoBus) -> None:
        repeat(bus)
        bus.port.clock.wait_until(bus.port.clock.now() + 1e-3)
        ports[0].bus.advance(bus.port.clock.now())
        if not ports[0].bus.servos[2].torque_enabled and not ends:
            ends.append(bus.port.clock.now() - begun[0])

    monkeypatch.setattr(ServoBus, "repeat_torque_off", note)
    config = arm()
    with pytest.raises(SafetyStop, match="Torque is off on both servos"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, once(deafen), plan)
    assert deaf_s < ends[0] < deaf_s + 0.06


def test_replies_lost_only_while_torque_is_cut_at_the_end_are_named(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = ServoBus.torque_off

    def behind_a_loss(bus: ServoBus) -> Any:
        fault(ports, FaultKind.LOST_REPLY, servo=2, duration=0.4)
        return cut(bus)

    monkeypatch.setattr(ServoBus, "torque_off", behind_a_loss)
    config = arm()
    with pytest.raises(
        ExperimentError, match=r"^Replies were missing when torque was cut.*\nTorque is off on both servos"
    ):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])


def test_a_goal_that_is_no_number_is_never_sent(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    config = arm()
    broken = plan.segments[0].period_current.copy()
    broken[100, 1] = np.nan
    plan = replace(plan, segments=(replace(plan.segments[0], period_current=broken),))
    stop, samples = run_until_stopped(config, tmp_path / "run", lambda _: None, plan)
    assert stop.cause is Cause.NOT_A_NUMBER
    assert np.isfinite(samples["goal_current"]).all()
    assert_stopped(ports[0])


def test_a_jump_of_the_wanted_current_reaches_the_servos_in_steps(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm(("[experiment]\n", "[safety]\nslew = 20.0\n\n[experiment]\n"))
    square = np.zeros_like(plan.segments[0].period_current)
    square[::80, 0] = 0.2
    plan = replace(plan, segments=(replace(plan.segments[0], period_current=square),))
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError):  # the elbow, which gets no torque, counts as stuck
        run_experiment(config, run, config.path, lambda _: None, plan)
    sent = load_samples(run.samples_path, 2)["goal_current"]
    assert 0 < np.abs(np.diff(sent, axis=0)).max() <= 20.0 / 400 + 2.7e-3
