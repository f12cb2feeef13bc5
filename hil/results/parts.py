"""The parts of a result. Values per joint are ordered from the base outwards; fields are the keys of result.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from hil.arm_model import JointFacts
from hil.results.json_form import Spread, StandardError

__all__ = [
    "ArmFacts",
    "ChainFacts",
    "Confounded",
    "Covariance",
    "Fit",
    "Levels",
    "LineGroup",
    "LineLevels",
    "ModelChoice",
    "PerJoint",
    "Physical",
    "PhysicalQuantity",
    "PlayedStep",
    "Quantiles",
    "Quantity",
    "RunTiming",
    "SettledFit",
    "ShootingFit",
    "StabiliserShare",
    "StreamTiming",
    "Timing",
    "TriedModel",
    "Validation",
    "Verdict",
    "Zeros",
]

PerJoint = tuple[float, ...]


@dataclass(frozen=True)
class Quantity:
    """A value with its standard error, both in `unit` (SI; "1" for a ratio)."""

    value: float
    std: StandardError
    unit: str

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.6g} +- {self.std:.2g}{unit}"


@dataclass(frozen=True)
class Covariance:
    """Covariance of all parameters together, in the order of `names` and in the parameters' units."""

    names: tuple[str, ...]
    matrix: tuple[tuple[Spread, ...], ...]

    def array(self) -> NDArray[np.float64]:
        """The covariance as an array (names, names); infinite for parameters about which there is no information."""
        return np.array(self.matrix, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Quality of a fit. residual_rms_ticks: RMS of measured minus simulated position, per joint [encoder steps]."""

    residual_rms_ticks: PerJoint


@dataclass(frozen=True, kw_only=True)
class SettledFit(Fit):
    """Fit of settled periods.

    quantisation_floor_ticks: residual due to encoder rounding alone, in encoder steps RMS. periods: number of averaged
    periods. correlation_time: number of samples over which the residual is correlated.
    """

    quantisation_floor_ticks: float
    samples_per_period: int
    periods: int
    model: str = ""
    outliers: int = 0
    correlation_time: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ShootingFit(Fit):
    """Fit of an arbitrary motion, cut into segments. residual_rms_rad: the residual in rad RMS, per joint;
    residual_rms_ticks is empty if the encoders' resolution is not known.
    """

    residual_rms_rad: PerJoint
    residual_rms_ticks: PerJoint
    samples: int
    segments: int


@dataclass(frozen=True)
class Confounded:
    """The two most strongly correlated parameters, and their correlation."""

    parameters: tuple[str, ...]
    correlation: float


@dataclass(frozen=True)
class Levels:
    """Sizes of signal, distortion, noise and errors: RMS over all spectral lines, per joint, in encoder steps."""

    excited_lines: PerJoint
    distortion: PerJoint
    noise: PerJoint
    period_scatter: PerJoint
    model_error: PerJoint


@dataclass(frozen=True)
class LineGroup:
    """Spectral lines of one kind: their number, and RMS of motion and residual per line and joint, in encoder steps."""

    lines: int
    motion: PerJoint
    left: PerJoint


@dataclass(frozen=True)
class LineLevels:
    """RMS per spectral line in encoder steps, by kind of line; None for kinds that the multisine does not have."""

    noise: PerJoint
    excited: LineGroup | None = None
    odd: LineGroup | None = None
    even: LineGroup | None = None
    other: LineGroup | None = None

    @property
    def groups(self) -> dict[str, LineGroup]:
        """The available groups of spectral lines, by kind."""
        kinds = {"excited": self.excited, "odd": self.odd, "even": self.even, "other": self.other}
        return {kind: group for kind, group in kinds.items() if group is not None}


@dataclass(frozen=True)
class Validation:
    """How well the model predicts the motion, per joint. Quantities that were not checked are None.

    held_out_rms: open-loop prediction error of a held-out multisine, encoder noise included, relative to the motion's
    RMS (the verdict excludes the noise); if friction has changed since the fitted multisine, the model's friction is
    scaled by one factor per joint, estimated from the held-out motion itself. held_out_as_fitted_rms: the same error
    with the friction of the fitted multisine; None if friction has not changed. free_run_rms: open-loop prediction
    error of the fitted multisine, also relative to the motion's RMS.
    residual_over_floor: residual relative to the measured noise, which is at least the rounding noise. correlated_lags:
    fraction of the residual's autocorrelations that exceed those of white noise. condition: condition number of the
    scaled information matrix.
    """

    held_out_rms: PerJoint | None = None
    held_out_as_fitted_rms: PerJoint | None = None
    free_run_rms: PerJoint | None = None
    residual_over_floor: PerJoint | None = None
    correlated_lags: PerJoint | None = None
    condition: float | None = None
    hardest_to_tell_apart: Confounded | None = None
    levels_ticks: Levels | None = None
    line_levels_ticks: LineLevels | None = None


@dataclass(frozen=True)
class Verdict:
    """The verdict on a result.

    trust: "yes", "with care" or "no". weakest: the least certain parameter. sentences: the reasons. first: what to
    correct or check before using the result; None if there is nothing to do.
    """

    trust: str
    weakest: str
    sentences: tuple[str, ...]
    first: str | None = None


@dataclass(frozen=True)
class TriedModel:
    """One of the friction models that were tried. If it could not be evaluated, held_out_rms and score are None."""

    model: str
    parameters: int
    held_out_rms: PerJoint | None
    score: float | None
    seconds: float


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """The model chosen with friction = "auto", and its benefit and cost.

    error_divided_by: prediction error of the model with the fewest parameters divided by that of the chosen one.
    standard_errors_times: factor by which the standard errors grew; None if standard errors were not compared.
    """

    chosen: str
    error_divided_by: float
    standard_errors_times: float | None = None
    tried: tuple[TriedModel, ...]

    @property
    def plainest(self) -> str:
        """Of the models that could be evaluated, the one with the fewest parameters."""
        judged = [trial for trial in self.tried if trial.score is not None]
        return min(judged, key=lambda trial: trial.parameters).model if judged else self.chosen


@dataclass(frozen=True)
class Quantiles:
    """Quantiles of a duration [us]."""

    p50: float
    p99: float
    p99_9: float
    max: float


@dataclass(frozen=True, kw_only=True)
class StreamTiming:
    """How well the stream kept its deadlines. seconds: duration [s]. rate_held: mean sample rate achieved [Hz].

    lateness_us: time from each deadline to its write. round_trip_us: time from the write to the last reply. drift_us:
    difference in lateness between the last and the first tenth of the writes. servo_clock_ppm: how much faster each
    servo's clock runs than the computer's; None if it was read too rarely.
    """

    samples: int
    seconds: float
    rate_held: float
    lateness_us: Quantiles
    round_trip_us: Quantiles
    missed_ticks: int
    lost_replies: int
    drift_us: float
    servo_clock_ppm: tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Duration of the estimation [s], which is ignored when results are compared."""

    estimation_seconds: float = field(compare=False)


@dataclass(frozen=True, kw_only=True)
class RunTiming(Timing, StreamTiming):
    """Timing of a recording and of its estimation."""

    @classmethod
    def of(cls, stream: StreamTiming, estimation_seconds: float) -> "RunTiming":
        """Combine the timing of a stream with the duration of the estimation [s]."""
        kept = {each.name: getattr(stream, each.name) for each in fields(StreamTiming)}
        return cls(estimation_seconds=estimation_seconds, **kept)


@dataclass(frozen=True)
class ArmFacts:
    """Data needed to use the model: gravity in the plane of the arm [m/s^2], rest pose [rad], joints."""

    gravity: float
    rest_pose: PerJoint
    joints: tuple[JointFacts, ...]


@dataclass(frozen=True, kw_only=True)
class ChainFacts:
    """Data from a spatial arm's URDF that define its base parameters.

    urdf: file name, relative to the configuration. rotation, translation [m]: pose of each joint's frame in the
    previous link's frame. axis: joint axis in the joint's frame. gravity: gravity in the base frame [m/s^2]. groups:
    linear combination that each base parameter represents. from_prior: parameters that the recording barely constrains,
    taken from the URDF. held: joints of the URDF that are treated as fixed. doubts: warnings about implausible
    inertias.
    """

    urdf: str
    rotation: tuple[tuple[PerJoint, ...], ...]
    translation: tuple[PerJoint, ...]
    axis: tuple[PerJoint, ...]
    gravity: PerJoint
    groups: Mapping[str, str] = field(default_factory=dict)
    from_prior: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class PhysicalQuantity(Quantity):
    """A mass, centre of mass or inertia; known: whether it was given in [known]."""

    known: bool


@dataclass(frozen=True)
class Physical:
    """Masses, centres of mass and inertias, derived with the help of [known].

    not_told_apart: groups of quantities that cannot be separated unless another quantity is known.
    """

    quantities: Mapping[str, PhysicalQuantity]
    not_told_apart: tuple[tuple[str, ...], ...]
    doubts: tuple[str, ...]


@dataclass(frozen=True)
class StabiliserShare:
    """Torque of the stabiliser during the periods, per joint [N m]: RMS, peak, and the RMS of the total torque."""

    rms: PerJoint = field(metadata={"key": "rms_torque"})
    peak: PerJoint = field(metadata={"key": "peak_torque"})
    commanded_rms: PerJoint = field(metadata={"key": "commanded_rms_torque"})

    @property
    def share(self) -> PerJoint:
        """RMS of the stabiliser's torque relative to that of the total torque, per joint; can exceed 1."""
        return tuple(rms / max(whole, 1e-12) for rms, whole in zip(self.rms, self.commanded_rms, strict=True))

    def said(self, names: Sequence[str]) -> str:
        """A sentence about the stabiliser's contribution to the torque, with these joint names."""
        each = ", ".join(
            f"{name} {rms:.3f} of {whole:.3f} N m RMS ({100 * part:.0f} %, peak {peak:.3f})"
            for name, rms, whole, part, peak in zip(
                names, self.rms, self.commanded_rms, self.share, self.peak, strict=True
            )
        )
        return f"Torque from the stabiliser: {each}."


@dataclass(frozen=True)
class PlayedStep:
    """One step of a pilot on the way to full amplitude, with its predicted and measured peaks.

    The rows of predicted and measured peaks are the quantities of hil.dry_run.prediction.QUANTITIES; the columns are
    the joints. peak_torque: peak torque per joint [N m]. ended: why the run ended early; None if it did not.
    """

    name: str
    peak_torque: PerJoint
    predicted_median: tuple[PerJoint, ...]
    predicted_quantile_99: tuple[PerJoint, ...]
    seen: tuple[PerJoint, ...]
    within_quantile: bool
    ended: str | None = None


@dataclass(frozen=True, kw_only=True)
class Zeros:
    """Encoder zeros of one recording: true minus measured angle of each joint, with standard errors [rad]."""

    zero: PerJoint
    std: tuple[StandardError, ...]
    unit: str = "rad"
    recording: str | None = None
