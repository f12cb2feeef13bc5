"""Whether a fault could have been detected: the search for a healthy arm that would have sent the same replies.

A fault that affects only the motion cannot be detected, by any detector, as long as some healthy arm that the
configuration allows would have answered the same commands in the same way. Such an arm is sought by least squares with
the emulator's own simulation, by varying physical parameters (masses, centres, inertias, friction, torque constants,
tilt of the base). If such an arm is found, this proves that nothing could be detected. If none is found, that proves
nothing, and the run counts as one in which the fault was detectable.

A healthy arm may also have servos that report their velocities with a lag, up to the lag that the program accepts from
any servo. Unless the configuration describes the arm, its two servos may also have been wired the other way round from
the start: a program knows a joint only by the ID that answers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from hil.config.schema import Config
from hil.drivers.servo_model import Mode
from hil.experiment.checks.consistency import LAG_S
from hil.fakes.plants import motor
from hil.fakes.plants.arm import Arm
from hil.fakes.plants.plant import make_plant

Array = NDArray[np.float64]

SAME_RAD, SAME_RAD_S = 0.02, 0.15
"""Largest difference of angles, and RMS difference of velocities, that ordinary encoders and velocity filters cause."""

LAGS_S = np.linspace(0.0, LAG_S, 7)[1:]
"""Velocity lags to try [s]."""

LAGGING_S = 0.2
"""Length of the intervals [s] for which the velocity differences are judged. A lag counts as an explanation only if it
reduces their RMS to an ordinary value in every interval.
"""

_TICKS_PER_RAD = 4096 / (2 * np.pi)

_UNDESCRIBED, _DESCRIBED = np.log(10.0), np.log(2.5)
"""Range of masses and inertias around the true ones, as logarithms of a factor, without and with link lengths."""

_FRICTION, _CENTRE, _TORQUE = np.log(5.0), np.log(2.0), np.log(1.25)
_TILT_RAD = 0.2
_EVALUATIONS = 6
_STEP = 0.01  # step of the finite differences
_COARSE_S = 0.005
"""Interval between the replies and commands used in the search [s]; the arm found is then compared with all of them."""

_COARSE_STEP_S = 2.5e-3
"""Longest step of the simulation in the search [s]."""

_CORRECTIONS = 3
"""Number of steps of Newton's method after the search; they use all replies, and derivatives from the search."""

_HOPELESS = 6.0
"""If the arm found by the search differs by more than this multiple of `SAME_RAD` in angle, the search is given up."""


@dataclass(frozen=True)
class Heard:
    """What the program received at `time` (n,) [s], angle and velocity (n, joints) [rad, rad/s], and what it commanded.

    commands: times (m,) [s] and currents (m, joints) [A].
    """

    time: Array
    angle: Array
    velocity: Array
    commanded_at: Array
    commands: Array

    @classmethod
    def of(
        cls, config: Config, heard: Sequence[Sequence[tuple[float, ...]]], sent: Sequence[Sequence[tuple[float, int]]]
    ) -> "Heard":
        """Create from each joint's replies (time, angle, velocity, ...) and goals (time, ticks)."""
        told = [np.array(each, float).reshape(-1, 4) for each in heard]
        goals = [np.array(each, float).reshape(-1, 2) for each in sent]
        time = told[0][:, 0]
        picked = [np.clip(np.searchsorted(each[:, 0], time, "right") - 1, 0, None) for each in told]
        at = goals[0][:, 0]
        latest = [np.clip(np.searchsorted(each[:, 0], at, "right") - 1, 0, None) for each in goals]
        units = [joint.joint.drive_unit(12.0) for joint in config.joints]
        return cls(
            time,
            np.column_stack([each[index, 1] for each, index in zip(told, picked, strict=True)]),
            np.column_stack([each[index, 2] for each, index in zip(told, picked, strict=True)]),
            at,
            np.column_stack([unit * each[index, 1] for unit, each, index in zip(units, goals, latest, strict=True)]),
        )

    def until(self, end: float) -> "Heard":
        return self.at(np.flatnonzero(self.time <= end))

    def at(self, index: NDArray[np.intp]) -> "Heard":
        """Return only the replies with these indices."""
        return Heard(self.time[index], self.angle[index], self.velocity[index], self.commanded_at, self.commands)

    def every(self, step: float) -> NDArray[np.intp]:
        """Indices of the first reply in each interval of `step` [s]."""
        _, first = np.unique(np.floor((self.time - self.time[0]) / step), return_index=True)
        return np.asarray(first, np.intp)

    def averaged(self) -> "Heard":
        """Return a copy with a single command between any two replies: the mean of the actual commands."""
        begun = self.commanded_at < self.time[-1]
        changes = np.concatenate((self.commanded_at[begun], self.time[-1:]))
        sums = np.zeros((changes.size, self.commands.shape[1]))
        sums[1:] = np.cumsum(self.commands[begun] * np.diff(changes)[:, None], axis=0)
        edges = np.concatenate((changes[:1], self.time[self.time > changes[0]]))
        until = np.column_stack([np.interp(edges, changes, each) for each in sums.T])
        return Heard(self.time, self.angle, self.velocity, edges[:-1], np.diff(until, axis=0) / np.diff(edges)[:, None])


