"""The parts of a result. Lists per joint run from the base outwards; names are the keys of result.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from hil.arm_model import JointFacts
from hil.results.json_form import Spread

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
    std: Spread
    unit: str

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.value:.6g} +- {self.std:.2g}{unit}"


@dataclass(frozen=True)
class Covariance:
    """Of all parameters together; rows and columns in the order of `names`, units those of the parameters."""

    names: tuple[str, ...]
    matrix: tuple[tuple[Spread, ...], ...]

    def array(self) -> NDArray[np.float64]:
        """(names, names); infinite where nothing was seen of a parameter."""
        return np.array(self.matrix, dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """residual_rms_ticks: measured minus simulated position in encoder steps RMS, per joint."""

    residual_rms_ticks: PerJoint


@dataclass(frozen=True, kw_only=True)
class SettledFit(Fit):
    """Of settled periods. quantisation_floor_ticks: residual due to encoder rounding alone, in the same unit.

    periods: how many were averaged. correlation_time: samples over which the residual is correlated.
    """

    quantisation_floor_ticks: float
    samples_per_period: int
    periods: int
    model: str = ""
    outliers: int = 0
    correlation_time: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ShootingFit(Fit):
    """Of any motion, cut into segments. residual_rms_rad: the residual in rad RMS, per joint; residual_rms_ticks is
    empty where the encoders' resolution is not known."""

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
    """RMS per joint in encoder steps, all lines together."""

    excited_lines: PerJoint
    distortion: PerJoint
    noise: PerJoint
    period_scatter: PerJoint
    model_error: PerJoint


@dataclass(frozen=True)
class LineGroup:
    """Lines of one kind: how many, the motion on one of them and what the model leaves of it, encoder steps RMS."""

    lines: int
    motion: PerJoint
    left: PerJoint


@dataclass(frozen=True)
class LineLevels:
    """RMS of one line in encoder steps, by kind of line; None for a kind that the multisine does not have."""

    noise: PerJoint
    excited: LineGroup | None = None
    odd: LineGroup | None = None
    even: LineGroup | None = None
    other: LineGroup | None = None

    @property
    def groups(self) -> dict[str, LineGroup]:
        """The available groups, by kind."""
        kinds = {"excited": self.excited, "odd": self.odd, "even": self.even, "other": self.other}
        return {kind: group for kind, group in kinds.items() if group is not None}


@dataclass(frozen=True)
class Validation:
    """How well the model predicts, per joint; None where it was not checked.

    held_out_rms: error of the free prediction of another multisine, which was not fitted, over the motion's RMS;
    free_run_rms: the same of the fitted one. residual_over_floor: residual over what rounding and scatter leave.
    correlated_lags: share of the residual's autocorrelations that white noise would not have. condition: of the scaled
    information matrix.
    """

    held_out_rms: PerJoint | None = None
    free_run_rms: PerJoint | None = None
    residual_over_floor: PerJoint | None = None
    correlated_lags: PerJoint | None = None
    condition: float | None = None
    hardest_to_tell_apart: Confounded | None = None
    levels_ticks: Levels | None = None
    line_levels_ticks: LineLevels | None = None


@dataclass(frozen=True)
class Verdict:
    """trust: "yes", "with care" or "no". weakest: the least certain parameter. sentences: why, for a person."""

    trust: str
    weakest: str
    sentences: tuple[str, ...]


@dataclass(frozen=True)
class TriedModel:
    """One of the friction models that were tried. held_out_rms, score: None where it could not be judged."""

    model: str
    parameters: int
    held_out_rms: PerJoint | None
    score: float | None
    seconds: float


@dataclass(frozen=True, kw_only=True)
class ModelChoice:
    """With friction = "auto": the model chosen, what it gained over the first one and what it cost.

    error_divided_by: prediction error of the first model over that of the chosen one. standard_errors_times: how many
    times larger the standard errors became; None where that was not compared.
    """

    chosen: str
    error_divided_by: float
    standard_errors_times: float | None = None
    tried: tuple[TriedModel, ...]


