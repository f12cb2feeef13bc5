"""Open-loop prediction of a motion from given parameters, without measurements but with the arm's own feedback."""

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.late_torque import as_moving, lags_of
from hil.estimator.chain.simulation.sensitivity import ChainRun, Simulation
from hil.estimator.data.settled_period import SettledPeriod
from hil.estimator.errors import PeriodicityError
from hil.estimator.simulation.arm import steps_per_sample
from hil.estimator.simulation.closed_loop import Feedback

PERIODS = 3  # number of periods simulated, of which the last is used
FINER = 4  # smaller integration steps that replace one near standstill
NEVER = 1e6  # N m: a torque limit that is never reached


def predict(model: ChainModel, parameters: dict[str, float], period: SettledPeriod) -> Array:
    """Predict the joint angles (joints, samples) [rad] of a settled period under its commands and its feedback.

    The simulation starts at rest at the first measured position and continues until the transient has decayed. Raises
    PeriodicityError if the motion diverges.
    """
    joints, samples = period.joints, period.samples
    excitation, feedback = _commands(period)
    steps = steps_per_sample(period.rate)
    step = 1.0 / (period.rate * steps)
    # Commands take effect `command_to_sample` before the sample of their index, plus `delay`; lumped into a lag.
    late = lags_of(parameters, joints) + parameters.get("delay", 0.0) - period.command_to_sample
    lag = np.maximum(late, 1e-5)
    fallen = 1.0 - np.exp(-step / lag)
    share = fallen * lag / step
    start = np.stack((period.filled()[:, 0], np.zeros(joints)))
    simulation = Simulation(model.base, as_moving(model.base, parameters), start, np.zeros((2, joints)))
    missing, slopes = np.full((1, joints), np.nan), np.zeros((1, steps, 2, joints))
    torque = np.empty((1, steps, joints))
    former = start.copy()
    motor = np.clip(excitation[:, -1], -feedback.limit, feedback.limit)
    positions = np.empty((joints, samples))
    for k in range(PERIODS * samples):
        wanted = excitation[:, k % samples] + feedback.stiffness * (feedback.pose - former[0])
        command = np.clip(wanted - feedback.damping * former[1], -feedback.limit, feedback.limit)
        former = simulation.state.copy()
        for s in range(steps):
            torque[0, s] = command + (motor - command) * share
            motor = motor + (command - motor) * fallen
        position, _ = simulation.go_on(ChainRun(torque, slopes, missing, step, FINER), slice(0, 1))
        if position is None:
            raise PeriodicityError("with these parameters the simulated arm diverges from the measured motion")
        positions[:, k % samples] = position[0]
    return positions


def _commands(period: SettledPeriod) -> tuple[Array, Feedback]:
    """Return the commanded torque without the feedback's contribution (joints, samples) [N m], and the feedback."""
    if period.stabiliser is None:
        feedback = Feedback.none(period.joints)
        return period.torque, Feedback(
            feedback.stiffness, feedback.damping, feedback.pose, np.full(period.joints, NEVER)
        )
    return period.stabiliser.excitation, period.stabiliser.feedback
