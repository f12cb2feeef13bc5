"""Prediction of a motion from given parameters, using the arm's own feedback but no measurements."""

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
FINER = 4  # number of smaller integration steps that replace one step near standstill
NEVER = 1e6  # N m: a torque limit that is never reached


def predict(model: ChainModel, parameters: dict[str, float], period: SettledPeriod) -> Array:
    """Predict the joint angles (joints, samples) [rad] of a settled period under its commands and its feedback.

    The simulation starts at rest at the first measured position and lasts for PERIODS periods, so that the transient
    decays. Raises PeriodicityError if the motion diverges.
    """
    joints, samples = period.joints, period.samples
    excitation, feedback = _commands(period)
    steps = steps_per_sample(period.rate)
    step = 1.0 / (period.rate * steps)
    # The delay is lumped into the lag, less `command_to_sample`, by which commands act before the samples of the same
    # index.
    late = lags_of(parameters, joints) + parameters.get("delay", 0.0) - period.command_to_sample
    lag = np.maximum(late, 1e-5)
    fallen = 1.0 - np.exp(-step / lag)
    share = fallen * lag / step
    start = np.stack((period.filled()[:, 0], np.zeros(joints)))
    simulation = Simulation(model.base, as_moving(model.base, parameters), start, np.zeros((2, joints)))
    missing, slopes = np.full((1, joints), np.nan), np.zeros((1, steps, 2, joints))
    torque = np.empty((1, steps, joints))
    one = ChainRun(torque, slopes, missing, step, FINER)
    stiffness, damping, pose, most = feedback.stiffness, feedback.damping, feedback.pose, feedback.limit
    least, sample, given = -most, slice(0, 1), np.ascontiguousarray(excitation.T)
    former = start.copy()
    motor = np.minimum(np.maximum(given[-1], least), most)
    positions = np.empty((samples, joints))
    for k in range(PERIODS * samples):
        wanted = given[k % samples] + stiffness * (pose - former[0])
        command = np.minimum(np.maximum(wanted - damping * former[1], least), most)
        former = simulation.state.copy()
        for s in range(steps):
            lead = motor - command
            torque[0, s] = command + lead * share
            motor = motor - lead * fallen
        position, _ = simulation.go_on(one, sample)
        if position is None:
            raise PeriodicityError("with these parameters the simulated arm diverges from the measured motion")
        positions[k % samples] = position[0]
    return np.ascontiguousarray(positions.T)


def _commands(period: SettledPeriod) -> tuple[Array, Feedback]:
    """Return the commanded torque without the feedback's contribution (joints, samples) [N m], and the feedback."""
    if period.stabiliser is None:
        feedback = Feedback.none(period.joints)
        return period.torque, Feedback(
            feedback.stiffness, feedback.damping, feedback.pose, np.full(period.joints, NEVER)
        )
    return period.stabiliser.excitation, period.stabiliser.feedback
