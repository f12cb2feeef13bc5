"""From commanded torque to what the motors give: held, late, averaged over each integration step."""

import numpy as np

from estimator.arrays import Array


def motor_torque(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float, lag: float
) -> Array:
    """Mean motor torque over each of `steps` equal steps after each sample (joints, samples, steps) [N m].

    `command` (joints, samples) [N m] is periodic, each value held until the next; sample k is taken
    `command_to_sample` [s] after command k takes effect. The torque follows `delay` [s] later through a
    first-order lag [s]. The means are exact, of a step in which the command changes too.
    """
    return _torque(command, rate, command_to_sample, steps, delay, lag)[0]


def torque_and_slopes(
    command: Array, rate: float, command_to_sample: float, steps: int, *, delay: float, lag: float
) -> tuple[Array, Array]:
    """`motor_torque`, and its derivatives by delay and by lag (2, joints, samples, steps) [N m/s].

    Where a command changes at the very edge of a step and no lag softens it, the derivative by delay is that of less.
    """
    torque, late, change = _torque(command, rate, command_to_sample, steps, delay, lag)
    return torque, np.stack((late, change))


def _torque(
    command: Array, rate: float, command_to_sample: float, steps: int, delay: float, lag: float
) -> tuple[Array, Array, Array]:
    """The mean torque over each step, and its derivatives by delay and lag."""
    settled, settled_slope = _lagging(command, rate, lag)
    total = np.zeros((command.shape[0], command.shape[1] + 1))
    np.cumsum(command, axis=1, out=total[:, 1:])
    edges = np.arange(steps + 1) / (steps * rate) + command_to_sample - delay
    gathered, present, by_lag = (np.empty((*command.shape, steps + 1)) for _ in range(3))
    for i, edge in enumerate(edges.tolist()):
        shift = int(np.floor(edge * rate))
        phase = edge - shift / rate
        held = np.roll(command, -shift, axis=1)
        # Integral of the held command since command 0, at this edge after every sample.
        gathered[:, :, i] = _before(total, rate, shift) + held * phase
        fading = np.exp(-phase / lag) if lag > 0.0 else 0.0
        left = (np.roll(settled, -shift, axis=1) - held) * fading
        present[:, :, i] = held + left
        # Without a lag the torque changes by lag times the command's steps, which has no derivative here.
        slope = left * (phase / lag**2) + np.roll(settled_slope, -shift, axis=1) * fading if lag > 0.0 else 0.0
        by_lag[:, :, i] = slope
    # lag y' = u - y, integrated over a step: the mean of y is that of u less what the lag has stored.
    step = 1.0 / (steps * rate)
    change = np.diff(present, axis=2) / step
    torque = np.diff(gathered, axis=2) / step - lag * change
    if lag <= 0.0:
        return torque, -change, np.zeros_like(change)
    return torque, -change, -change - lag * np.diff(by_lag, axis=2) / step


def _before(total: Array, rate: float, shift: int) -> Array:
    """Integral of the held command from command 0 to command k + `shift`, for each k (joints, samples), from the
    sum `total` (joints, samples + 1) of all commands before each."""
    samples = total.shape[1] - 1
    turns, rest = divmod(shift, samples)
    once = np.concatenate((total[:, rest:-1], total[:, -1:] + total[:, :rest]), axis=1)
    integral: Array = (turns * total[:, -1:] + once) / rate
    return integral


def _lagging(command: Array, rate: float, lag: float) -> tuple[Array, Array]:
    """The lagging torque (joints, samples) at the instants of the commands, in its periodic steady state, and its
    derivative by the lag.

    It obeys y[k + 1] = a y[k] + (1 - a) u[k], which is one division per Fourier line.
    """
    if lag <= 0.0:
        before = np.roll(command, 1, axis=1)
        return before, np.zeros_like(before)
    a = np.exp(-1.0 / (rate * lag))
    turn = np.exp(2j * np.pi * np.arange(command.shape[1] // 2 + 1) / command.shape[1])
    filtered = np.fft.rfft(command, axis=1) * ((1.0 - a) / (turn - a))
    slope = filtered * ((1.0 - turn) / (turn - a) / (1.0 - a) * (a / (rate * lag**2)))
    both = np.fft.irfft(np.stack((filtered, slope)), command.shape[1], axis=2)
    return both[0], both[1]
