"""Search for a mistake in an arm's description if a motion contradicts it.

One joint at a time is given the opposite direction, another zero or another axis, or the base is given another
orientation. The torque residual of filtered inverse dynamics is compared with that of the description as given. As in
`hil.estimator.chain.simulation.motion_observer`, all parameters have a Gaussian prior, and dry friction can hold a
joint that hardly moves. A joint near its rest angle may lie against an end stop, so its torque is not compared.

A wrong description is wrong from the start, while a fault of a motor, a gear or an encoder sets in later. Therefore a
change to the description must also explain the motion better if its last `LATEST_S` are left out.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array, Mask
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.geometry import Chain, directions_of_gravity
from hil.estimator.chain.simulation.motion_observer import STANDING, STATIC

FILTER_S = 0.03  # time constant of each of the three poles
APART_S = 0.1  # interval between the samples that are compared
WARM_S = 0.3
LATEST_S = 0.5
LEAST_SAMPLES = 15
ERROR, FRICTION_ERROR = 0.05, 0.3
"""Standard deviation of the torque, relative to a joint's largest torque and to its mean dry friction."""
BETTER, BETTER_BEFORE = 0.5, 0.7
"""Largest ratio of the squared residuals with a change to those as given: in the whole motion, and without its last
`LATEST_S`.
"""
LEAST_GAIN = 9.0  # smallest decrease in the squared residuals without the last `LATEST_S`
WELL = 0.3  # largest mean squared residual with a change
AS_WELL, AS_WELL_BY = 1.15, 4.0  # ratio and difference of the squared residuals up to which changes are equally good
MOST_CAUSES = 3  # if more changes explain the motion equally well, none is credible
ZEROS = np.radians([90.0, -90.0, 180.0])

Kind = Literal["direction", "zero", "axis", "base"]
Known = Callable[[Chain], tuple[BaseParameters, Array, Array]]
"""Base parameters of a chain, and the mean and covariance of `ChainObserver`'s parameters."""


@dataclass(frozen=True)
class Change:
    """A change to the description of one joint, or of the base."""

    joint: int
    """The joint, counted from 0; -1 for the base."""
    kind: Kind
    turned: float = 0.0
    """Angle to add to the joint's angle, after its direction has been reversed if `kind` is "direction" [rad]."""
    axis: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """If `kind` is "axis", the axis in the joint's frame; if it is "base", the upward direction in the base's frame."""


@dataclass(frozen=True)
class Motion:
    """A recorded motion, filtered: arrays (joints, samples) [SI].

    is_free: whether each joint is far enough from its rest angle to be free of end stops.
    """

    position: Array
    velocity: Array
    acceleration: Array
    torque: Array
    is_free: Mask
    time: Array
    """Time until the end of the motion (samples,) [s]."""

    @classmethod
    def of(cls, position: Array, torque: Array, interval: float, rest: Array, near: float) -> "Motion":
        """Filter a motion that begins at rest.

        position, torque: (joints, samples) [SI]; each torque acted before its sample. interval: [s]. rest: angles at
        rest (joints,) [rad]. near: distance from the rest angle within which a joint may lie against an end stop [rad].
        """
        smoothed = partial(_smoothed, follows=1.0 - np.exp(-interval / FILTER_S))
        first = smoothed(position)
        second = smoothed(first)
        third = smoothed(second)
        late = interval / np.expm1(interval / FILTER_S)  # so that these differences are the exact derivatives
        chosen = np.arange(position.shape[1] - 1, round(WARM_S / interval), -max(1, round(APART_S / interval)))[::-1]
        away = np.abs(third - rest[:, None]) > near
        chosen = chosen[away[:, chosen].any(axis=0)]
        return cls(
            third[:, chosen],
            ((second - third) / late)[:, chosen],
            ((first - 2.0 * second + third) / late**2)[:, chosen],
            smoothed(smoothed(smoothed(torque)))[:, chosen],
            away[:, chosen],
            (position.shape[1] - 1 - chosen) * interval,
        )

    @property
    def before(self) -> "Motion":
        """The motion without its last `LATEST_S`."""
        kept = self.time >= LATEST_S
        return Motion(
            self.position[:, kept],
            self.velocity[:, kept],
            self.acceleration[:, kept],
            self.torque[:, kept],
            self.is_free[:, kept],
            self.time[kept],
        )

    def changed(self, change: Change) -> "Motion":
        """The motion, with angles and torques as defined by the changed description."""
        if change.kind not in ("direction", "zero"):
            return self
        sign = np.ones((len(self.position), 1))
        sign[change.joint] = -1.0 if change.kind == "direction" else 1.0
        position = sign * self.position
        position[change.joint] += change.turned
        motion = (position, sign * self.velocity, sign * self.acceleration, sign * self.torque)
        return Motion(*motion, self.is_free, self.time)


