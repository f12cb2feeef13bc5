"""From commanded torque to what the motors give: held, late, averaged over each integration step."""

import numpy as np

from estimator.arrays import Array

DIFFERENCE = 1e-7  # s


def motor_torque(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float, lag: float
) -> Array:
    """Mean motor torque over each of `steps` equal steps after each sample (joints, samples, steps) [N m].

    `command` (joints, samples) [N m] is periodic, each value held until the next; sample k is taken
    `command_to_sample` [s] after command k takes effect. The torque follows `delay` [s] later through a
    first-order lag [s]. The means are exact, of a step in which the command changes too.
    """
    settled = _lagging(command, rate, lag)
    edges = np.arange(steps + 1) / (steps * rate) + command_to_sample - delay
    gathered = []
    present = []
    for edge in edges.tolist():
        shift = int(np.floor(edge * rate))
        phase = edge - shift / rate
        held = np.roll(command, -shift, axis=1)
        # Integral of the held command since command 0, at this edge after every sample.
        gathered.append(_before(command, rate, shift) + held * phase)
        fading = np.exp(-phase / lag) if lag > 0.0 else 0.0
        present.append(held + (np.roll(settled, -shift, axis=1) - held) * fading)
    # lag y' = u - y, integrated over a step: the mean of y is that of u less what the lag has stored.
    step = 1.0 / (steps * rate)
    means = [(gathered[i + 1] - gathered[i] - lag * (present[i + 1] - present[i])) / step for i in range(steps)]
    return np.stack(means, axis=2)


def torque_slopes(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float, lag: float
) -> Array:
    """Derivatives of `motor_torque` by delay and by lag (2, joints, samples, steps) [N m/s].

    By central differences: the torque is piecewise linear in the delay and smooth in the lag.
    """

    def at(delay: float, lag: float) -> Array:
        return motor_torque(command, rate, command_to_sample, steps, delay=delay, lag=lag)

    late = (at(delay + DIFFERENCE, lag) - at(delay - DIFFERENCE, lag)) / (2.0 * DIFFERENCE)
    if lag <= 0.0:
        return np.stack((late, np.zeros_like(late)))
    change = min(DIFFERENCE, 0.1 * lag)
    return np.stack((late, (at(delay, lag + change) - at(delay, lag - change)) / (2.0 * change)))


def _before(command: Array, rate: float, shift: int) -> Array:
    """Integral of the held command from command 0 to command k + `shift`, for each k (joints, samples)."""
    samples = command.shape[1]
    total = np.zeros((command.shape[0], samples + 1))
    np.cumsum(command, axis=1, out=total[:, 1:])
    index = np.arange(samples) + shift
    turns, rest = np.divmod(index, samples)
    integral: Array = (turns * total[:, -1:] + total[:, rest]) / rate
    return integral


def _lagging(command: Array, rate: float, lag: float) -> Array:
    """The lagging torque (joints, samples) at the instants of the commands, in its periodic steady state.

    It obeys y[k + 1] = a y[k] + (1 - a) u[k], which is one division per Fourier line.
    """
    if lag <= 0.0:
        return np.roll(command, 1, axis=1)
    a = np.exp(-1.0 / (rate * lag))
    turn = np.exp(2j * np.pi * np.arange(command.shape[1] // 2 + 1) / command.shape[1])
    return np.fft.irfft(np.fft.rfft(command, axis=1) * (1.0 - a) / (turn - a), command.shape[1], axis=1)
