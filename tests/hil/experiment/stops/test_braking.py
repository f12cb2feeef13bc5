"""How long the arm is braked before its torque is cut."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.drivers.errors import TorqueNotOff
from hil.errors import StopRequested
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.spied_plant import call_at
from tests.support.stops.stopped_runs import Arm, assert_stopped, fault, once, stall, swing_elbow


def braked_samples(arm: Arm, folder: Path, ports: list[Any], plan: Plan, then: Callable[[], None] | None) -> int:
    """Number of braking samples after Ctrl-C, with `then` called 12 ms later."""
    config = arm(("[experiment]\n", "[safety]\ndamp_time = 0.06\n\n[experiment]\n"))

    def act() -> None:
        port = ports[-1]
        os.kill(os.getpid(), signal.SIGINT)
        if then is not None:
            call_at(port, port.clock.now() + 0.012, then)

    run = RunFolder.create(folder, config)
    with pytest.raises(StopRequested):
        run_experiment(config, run, config.path, once(act), plan)
    assert_stopped(ports[-1])
    return int(np.count_nonzero(load_samples(run.samples_path, 2)["phase"] == Phase.BRAKING))


def test_braking_takes_its_time_and_no_more(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    assert braked_samples(arm, tmp_path / "run", ports, plan, None) == 24


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_ends_the_braking_at_once(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, second: signal.Signals
) -> None:
    count = braked_samples(arm, tmp_path / "run", ports, plan, lambda: os.kill(os.getpid(), second))
    assert 2 <= count <= 5


def test_a_missed_deadline_ends_the_braking(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    assert 2 <= braked_samples(arm, tmp_path / "run", ports, plan, lambda: stall(ports, 0.03)) <= 5


def test_a_cable_unplugged_while_the_arm_is_braked_ends_the_current_within_the_time_of_a_stop(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    """Its watchdogs are shortened: those of the experiment would act 0.12 s or more after the signal."""
    config = arm(("[experiment]\n", "[safety]\ndamp_time = 0.06\n\n[experiment]\n"))
    begun: list[float] = []

    def act() -> None:
        begun.append(ports[-1].clock.now())
        os.kill(os.getpid(), signal.SIGHUP)
        swing_elbow(ports, 8.0)
        call_at(ports[-1], begun[0] + 0.05, lambda: fault(ports, FaultKind.CABLE_PULLED))

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises((StopRequested, TorqueNotOff)):
        run_experiment(config, run, config.path, once(act), plan)
    for servo in ports[-1].bus.servos.values():
        assert 0.03 < servo.heard_at - begun[0] < 0.06, "it was braked until then"
        assert servo.heard_at + servo.watchdog_s - begun[0] < 0.1


def test_a_joint_whose_replies_are_missing_is_not_taken_to_be_at_rest(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm(("[experiment]\n", "[safety]\nwatchdog = 2.0\nmax_missing = 1000\n\n[experiment]\n"))
    run = RunFolder.create(tmp_path / "run", config)
    lose = once(lambda: fault(ports, FaultKind.LOST_REPLY, servo=2, duration=1.1), Phase.COMING_TO_REST)
    run_experiment(config, run, config.path, lose, plan)
    samples = load_samples(run.samples_path, 2)
    ending = samples[samples["phase"] == Phase.COMING_TO_REST]
    unseen = np.flatnonzero(ending["missing"][:, 1])
    assert len(unseen) > 200
    assert np.isfinite(ending["velocity"][unseen[-1] + 1 :]).all() and len(ending) > unseen[-1] + 1
    assert_stopped(ports[0])
