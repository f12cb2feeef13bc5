"""Recursive least squares on causally filtered signals, the on-line baseline.

Position passes through a causal low-pass filter and is differenced; the regressor is evaluated and filtered again. The
torque passes through the same filter twice, so that regressor and torque have the same lag. Every sample then corrects
the parameters once: Ljung, System Identification (1999), section 11.2, with a forgetting factor of 1.
"""

from collections.abc import Sequence

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import InverseDynamics, uniform
from hil.estimator.data.recording import Recording
from hil.estimator.models.regressor import regressor
from hil.estimator.models.terms import base_names

ORDER = 4  # order of the filter
WIDE = 1e3  # standard deviation of the parameters before the first sample, in SI units
WARM_UP = 2.0  # cycles of the cut-off frequency until the filters' initial transients have decayed


def fit_recursively(
    recordings: Sequence[Recording], cutoff: float, coulomb_width: float, delay: float = 0.0
) -> InverseDynamics:
    """Fit all `recordings` by RLS, one after the other.

    At every sample, the torques of all joints are used, weighted according to their residuals.

    `cutoff` [Hz], `coulomb_width` [rad/s] and `delay` [s] are as in
    `hil.estimator.baselines.idim.fit_inverse_dynamics`. The weights come from a first pass over the data.
    """
    rows = [_causal_rows(recording, cutoff, coulomb_width, delay) for recording in recordings]
    Y = np.concatenate([row[0] for row in rows], axis=1)
    tau = np.concatenate([row[1] for row in rows], axis=1)
    deviation = np.ones(len(Y))
    for _ in range(2):
        theta, P = _run(Y, tau, deviation)
        deviation = np.sqrt(np.mean((tau - Y @ theta) ** 2, axis=1))
    level = np.sqrt(np.mean(tau**2, axis=1))
    return InverseDynamics(base_names(len(Y)), theta, np.sqrt(np.diag(P)), deviation / level)


def _causal_rows(recording: Recording, cutoff: float, width: float, delay: float) -> tuple[Array, Array]:
    from scipy.signal import butter, sosfilt, sosfilt_zi

    position, torque, dt = uniform(recording, delay)
    filter_ = butter(ORDER, cutoff, fs=1.0 / dt, output="sos")
    rest = sosfilt_zi(filter_)[:, None, :]
    smooth, _ = sosfilt(filter_, position, axis=1, zi=rest * position[None, :, :1])
    tau, _ = sosfilt(filter_, torque, axis=1, zi=rest * torque[None, :, :1])
    velocity = np.diff(smooth, axis=1) / dt
    acceleration = np.diff(velocity, axis=1) / dt
    # A difference belongs to the middle of its interval: one sample back for the second derivative, half a sample for
    # the first.
    velocity = 0.5 * (velocity[:, 1:] + velocity[:, :-1])
    Y = regressor(smooth[:, 1:-1], velocity, acceleration, width)
    start = sosfilt_zi(filter_)[:, None, :, None]
    Y, _ = sosfilt(filter_, Y, axis=1, zi=start * Y[None, :, :1])
    tau, _ = sosfilt(filter_, tau, axis=1, zi=rest * tau[None, :, :1])
    warm = int(WARM_UP / (cutoff * dt))
    return Y[:, warm:], tau[:, 1 + warm : -1]


def _run(Y: Array, tau: Array, deviation: Array) -> tuple[Array, Array]:
    joints, samples, size = Y.shape
    theta = np.zeros(size)
    P = np.eye(size) * WIDE**2
    eye = np.eye(joints)
    R = np.diag(deviation**2)
    for k in range(samples):
        y = Y[:, k]
        Py = P @ y.T
        gain = Py @ linalg.solve(y @ Py + R, eye)
        theta = theta + gain @ (tau[:, k] - y @ theta)
        P = P - gain @ Py.T
        P = 0.5 * (P + P.T)
    return theta, P