def has_healthy_twin(config: Config, heard: Heard, end: float) -> bool:
    """Whether a healthy arm can be found that would have sent everything that was received until `end` [s].

    Always False for voltage-driven servos, because the commands do not determine their currents.
    """
    assert config.fake is not None
    arm = config.fake.arm
    told = heard.until(end)
    if not isinstance(arm, Arm) or any(joint.drive_mode is Mode.PWM for joint in config.joints) or told.time.size < 2:
        return False
    if _is_found(config, arm, told):
        return True
    other = wired_otherwise(config, told)
    return other is not None and _is_found(config, arm, other)


def may_be_wired_otherwise(config: Config) -> bool:
    """Whether two servos might be interchanged: they are of the same model and no link lengths are configured."""
    models = {joint.model for joint in config.joints}
    return len(config.joints) == 2 and len(models) == 1 and config.arm.link_lengths is None


def wired_otherwise(config: Config, told: Heard) -> Heard | None:
    """Return the replies and commands reordered for an arm whose two servos are wired the other way round; None if that
    is impossible.
    """
    assert config.fake is not None
    if not may_be_wired_otherwise(config):
        return None
    signs, angles = [], []
    for place, (named, mounted) in enumerate(zip(reversed(config.joints), config.fake.servos, strict=True)):
        sign = named.direction * mounted.direction
        ticks = named.zero_ticks - mounted.zero_ticks
        signs.append(sign)
        angles.append(sign * told.angle[:, 1 - place] + mounted.direction * ticks / _TICKS_PER_RAD)
    velocity, commands = told.velocity[:, ::-1] * signs, told.commands[:, ::-1] * signs
    return Heard(told.time, np.column_stack(angles), velocity, told.commanded_at, commands)


def _is_found(config: Config, arm: Arm, told: Heard) -> bool:
    """Whether an arm can be found that would have sent these replies: the true arm or a similar one."""
    limits = _limits(len(arm.links), _UNDESCRIBED if config.arm.link_lengths is None else _DESCRIBED)
    if _is_same(_differences(arm, np.zeros(limits.size), told), told):
        return True
    picked = told.every(_COARSE_S)
    coarse = told.at(picked).averaged()

    def residuals(parameters: Array) -> Array:
        with mock.patch.object(motor, "LONGEST_STEP", _COARSE_STEP_S):
            return _differences(_stick(arm), parameters, coarse)

    found = least_squares(
        residuals,
        np.zeros(limits.size),
        bounds=(-limits, limits),
        diff_step=np.full(limits.size, _STEP),
        max_nfev=_EVALUATIONS,
        loss="soft_l1",
    )
    if np.abs(found.fun[: coarse.angle.size]).max() > _HOPELESS:
        return False
    parameters = found.x
    slopes = np.column_stack([(residuals(found.x + _STEP * each) - found.fun) / _STEP for each in np.eye(limits.size)])
    for _ in range(_CORRECTIONS + 1):
        different = _differences(arm, parameters, told)
        if _is_same(different, told):
            return True
        rows = different.reshape(2, *told.angle.shape)[:, picked].ravel()
        parameters = np.clip(parameters - np.linalg.lstsq(slopes, rows, rcond=1e-3)[0], -limits, limits)
    return False


def _stick(arm: Arm) -> Arm:
    """The arm with stiction instead of smooth friction, because smooth friction would need short steps."""
    drives = tuple(drive.model_copy(update={"coulomb_width": 0.0}) for drive in arm.drives)
    return arm.model_copy(update={"drives": drives})


