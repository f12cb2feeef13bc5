"""Prior ensemble of spatial arms.

Each link's mass, centre of mass and inertia are drawn around their described values; friction and rotor inertia are
drawn around typical values of the servos. `[arm.prior] spread` is the relative standard deviation of the described
masses.
"""

import numpy as np

from hil.config.schema import Config, PriorConfig
from hil.description.arm import steiner
from hil.drivers.servo_model import Mode
from hil.drivers.servo_prior import servo_prior
from hil.estimator.arrays import Array
from hil.estimator.chain.model.dynamics import TERMS
from hil.estimator.chain.model.late_torque import MOST_LOST
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.plan.chain_model import KnownChain, torque_constant_stds

CENTRE_STD = 0.01  # m, in each direction
INERTIA_SPREAD = 0.3
OFFSET_PER_COULOMB = 0.1
GEAR_EFFICIENCY, GENERATED_SPREAD = 0.6, 0.25
COULOMB_WIDTH = 0.05  # rad/s
LEAST_INERTIA = 0.2  # smallest factor for a link's inertia about its centre, so that no draw makes it a point mass


def prior_arms(config: Config, known: KnownChain, count: int, seed: int = 0) -> ChainArms:
    """Draw `count` arms; the first is the described one."""
    random = np.random.default_rng((seed, 16))
    given = config.arm.prior or PriorConfig()
    n = len(config.joints)
    links = _links(random, known.described.reshape(n, TERMS), count, given.spread)
    drive = np.zeros((count, 6, n))
    friction = _drives(config, given)
    for row, name in enumerate(("viscous", "coulomb")):
        drive[:, row] = _log_normal(random, *friction[name], count)
    drive[:, 2] = OFFSET_PER_COULOMB * drive[:, 1] * random.standard_normal((count, n))
    drive[0, 2] = 0.0
    drive[:, 3] = COULOMB_WIDTH
    drive[:, 4] = _log_normal(random, np.ones(n), torque_constant_stds(config), count)
    drive[:, 5] = _log_normal(random, *friction["lag"], count)
    rotors = _log_normal(random, *friction["armature"], count)
    # The back-EMF of voltage-driven joints lags too, so these joints behave as if they were lighter.
    lost = friction["generated"][0] * drive[:, 0] * drive[:, 5]
    rotors = rotors - np.minimum(lost, MOST_LOST * rotors)
    every = np.concatenate((links, rotors[:, :, None]), axis=2).reshape(count, -1)
    return ChainArms(known.base, np.asarray(every @ known.base.grouping.T), drive)


def _links(random: np.random.Generator, described: Array, count: int, spread: float) -> Array:
    """Draw physically consistent inertial parameters of the links (count, joints, 10)."""
    n = len(described)
    drawn = np.empty((count, n, TERMS - 1))
    for joint, row in enumerate(described):
        mass, moment = row[0], row[1:4]
        centre = moment / mass
        about = _matrix(row[4:10]) - mass * steiner(centre)
        factors = _log_normal(random, np.ones(2), np.array([spread, INERTIA_SPREAD]), count)
        shifts = CENTRE_STD * random.standard_normal((count, 3))
        shifts[0] = 0.0
        for arm in range(count):
            heavy, spread_out = factors[arm]
            at = centre + shifts[arm]
            inertia = heavy * (max(spread_out, LEAST_INERTIA) * about + mass * steiner(at))
            upper = [inertia[r, c] for r in range(3) for c in range(r, 3)]
            drawn[arm, joint] = [heavy * mass, *(heavy * mass * at), *upper]
    return drawn


def _drives(config: Config, given: PriorConfig) -> dict[str, tuple[Array, Array]]:
    """Medians and relative spreads of friction, lag, armature and the share of viscous friction caused by back-EMF.

    Friction and armature are multiplied by the number of servos on the joint.
    """
    priors = [servo_prior(joint.joint.servo) for joint in config.joints]
    servos = np.array([len(joint.ids) for joint in config.joints], dtype=np.float64)
    emf = np.array([joint.joint.servo.torque_per_ampere.value / GEAR_EFFICIENCY for joint in config.joints])
    per_volt = np.array([j.torque_per_goal if j.drive_mode is Mode.PWM else 0.0 for j in config.joints])
    found: dict[str, tuple[Array, Array]] = {}
    for name in ("viscous", "coulomb", "armature", "lag"):
        value, spread = np.array([(getattr(p, name).median, getattr(p, name).spread) for p in priors]).T
        times = np.ones_like(servos) if name == "lag" else servos
        value = times * value
        more = servos * emf * per_volt if name == "viscous" else np.zeros_like(value)
        spread = np.hypot(spread * value, GENERATED_SPREAD * more) / (value + more)
        value = value + more
        if name == "viscous":
            found["generated"] = more / value, np.zeros_like(more)
        told = getattr(given, name, None)
        if told is not None:
            value, spread = np.array(told), np.full(len(priors), given.spread)
        found[name] = value, spread
    return found


def _log_normal(random: np.random.Generator, median: Array, spread: Array, count: int) -> Array:
    """Log-normal draws (count, ...); the first is the median."""
    normal = random.standard_normal((count, median.size))
    normal[0] = 0.0
    drawn: Array = median * np.exp(np.sqrt(np.log1p(spread**2)) * normal)
    return drawn


def _matrix(upper: Array) -> Array:
    xx, xy, xz, yy, yz, zz = upper
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
