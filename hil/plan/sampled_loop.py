"""Stability of joints that are held by a sampled spring and damper, by linear analysis about given poses.

Each torque follows from the sample before it and acts through the drive's lag for one sample. Gravity and dry friction
are left out: the feed-forward compensates for gravity, and dry friction can only damp the motion.
"""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array

STABLE = 1.0 + 1e-6
"""Largest growth per sample at which a loop counts as stable: 1, the growth of a joint without a spring, plus a
tolerance for rounding errors.
"""


@dataclass(frozen=True)
class SampledLoop:
    """Joints and the gains that hold them.

    mass: mass matrices (poses, joints, joints) [kg m^2]. stiffness, damping: gains (joints,) [N m/rad, N m s/rad].
    viscous: friction (joints,) [N m s/rad]. lag: time constants of the drives (joints,) [s].
    """

    mass: Array
    stiffness: Array
    damping: Array
    viscous: Array
    lag: Array

    def growth(self, rate: float) -> float:
        """Largest factor by which a motion about any pose grows per sample at this sample rate [Hz]; below 1, every
        motion decays.
        """
        return float(np.abs(np.linalg.eigvals(self._step(rate))).max())

    def is_stable(self, rate: float) -> bool:
        """Whether every motion about every pose decays at this sample rate [Hz]."""
        return self.growth(rate) <= STABLE

    def fastest_growing(self, rate: float) -> int:
        """The joint that has the most kinetic energy in the motion that grows fastest at this sample rate [Hz]."""
        n = len(self.stiffness)
        values, vectors = np.linalg.eig(self._step(rate))
        pose, mode = np.unravel_index(np.argmax(np.abs(values)), values.shape)
        velocity = np.abs(vectors[pose, n : 2 * n, mode])
        return int(np.argmax(np.diagonal(self.mass[pose]) * velocity**2))

    def sufficient_rate(self, rate: float, highest: float) -> float | None:
        """Find the sample rate [Hz] above which the loop is stable; None if even `highest` is too low. rate: a lower
        rate, at which the loop is unstable.
        """
        low, high = rate, 1.5 * rate
        while not self.is_stable(high):
            if high >= highest:
                return None
            low, high = high, min(1.5 * high, highest)
        while high - low > 0.5:
            middle = 0.5 * (low + high)
            low, high = (low, middle) if self.is_stable(middle) else (middle, high)
        return high

    def _step(self, rate: float) -> Array:
        """Transition from one sample to the next (poses, states, states): angles, velocities and torques, followed by
        the angles and velocities that were read one sample earlier.
        """
        from scipy.linalg import expm

        poses, n = self.mass.shape[:2]
        inverse = np.linalg.inv(self.mass)
        model = np.zeros((poses, 4 * n, 4 * n))  # angles, velocities, torques, goals
        model[:, :n, n : 2 * n] = np.eye(n)
        model[:, n : 2 * n, n : 2 * n] = -inverse * self.viscous
        model[:, n : 2 * n, 2 * n : 3 * n] = inverse
        model[:, 2 * n : 3 * n, 2 * n :] = np.hstack((-np.diag(1.0 / self.lag), np.diag(1.0 / self.lag)))
        moved = expm(model / rate)
        goals = -np.hstack((np.diag(self.stiffness), np.diag(self.damping)))
        step = np.zeros((poses, 5 * n, 5 * n))
        step[:, : 3 * n, : 3 * n] = moved[:, : 3 * n, : 3 * n]
        step[:, : 3 * n, 3 * n :] = moved[:, : 3 * n, 3 * n :] @ goals
        step[:, 3 * n :, : 2 * n] = np.eye(2 * n)
        return step
