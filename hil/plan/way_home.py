"""Path along which a stopped spatial arm is lowered. It leads from any pose to the rest pose, clear of obstacles and in
bounded time.

The path is straight in joint space if a straight path is clear. Otherwise it leads straight to the first reachable pose
of the planned transition from the rest pose, and then back along that transition, which is known to be clear.
"""

import numpy as np

from hil.clearance.space import Space
from hil.config.schema import Config
from hil.estimator.arrays import Array
from hil.estimator.chain.excitation.fourier_path import Path
from hil.plan.chain_plan import SETTLE_IN, PathSegment
from hil.plan.plan import Plan

STATIONS = 16
"""Number of poses of the planned transition at which an arm may join it."""

PULL_PER_S, PULL_SHARE = 2.0, 0.25
"""An additional torque pulls a joint to the path. The first value is its growth rate, relative to the spring's torque
[1/s]; the second is its upper limit, relative to the joint's largest torque.

At a low sampling rate the spring alone is too weak to overcome the friction of a light joint.
"""

LOOKED_AT = 25  # poses of a straight line that are checked
PEAK = 1.875  # ratio of a fifth-order polynomial's peak speed to its mean speed
SHORTEST_S = 0.6
ROUNDED_S = 0.16  # s over which a corner between two straight lines is smoothed
BRAKING = 40.0  # rad/s^2
SHORTEST_BRAKE_S, LONGEST_BRAKE_S = 0.05, 0.2
_ALLOWED_M = 0.001


class WayHome:
    """Plans paths to the rest pose. Created before torque is switched on."""

    def __init__(self, config: Config, plan: Plan) -> None:
        segment = plan.segments[0]
        assert isinstance(segment, PathSegment)
        self._rate = plan.rate
        self._speed, self._longest = config.safety.lower_speed, config.safety.lower_time
        self._rest = np.array(config.arm.rest_pose)
        self._space = Space.of(config)
        there = segment.paths[0].position
        chosen = np.unique(np.linspace(0, there.shape[1] - 1, STATIONS).round().astype(int))
        self._stations = there[:, chosen]
        self.poses(self._rest)  # compile in advance

    @property
    def space(self) -> Space:
        """The space in which the path must be clear."""
        return self._space

    def poses(self, pose: Array) -> Array:
        """Corners (joints, corners) [rad] of the path from a pose (joints,) [rad] to the rest pose."""
        least = min(0.0, float(self._space.room(pose[:, None], on_the_way=True)[0])) - _ALLOWED_M
        best, best_room = 0, -np.inf
        for station in range(self._stations.shape[1]):
            room = float(self._space.room(_line(pose, self._stations[:, station]), on_the_way=True).min())
            if room > best_room:
                best, best_room = station, room
            if room >= least:
                break
        return np.column_stack((pose, self._stations[:, best::-1], self._rest))

    def path(self, pose: Array, velocity: Array) -> Path:
        """The whole path, sampled at the stream's rate: braking from `velocity`, then moving to the rest pose."""
        slowing = np.clip(np.abs(velocity).max() / BRAKING, SHORTEST_BRAKE_S, LONGEST_BRAKE_S)
        count = max(2, round(slowing * self._rate))
        time = np.arange(count) / self._rate
        fall = velocity[:, None] / (count / self._rate)
        braked = pose[:, None] + velocity[:, None] * time - 0.5 * fall * time**2
        stopped = pose + 0.5 * velocity * count / self._rate
        home = self._along(self.poses(stopped))
        speed, bend = self._slopes(home)
        return Path(
            np.column_stack((braked, home)),
            np.column_stack((velocity[:, None] - fall * time, speed)),
            np.column_stack((np.broadcast_to(-fall, braked.shape), bend)),
        )

    def seconds(self, corners: Array) -> float:
        """Duration of the path through these corners [s]."""
        return float(np.clip(PEAK * _lengths(corners).sum() / self._speed, SHORTEST_S, self._longest))

    def _along(self, corners: Array) -> Array:
        """Positions (joints, samples) along straight lines with smoothed corners, from standstill to standstill."""
        lengths = _lengths(corners)
        at = np.concatenate(([0.0], np.cumsum(lengths)))
        s = np.linspace(0.0, 1.0, max(2, round(self.seconds(corners) * self._rate)))
        along = at[-1] * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        line = np.stack([np.interp(along, at, row) for row in corners])
        width = max(1, round(ROUNDED_S * self._rate))
        smooth = np.pad(line, ((0, 0), (width - 1, width - 1)), mode="edge")
        for _ in range(2):  # twice, so that the speed is continuous too
            smooth = np.apply_along_axis(np.convolve, 1, smooth, np.full(width, 1.0 / width), "valid")
        still = np.repeat(line[:, -1:], round(2 * SETTLE_IN * self._rate), axis=1)
        return np.column_stack((smooth, still))

    def _slopes(self, position: Array) -> tuple[Array, Array]:
        speed = np.gradient(position, 1.0 / self._rate, axis=1)
        return speed, np.gradient(speed, 1.0 / self._rate, axis=1)


def _line(first: Array, last: Array) -> Array:
    share = np.linspace(0.0, 1.0, LOOKED_AT)
    line: Array = first[:, None] + share * (last - first)[:, None]
    return line


def _lengths(corners: Array) -> Array:
    """Displacement of the joint that moves most between successive corners (corners - 1,) [rad]."""
    lengths: Array = np.abs(np.diff(corners, axis=1)).max(axis=0)
    return lengths