def _smoothed(series: Array, follows: float) -> Array:
    """Low-pass filter each row as if its first value had applied at all earlier times."""
    from scipy.signal import lfilter

    stays = 1.0 - follows
    rows, _ = lfilter([follows], [1.0, -stays], series, axis=1, zi=stays * series[:, :1])
    return np.asarray(rows)


def better_descriptions(chain: Chain, known: Known, motion: Motion, rest: Array) -> tuple[Change, ...]:
    """Return the changes that explain the motion much better than the description as given, the best first. The result
    is empty if there are no such changes, or if too many are equally good.

    rest: angles in the rest pose (joints,) [rad].
    """
    before = motion.before
    if before.time.size < LEAST_SAMPLES:
        return ()
    as_given = known(chain)
    given, given_before = _misfit(as_given, motion), _misfit(as_given, before)
    tried: list[tuple[float, Change]] = []
    for change in _changes(chain, rest):
        other = _changed(chain, change)
        arm = as_given if other is chain else known(other)
        squared, squared_before = (_misfit(arm, each.changed(change)) for each in (motion, before))
        is_better = squared < BETTER * given and squared_before < BETTER_BEFORE * given_before
        if is_better and given_before - squared_before > LEAST_GAIN and squared < WELL * np.sum(motion.is_free):
            tried.append((squared, change))
    if not tried:
        return ()
    tried.sort(key=lambda each: each[0])
    least = tried[0][0]
    good: dict[tuple[int, Kind], Change] = {}
    for squared, change in tried:
        if squared <= max(AS_WELL * least, least + AS_WELL_BY):
            good.setdefault((change.joint, change.kind), change)
    return tuple(good.values()) if len(good) <= MOST_CAUSES else ()


def _changes(chain: Chain, rest: Array) -> Iterator[Change]:
    for joint in range(chain.joints):
        # Either zero_ticks or the rest angle may be right.
        for turned in (2.0 * float(rest[joint]), 0.0):
            yield Change(joint, "direction", turned)
        for turned in ZEROS.tolist():
            yield Change(joint, "zero", turned)
        for axis in np.eye(3):
            if abs(axis @ chain.axis[joint]) < np.sqrt(0.5):
                yield Change(joint, "axis", axis=_tuple(axis))
    for gravity in directions_of_gravity(chain.gravity):
        yield Change(-1, "base", axis=_tuple(-gravity / np.linalg.norm(gravity)))


def _tuple(vector: Array) -> tuple[float, float, float]:
    x, y, z = (0.0 + vector).tolist()
    return x, y, z


def _changed(chain: Chain, change: Change) -> Chain:
    if change.kind == "base":
        return replace(chain, gravity=-np.linalg.norm(chain.gravity) * np.array(change.axis))
    if change.kind == "axis":
        axis = chain.axis.copy()
        axis[change.joint] = change.axis
        return replace(chain, axis=axis)
    return chain


def _misfit(arm: tuple[BaseParameters, Array, Array], motion: Motion) -> float:
    """Minimum, over the parameters, of the squared torque residuals plus the parameters' squared distance from their
    prior, both in units of standard deviations.
    """
    base, mean, covariance = arm
    n, samples = motion.position.shape
    joints = np.arange(n)
    friction = np.zeros((n, samples, 3 * n))
    moving = np.tanh(motion.velocity / STANDING)
    friction[joints, :, joints], friction[joints, :, n + joints] = motion.velocity, moving
    friction[joints, :, 2 * n + joints] = 1.0
    rigid = base.regressor(motion.position, motion.velocity, motion.acceleration)
    Y = np.concatenate((rigid, friction), axis=2)
    dry = mean[base.count + n : base.count + 2 * n, None]
    error = ERROR * np.abs(motion.torque).max(axis=1, keepdims=True) + FRICTION_ERROR * dry
    std = np.hypot(error, STATIC * dry * (1.0 - np.abs(moving)))
    weight = motion.is_free / np.maximum(std, 1e-9)
    residual = (weight * (motion.torque - Y @ mean)).reshape(-1)
    # In units of the prior's standard deviations, which differ by orders of magnitude.
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    columns = (weight[:, :, None] * Y * spread).reshape(residual.size, -1)
    # The sum is r^T (1 + A C A^T)^-1 r, with the inverse written for the smaller matrix.
    projected = columns.T @ residual
    inner = np.eye(spread.size) + correlation @ (columns.T @ columns)
    return float(residual @ residual - projected @ linalg.solve(inner, correlation @ projected))
