"""Section on friction versus speed: the model's curve with its interval, and the torque that remains after inertia and
gravity are subtracted, for the measured and the simulated motion.
"""

import numpy as np

from hil.arm_model import ArmModel
from hil.estimator.arrays import Array
from hil.estimator.data.fourier import Lines, cut_off, lines_of, motion_of
from hil.report.chart import BLUE, GREY, ORANGE, Chart, Series
from hil.report.run_data import RunData
from hil.report.section import Picture, Section
from hil.results.parts import Covariance
from hil.runs.period_file import PlayedPeriod

_CURVE = 401  # points on the curve
_FEWER = 4
_LINE = 0.01  # width of a line, relative to the height of the curve
_DOTS = 400  # of each motion
_DRAWS = 200  # parameter draws for the interval


def friction(data: RunData) -> Section | None:
    """The section; None if the run has no settled period."""
    if data.fitted is None:
        return None
    period = data.fitted
    measured = lines_of(np.where(np.isfinite(period.position), period.position, period.predicted))
    harmonics = cut_off(measured)
    measured_dots = _left_to_friction(data.model, period, measured, harmonics)
    simulated_dots = _left_to_friction(data.model, period, lines_of(period.predicted), harmonics)
    pictures = [_curve(data, joint, name, measured_dots, simulated_dots) for joint, name in enumerate(data.names)]
    words = (
        "The dots show the commanded torque minus the model's inertia and gravity torque: one set for the measured "
        "motion, one for the simulated motion. Accelerations derived from positions are smoothed at every reversal, so "
        "near standstill both sets deviate equally from the curve; there, static friction can also take any value that "
        "holds the joint. If the friction model is right, the two sets of dots agree.",
    )
    return Section("friction", "Friction", words, pictures=tuple(pictures))


def _left_to_friction(model: ArmModel, period: PlayedPeriod, lines: Lines, harmonics: int) -> tuple[Array, Array]:
    """Speeds [rad/s] and friction torques [N m], both (joints, dots), from the Fourier coefficients of a motion.

    harmonics: the highest harmonic used; the same for both motions, so that they are smoothed equally.
    """
    samples = period.position.shape[1]
    motion = motion_of(lines, harmonics, 2 * np.pi * period.rate / samples, samples)
    rigid = model.rigid_body_torque(motion.position.T, motion.velocity.T, motion.acceleration.T).T
    offset = np.array([[model.values[f"offset_{joint + 1}"]] for joint in range(len(lines))])
    # Commands are held until the next one: the torque effective at a sample is the mean of two successive ones.
    scale = np.array([[model.torque_scale(joint + 1)] for joint in range(len(lines))])
    held = 0.5 * scale * (period.torque + np.roll(period.torque, 1, axis=1))
    chosen = slice(None, None, max(1, samples // _DOTS))
    return motion.velocity[:, chosen], (held - rigid - offset)[:, chosen]


def _curve(
    data: RunData, joint: int, name: str, measured: tuple[Array, Array], simulated: tuple[Array, Array]
) -> Picture:
    """Draw one joint's friction. measured, simulated: speeds and friction torques of the two motions."""
    fastest = float(np.abs(measured[0][joint]).max())
    # Cubes of an even grid are denser near zero speed, where the curve bends.
    at = fastest * np.linspace(-1, 1, _CURVE) ** 3
    curve = friction_curve(data.model, at)[:, joint]
    low, high = friction_interval(data.model, data.result.covariance, at, joint)
    line, said = model_curve(at, curve, low, high)
    series = (
        Series("from the measured motion", measured[0][joint], measured[1][joint], GREY, "dots"),
        # Fewer dots: the two motions are so similar that these would otherwise hide those of the measured one.
        Series("from the model's motion", simulated[0][joint, ::_FEWER], simulated[1][joint, ::_FEWER], ORANGE, "dots"),
        *line,
    )
    chart = Chart(f"friction_{joint + 1}", f"Friction of {name}", "speed [rad/s]", "friction [N m]", series)
    load = data.model.values.get(f"load_{joint + 1}")
    more = f" It also grows with the motor torque, by {load:.3g} N m per N m (not drawn)." if load else ""
    return Picture(chart, f"{name}: friction versus speed, without the constant offset.{said}{more}")


def model_curve(at: Array, curve: Array, low: Array, high: Array) -> tuple[tuple[Series, ...], str]:
    """The model's friction curve with its interval or, if that is narrower than the line, a sentence saying so."""
    line = Series("model", at, curve, BLUE)
    if float(np.max(high - low)) < _LINE * float(np.ptp(curve)):
        return (line,), " The 95 % interval is narrower than the line."
    return (Series("95 % interval", at, high, BLUE, "area", low), line), ""


def friction_curve(model: ArmModel, speed: Array) -> Array:
    return model.friction_torque(np.repeat(speed[:, None], len(model.joints), axis=1))


def friction_interval(model: ArmModel, kept: Covariance, speed: Array, joint: int) -> tuple[Array, Array]:
    """Return the 2.5th and 97.5th percentiles of a joint's friction torque [N m] at `speed` [rad/s] (samples,).

    They follow from the parameters' covariance. joint: index from 0.
    """
    names = [name for name in kept.names if name.endswith(f"_{joint + 1}")]
    index = [kept.names.index(name) for name in names]
    covariance = kept.array()[np.ix_(index, index)]
    seen = np.isfinite(np.diag(covariance))
    covariance = np.where(seen[:, None] & seen, covariance, 0.0)
    value = np.array([model.values[name] for name in names])
    size, turn = np.linalg.eigh(covariance)
    random = np.random.default_rng(0)
    draws = value + random.normal(size=(_DRAWS, len(value))) @ (turn * np.sqrt(np.maximum(size, 0.0))).T
    floor = np.array([1e-6 if name.startswith(("coulomb_width", "stribeck_velocity")) else -np.inf for name in names])
    curves = [
        friction_curve(_with(model, dict(zip(names, np.maximum(draw, floor).tolist(), strict=True))), speed)[:, joint]
        for draw in draws
    ]
    low, high = np.percentile(curves, [2.5, 97.5], axis=0)
    return low, high


def _with(model: ArmModel, values: dict[str, float]) -> ArmModel:
    return ArmModel({**model.values, **values}, model.stds, model.gravity, model.rest_pose, model.joints)
