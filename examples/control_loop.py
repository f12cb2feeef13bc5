"""Code shared by both examples: an identified run, and a loop that sends torques at a fixed rate under hil's guard."""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil import load_model
from hil.arm_model import ArmModel
from hil.config.schema import Config, load_config
from hil.drivers.rate import FixedRate
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.guard import Guard
from hil.experiment.run import run_experiment
from hil.runs.run_folder import RunFolder
from hil.setup.session.servo_session import servo_session

Array = NDArray[np.float64]
MOST_JOINTS = 2
"""The examples move an arm that hangs from its base; a spatial arm needs a path that keeps clear of itself."""

Controller = Callable[[int, Array, Array], Array]
"""Takes the sample number, angles [rad] and velocities [rad/s] (joints,); returns torques [N m] (joints,)."""


def identified_arm() -> tuple[Config, ArmModel]:
    """Load the run folder given on the command line, or identify the realistic fake arm."""
    if len(sys.argv) > 1:
        run = RunFolder.open(Path(sys.argv[1]))
        config = run.load_config()
        if len(config.joints) > MOST_JOINTS:
            sys.exit(f"{run.path} is of an arm of {len(config.joints)} joints; this example moves one or two joints.")
        return config, load_model(run.path)
    config = load_config(Path("fake_two_link"))
    with tempfile.TemporaryDirectory() as folder:
        run = RunFolder.create(Path(folder) / "run", config)
        run_experiment(config, run, config.path, lambda _: None)
        estimate_run(run)
        return config, load_model(run.path)


def play(config: Config, model: ArmModel, controller: Controller, samples: int) -> Array:
    """Run the controller for `samples` samples; return the measured angles (samples, joints) [rad]. Torque is off
    afterwards.
    """
    guard = Guard(config)
    measured = np.empty((samples, len(model.joints)))
    goals = [0.0] * len(model.joints)
    with servo_session(config) as bus, bus.torque(config.safety.watchdog):
        rate = FixedRate(bus.port.clock, config.experiment.rate)
        for index in range(samples):
            rate.wait()
            state = bus.exchange(goals)
            guard.look(state)
            measured[index] = state.position
            # This torque is sent with the next exchange, one sample later.
            torque = controller(index, measured[index], np.array(state.velocity))
            goals = guard.clamp(model.goal(torque).tolist())
    return measured