@dataclass(frozen=True)
class Quantiles:
    """Of durations [us]."""

    p50: float
    p99: float
    p99_9: float
    max: float


@dataclass(frozen=True, kw_only=True)
class StreamTiming:
    """How the stream kept time. rate_held [Hz], seconds [s].

    lateness_us: from each deadline to its write. round_trip_us: from the write to the last reply. drift_us: how much
    later the last tenth of the writes was than the first. servo_clock_ppm: how much faster each servo's own clock runs
    than the computer's; None where it was read too seldom.
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
    """estimation_seconds: how long the estimation took [s]."""

    estimation_seconds: float


@dataclass(frozen=True, kw_only=True)
class RunTiming(Timing, StreamTiming):
    """Of a recording of this program and its estimation."""

    @classmethod
    def of(cls, stream: StreamTiming, estimation_seconds: float) -> "RunTiming":
        """Both together."""
        kept = {each.name: getattr(stream, each.name) for each in fields(StreamTiming)}
        return cls(estimation_seconds=estimation_seconds, **kept)


@dataclass(frozen=True)
class ArmFacts:
    """What is needed to use the model: gravity in the arm's plane [m/s^2], rest pose [rad], the joints."""

    gravity: float
    rest_pose: PerJoint
    joints: tuple[JointFacts, ...]


@dataclass(frozen=True, kw_only=True)
class ChainFacts:
    """Of an arm in space: what its URDF says, which its base parameters are relative to.

    urdf: the file's name, beside the configuration. rotation, translation [m], axis: of each joint's frame in that of
    the link before, and its axis in its own. gravity: in the base's frame [m/s^2]. groups: what each base parameter is
    made of. from_prior: those that the recording hardly determines, taken from the URDF. held: the URDF's joints
    that are taken as fixed. doubts: what is implausible about its inertias.
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
    """A mass, centre or inertia. known: [known] gave it."""

    known: bool


@dataclass(frozen=True)
class Physical:
    """Masses, centres and inertias, using [known]. not_told_apart: groups that need another known one."""

    quantities: Mapping[str, PhysicalQuantity]
    not_told_apart: tuple[tuple[str, ...], ...]
    doubts: tuple[str, ...]


@dataclass(frozen=True)
class StabiliserShare:
    """What the stabiliser did during the periods, per joint [N m]: RMS and peak of its torque, RMS of all torque."""

    rms: PerJoint = field(metadata={"key": "rms_torque"})
    peak: PerJoint = field(metadata={"key": "peak_torque"})
    commanded_rms: PerJoint = field(metadata={"key": "commanded_rms_torque"})

    @property
    def share(self) -> PerJoint:
        """The stabiliser's RMS over that of all torque, per joint; over 1 where the excitation worked against it."""
        return tuple(rms / max(whole, 1e-12) for rms, whole in zip(self.rms, self.commanded_rms, strict=True))

    def said(self, names: Sequence[str]) -> str:
        """In one sentence, for the joints of these names."""
        each = ", ".join(
            f"{name} {rms:.3f} of {whole:.3f} N m RMS ({100 * part:.0f} %, peak {peak:.3f})"
            for name, rms, whole, part, peak in zip(
                names, self.rms, self.commanded_rms, self.share, self.peak, strict=True
            )
        )
        return f"Share of torque from the stabiliser: {each}."


@dataclass(frozen=True)
class PlayedStep:
    """One run on the way from the pilot to full size. Rows are the quantities of hil.dry_run.prediction.QUANTITIES,
    columns the joints; peak_torque [N m]. ended: why it ended early, None where it did not.
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
    """Of one recording: true minus measured angle of each joint, with standard errors [rad]."""

    zero: PerJoint
    std: tuple[Spread, ...]
    unit: str = "rad"
    recording: str | None = None
