"""Runs that are stopped on purpose on the fake two-joint arm, and what is done to its servos."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.config.schema import Config
from hil.errors import SafetyStop
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress
from hil.fakes.bus.faults import Fault, FaultKind
from hil.plan.plan import Plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from tests.support.spied_plant import SpiedPlant, Spy

Arm = Callable[..., Config]
STIFF_GUARD = ("[experiment]\n", "[safety]\nmax_temperature = 40.0\nmin_voltage = 11.0\n\n[experiment]\n")


def swing_elbow(ports: list[Any], velocity: float) -> None:
    """Give the elbow this velocity [rad/s]."""
    plant = ports[0].bus.plant
    plant._state = (*plant._state[:3], velocity, *plant._state[4:])


SHORTER = (
    ("period = 2.0 ", "period = 1.0 "),
    ("band = [0.5, 6.0]", "band = [1.0, 6.0]"),
    ("ramp = 1.0 ", "ramp = 0.5 "),
)
"""Half a run, because its time is proportional to its samples."""


def run_until_stopped(
    config: Config, folder: Path, act: Callable[[Progress], None], plan: Plan
) -> tuple[SafetyStop, np.ndarray]:
    run = RunFolder.create(folder, config)
    with pytest.raises(SafetyStop) as stop:
        run_experiment(config, run, config.path, act, plan)
    return stop.value, load_samples(run.samples_path, 2)


def once(action: Callable[[], Any], phase: Phase = Phase.PERIODIC, after: int = 500) -> Callable[[Progress], None]:
    done: list[bool] = []

    def act(progress: Progress) -> None:
        if progress.phase == phase and progress.taken >= after and not done:
            done.append(True)
            action()

    return act


def assert_stopped(port: Any) -> None:
    """Assert that both servos have no torque, or a tripped watchdog, and that their motors carry no current."""
    port.clock.wait_until(port.clock.now() + 0.1)
    servos = list(port.bus.servos.values())
    assert len(servos) == 2
    assert all(not servo.torque_enabled or servo.watchdog_tripped for servo in servos)
    assert [servo.motor_current_a for servo in servos] == [0.0, 0.0]


def fault(ports: list[Any], kind: FaultKind, **options: Any) -> None:
    bus = ports[0].bus
    bus.faults.add(Fault(kind=kind, at=bus.time, **options))


def turn_round(ports: list[Any], joint: int) -> None:
    bus = ports[0].bus
    bus.plant = bus._joints._plant = SpiedPlant(bus.plant, Spy(turned=joint))


def stall(ports: list[Any], seconds: float) -> None:
    ports[0].clock._now += seconds