def _differences(arm: Arm, parameters: Array, told: Heard) -> Array:
    """Differences of all angles, then of all velocities, each divided by its ordinary size (2 n joints,)."""
    angle, velocity = _played(arm, parameters, told)
    return np.concatenate(((angle - told.angle).ravel() / SAME_RAD, (velocity - told.velocity).ravel() / SAME_RAD_S))


def _is_same(different: Array, told: Heard) -> bool:
    angle, velocity = different.reshape(2, *told.angle.shape)
    if np.abs(angle).max() > 1.0:
        return False
    same = np.sqrt(np.mean(velocity**2, axis=0)) <= 1.0
    own = told.velocity + SAME_RAD_S * velocity
    return all(
        is_same
        or any(_agrees(lagging(own[:, joint], told.time, lag) - told.velocity[:, joint], told) for lag in LAGS_S)
        for joint, is_same in enumerate(same.tolist())
    )


def lagging(velocity: Array, time: Array, lag: float) -> Array:
    """Delay a velocity (n,) [rad/s] at `time` (n,) [s] by a servo's first-order filter with time constant `lag` [s]."""
    told = velocity.copy()
    kept = np.exp(-np.diff(time) / lag)
    mean = 0.5 * (velocity[1:] + velocity[:-1])
    for index, (keep, value) in enumerate(zip(kept.tolist(), mean.tolist(), strict=True), 1):
        told[index] = keep * told[index - 1] + (1.0 - keep) * value
    return told


def _agrees(different: Array, told: Heard) -> bool:
    """Whether the RMS of these velocity differences [rad/s] is ordinary in every interval of `LAGGING_S`."""
    _, place = np.unique(np.floor((told.time - told.time[0]) / LAGGING_S), return_inverse=True)
    squares = np.bincount(place, different**2) / np.bincount(place)
    return bool(np.sqrt(squares).max() <= SAME_RAD_S)


def _limits(links: int, range_of_masses: float) -> Array:
    """Largest absolute value of each parameter, in the order of `_altered`: seven per link, and the base's tilt."""
    each = [range_of_masses, _CENTRE, range_of_masses, range_of_masses, _FRICTION, _FRICTION, _TORQUE]
    return np.array([*each * links, _TILT_RAD])


def _altered(arm: Arm, parameters: Array) -> Arm:
    """The arm with other masses, centres, inertias, rotors, friction and torque constants, and its base tilted."""
    links, drives = [], []
    factors = np.exp(parameters[:-1]).reshape(len(arm.links), 7)
    for link, drive, (mass, centre, inertia, rotor, viscous, coulomb, torque) in zip(
        arm.links, arm.drives, factors.tolist(), strict=True
    ):
        other = {"mass": mass * link.mass, "centre": centre * link.centre, "inertia": inertia * link.inertia}
        links.append(link.model_copy(update=other))
        changed = {
            "rotor_inertia": rotor * drive.rotor_inertia,
            "viscous": viscous * drive.viscous,
            "coulomb": coulomb * drive.coulomb,
            "torque_constant": torque * drive.torque_constant,
        }
        drives.append(drive.model_copy(update=changed))  # not validated: a search may exceed the bounds for files
    start = (arm.start[0] + float(parameters[-1]), *arm.start[1:])
    return arm.model_copy(update={"links": tuple(links), "drives": tuple(drives), "start": start})


def _played(arm: Arm, parameters: Array, told: Heard) -> tuple[Array, Array]:
    """Simulate the altered arm with the commands in `told`; return angles and velocities at its times (n, joints)."""
    plant = make_plant(_altered(arm, parameters))
    begun = float(told.commanded_at[0])
    angle, velocity = np.empty_like(told.angle), np.empty_like(told.velocity)
    current: Sequence[float] = (0.0,) * told.angle.shape[1]
    upcoming = 0
    for index, time in enumerate(told.time.tolist()):
        while upcoming < told.commanded_at.size and told.commanded_at[upcoming] <= time:
            plant.advance(float(told.commanded_at[upcoming]) - begun, current)
            current = told.commands[upcoming].tolist()
            upcoming += 1
        plant.advance(time - begun, current)
        angle[index], velocity[index] = plant.position, plant.velocity
    angle[:, 0] -= parameters[-1]
    return angle, velocity
