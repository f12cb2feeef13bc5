"""Judgement of a spatial arm's result and of its recordings: true values, torque error, clearance, limits."""

from pathlib import Path

import numpy as np

import hil
from hil.clearance.space import Space
from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.estimator.arrays import Array
from hil.fakes.servo.registers import load_model
from hil.plan.chain_model import known_chain
from hil.runs.recording import Phase, load_samples

WRONG_TORQUE, WRONG_STDS, WRONG_SHARE = 2.0, 3.0, 0.1  # percent of the torque; standard errors; share of parameters


def joint_1_unit(config: Config, found: hil.Identification) -> float:
    """Ratio of joint 1's true torque per goal to the configured value, which is the torque unit of a result.

    The ratio is 1 if torque scales were not estimated, since every joint's configured constant was then trusted.
    """
    assert config.fake is not None and config.fake.chain is not None
    if "torque_scale_2" not in found.extra:
        return 1.0
    first = config.joints[0]
    true = config.fake.chain.drives[0].torque_constant
    if first.drive_mode is Mode.PWM:  # the configured torque is per volt
        true /= load_model(first.model).resistance_ohm
    return true / first.torque_per_goal


def true_values(config: Config, found: hil.Identification) -> dict[str, float]:
    """True values of `found.parameters`, in units of joint 1's configured torque."""
    unit = joint_1_unit(config, found)
    return {name: value / unit for name, value in (found.truth or {}).items()}


def judged(config: Config, found: hil.Identification) -> dict[str, float]:
    """Compare a result with the truth: worst joint's torque error on random motions, coverage of error bars."""
    known, n = known_chain(config), len(config.joints)
    random = np.random.default_rng(5)
    q, v, a = (size * random.standard_normal((n, 300)) for size in (1.0, 1.5, 4.0))
    Y = known.base.regressor(q, v, a)
    truth = true_values(config, found)
    right = Y @ np.array([truth[name] for name in known.base.names])
    wrong = Y @ np.array([found.parameters[name].value for name in known.base.names]) - right
    error = wrong.std(axis=1) / right.std(axis=1)
    within = [found.covariance.names.index(name) for name in known.base.names]
    covariance = found.covariance.array()[np.ix_(within, within)]
    known_ones = np.isfinite(np.diag(covariance))
    covariance = np.where(np.outer(known_ones, known_ones), covariance, 0.0)
    about = Y - Y.mean(axis=1, keepdims=True)
    expected = np.sqrt(np.einsum("jsp,pq,jsq->js", about, covariance, about).mean(axis=1)) / right.std(axis=1)
    # The worst joint is the one that is farthest beyond both criteria.
    beyond = np.minimum(100 * error / WRONG_TORQUE, error / np.maximum(expected, 1e-12) / WRONG_STDS)
    worst = int(np.argmax(beyond))
    away = np.array([abs(each.value - truth[name]) / each.std for name, each in found.parameters.items()])
    return {
        "torque_error_percent": round(100 * float(error[worst]), 2),
        "torque_error_stds": round(float(error[worst] / expected[worst]), 2),
        "coverage_95": round(float((away < 1.96).mean()), 3),
        "beyond_4": round(float((away > 4.0).mean()), 3),
    }


def measured(config: Config, run: Path) -> dict[str, float]:
    """Over all recordings in a run folder: duration [s], least clearance outside the rest pose [m], and largest
    overshoot of a position limit [rad]."""
    space = Space.of(config)
    low, high = np.array([joint.position_limit for joint in config.joints]).T
    seconds, nearest, excess = 0.0, np.inf, -np.inf
    for path in run.rglob("samples.npy"):
        samples = load_samples(path, len(config.joints))
        position: Array = samples["position"]
        q = position[np.isfinite(position).all(axis=1)].T
        seconds += float(samples["deadline"][-1] - samples["deadline"][0])
        away = q[:, ~space.lies(q)][:, ::4]
        if away.shape[1]:
            nearest = min(nearest, space.nearest(away, on_the_way=True).distance)
        excess = max(excess, float(np.maximum(low - q.min(axis=1), q.max(axis=1) - high).max()))
        assert (samples["phase"] != Phase.NOT_RECORDED).all()
    return {"arm_seconds": round(seconds, 1), "least_m": round(float(nearest), 4), "excess_rad": round(excess, 4)}
