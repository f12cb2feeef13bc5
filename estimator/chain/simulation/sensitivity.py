"""Simulated motion of a chain and its sensitivities to all parameters, as needed by the likelihood."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.estimator.chain.model.dynamics import places, split
from hil.estimator.chain.model.kernels import room
from hil.estimator.chain.model.late_torque import lag_slopes
from hil.estimator.chain.model.tilt import TILT, tilt_slopes, tilted
from hil.estimator.chain.simulation.stepping import JOINT_TERMS, run

ABSENT = {"coulomb_width": 1.0, "stribeck_velocity": 1.0, "torque_scale": 1.0}
"""Values that disable terms absent from the model; terms not listed here are disabled by the value 0."""
AT_ONCE = 8
LINE = 8  # numbers in a cache line


@dataclass(frozen=True)
class ChainRun:
    """Input of a simulation, taken from a recording: consecutive samples, each with its integration steps."""

    torque: Array
    """Mean motor torque over each of the steps that follow a sample, not yet multiplied by the torque scales (samples,
    steps, joints) [N m].
    """
    slopes: Array
    """Derivatives of `torque` with respect to delay and each joint's lag (samples, steps, 2, joints) [N m/s]."""
    measured: Array
    """Measured angles (samples, joints) [rad]; NaN where a sample is missing."""
    step: float
    """Length of an integration step [s]."""
    finer: int = 1
    """Number of smaller steps into which an integration step is divided if a joint may be near standstill during it."""


PIECE = 256  # number of samples whose derivatives fit into the processor's cache


class Simulation:
    """A simulation that advances piece by piece, optionally with derivatives.

    parameters: values by name [SI].
    start: state at the first sample (2, joints) [rad, rad/s].
    gain: gains of the observer per sample (2, joints) [1, 1/s].
    names: parameters with respect to which to differentiate, followed by the initial angles and velocities; no
    derivatives if empty.
    """

    def __init__(
        self,
        base: BaseParameters,
        parameters: Mapping[str, float],
        start: Array,
        gain: Array,
        names: tuple[str, ...] = (),
    ) -> None:
        n = base.chain.joints
        self._causes = len(names) + 2 * n if names else 0
        # Unwanted derivatives are written to a spare column after all others.
        width = AT_ONCE * -(-(self._causes + 1) // AT_ONCE)
        spare = width - 1
        at = {name: index for index, name in enumerate(names)}
        rotation, translation, axis, gravity = base.chain.arrays
        tilt = [parameters.get(name, 0.0) for name in TILT]
        self._arm = (
            (rotation, translation, axis, tilted(gravity, *tilt)),
            split(base.chain, base.as_all(np.array([parameters[name] for name in base.names]))),
            np.array([[parameters.get(f"{t}_{j + 1}", ABSENT.get(t, 0.0)) for j in range(n)] for t in JOINT_TERMS]),
            np.array(start, dtype=np.float64, order="C"),
        )
        where = np.array([at.get(name, spare) for name in base.names] + [spare])
        self._columns = (
            where[places(n, base.columns)],
            np.array([[at.get(f"{term}_{joint + 1}", spare) for joint in range(n)] for term in JOINT_TERMS]),
            np.array(
                [
                    [at.get("delay", spare)] * n,
                    [at.get("lag", spare)] * n,
                    [at.get(f"lag_ratio_{j + 1}", spare) for j in range(n)],
                ]
            ),
            lag_slopes(parameters, n),
            np.array([at[name] for name in TILT if name in at], dtype=np.int64),
            tilt_slopes(gravity, *tilt) if TILT[0] in at else np.zeros((2, 3)),
        )
        self._gain = np.ascontiguousarray(gain, dtype=np.float64)
        first, even = -(-3 * n // 4) * 4, n + n % 2
        rows = first + -(-n // 4) * 4
        z = _aligned(rows, width)
        if names:
            z[np.arange(2 * n), len(names) + np.arange(2 * n)] = 1.0
        solve = (np.zeros((4, n)), *np.zeros((3, n, n)), *np.zeros((3, n)))
        self._room = (
            *(room(n), solve, tuple(np.zeros((6, n))), np.zeros(n)),
            *(z, first, _aligned(even, width), np.zeros((n, 3 * n)), np.zeros((even, rows))),
        )

    @property
    def state(self) -> Array:
        """Angles and velocities at the next sample (2, joints) [rad, rad/s], before the observer's correction."""
        state: Array = self._arm[3]
        return state

    def go_on(self, run_: ChainRun, piece: slice) -> tuple[Array | None, Array]:
        """Simulate the next `piece` of the samples.

        Returns the angles (samples, joints) [rad], or None instead if the motion diverges, and their derivatives with
        respect to `names` and the initial state (samples, joints, names and initial state).
        """
        torque, measured = run_.torque[piece], run_.measured[piece]
        position = np.empty(measured.shape)
        derivative = np.empty((*measured.shape, self._causes))
        stayed = run(
            *(*self._arm, torque, run_.slopes[piece], measured),
            *(self._gain, run_.step, run_.finer, self._columns, self._room, position, derivative),
        )
        return (position if stayed and np.isfinite(position).all() else None), derivative


def _aligned(rows: int, columns: int) -> Array:
    """Return an array of zeros aligned to cache lines, so that no vector straddles two lines."""
    spare = np.zeros(rows * columns + LINE)
    first = -(spare.ctypes.data // spare.itemsize) % LINE
    return spare[first : first + rows * columns].reshape(rows, columns)


def pieces(samples: int) -> list[slice]:
    """Return consecutive slices of at most PIECE samples that cover `samples` samples."""
    return [slice(first, min(first + PIECE, samples)) for first in range(0, samples, PIECE)]
