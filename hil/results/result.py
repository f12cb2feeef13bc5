"""Results: the contents of result.json as frozen dataclasses.

schema, method, config, joints
parameters   the base parameters: value, std (null in the file if there is no information about it), unit
extra        further model terms (shape of the friction curve, lag of the drive): value, std, unit
covariance   of parameters and extra together, rows in the order of `names`
fit          residual in encoder steps, and the effect of encoder rounding
validation   open-loop prediction of another multisine and the fitted one, relative to the motion's RMS; residual
             relative to rounding, whiteness, conditioning; noise, distortion and model error in encoder steps
verdict      whether to trust the result, the weakest parameter, and the reasons as sentences
warnings     problems of the recording, as sentences
model_choice with friction = "auto": the models tried, the one chosen, its benefit and cost
timing       how well the stream kept its deadlines, and the duration of the estimation
arm          data needed to use the model: gravity, rest pose, and, for each joint, name, servo, mode, limits, torque
             per goal [N m/A, or N m/V in pwm mode]
chain        only for a spatial arm: its geometry, and the combination that each base parameter represents
truth        only on a fake arm: the base parameters it was built with, for the true torque constants of its motors
truth_scaled `truth` scaled to the torque constants in the file, as `parameters` are; only if the motors' own differ
physical     masses, centres and inertias, if [known] gives any quantity
stabiliser   with a stabiliser: its contribution to the torque
steps        with a pilot: predicted and measured peaks of each step
zeros, recordings, notes   only for recordings by other tools; notes: what was guessed, corrected or averaged
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from hil.results.display import as_html, as_text
from hil.results.json_form import FormError, from_json, to_json
from hil.results.parts import (
    ArmFacts,
    ChainFacts,
    Covariance,
    Fit,
    ModelChoice,
    Physical,
    PlayedStep,
    Quantity,
    RunTiming,
    SettledFit,
    ShootingFit,
    StabiliserShare,
    Timing,
    Validation,
    Verdict,
    Zeros,
)

__all__ = ["SCHEMA", "Result", "SettledResult", "ShootingResult", "result_from_json"]

SCHEMA = 1


@dataclass(frozen=True, kw_only=True, repr=False)
class Result:
    """The outcome of an identification. Fields are in the order of result.json.

    parameters, extra: quantities by name, in the order of `covariance.names`. truth: true values by name [SI].

    truth_scaled: `truth` scaled to the file's torque constants; None if scaling changes nothing.
    """

    schema: int = SCHEMA
    method: str
    config: str
    joints: int
    parameters: Mapping[str, Quantity]
    extra: Mapping[str, Quantity]
    covariance: Covariance
    fit: Fit
    validation: Validation = field(default_factory=Validation)
    verdict: Verdict | None = None
    warnings: tuple[str, ...] = ()
    model_choice: ModelChoice | None = None
    timing: Timing
    arm: ArmFacts | None = None
    chain: ChainFacts | None = None
    truth: Mapping[str, float] | None = None
    truth_scaled: Mapping[str, float] | None = None
    physical: Physical | None = None

    @property
    def quantities(self) -> dict[str, Quantity]:
        """`parameters` and `extra` together, by name."""
        return {**self.parameters, **self.extra}

    @property
    def values(self) -> dict[str, float]:
        """Values of all quantities by name [SI], without error bars."""
        return {name: found.value for name, found in self.quantities.items()}

    def to_json(self) -> dict[str, Any]:
        """The object stored in result.json, except that numbers may still be infinite or NaN (see hil.strict_json)."""
        described: dict[str, Any] = to_json(self)
        return described

    def __repr__(self) -> str:
        return as_text(self._title, self.quantities, self._sentences)

    def _repr_html_(self) -> str:
        return as_html(self._title, self.quantities, self.truth_scaled or self.truth or {}, self._sentences)

    @property
    def _title(self) -> str:
        trust = "" if self.verdict is None else f", trust this model: {self.verdict.trust}"
        return f"{self.joints}-joint arm of {self.config}{trust}; {self._residual}"

    @property
    def _residual(self) -> str:
        """The residual in encoder steps, or in mrad if their size is unknown."""
        if steps := ", ".join(f"{value:.3f}" for value in self.fit.residual_rms_ticks):
            return f"residual {steps} encoder steps RMS"
        angles = getattr(self.fit, "residual_rms_rad", ())
        if angles and all(map(math.isfinite, angles)):
            return f"residual {', '.join(f'{1e3 * value:.3g}' for value in angles)} mrad RMS"
        return "no position residual"

    @property
    def _sentences(self) -> list[str]:
        judged = [] if self.verdict is None else list(self.verdict.sentences)
        return [*judged, *(f"Warning: {warning}" for warning in self.warnings)]


@dataclass(frozen=True, kw_only=True, repr=False)
class SettledResult(Result):
    """Result of an estimate from the settled periods of a run."""

    # field(): without it, a redeclared field would keep the default of the base class.
    fit: SettledFit
    verdict: Verdict = field()
    timing: RunTiming
    arm: ArmFacts = field()
    stabiliser: StabiliserShare | None = None
    steps: tuple[PlayedStep, ...] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class ShootingResult(Result):
    """Result of multiple shooting on arbitrary motion: recordings by other tools, and runs without a settled period."""

    fit: ShootingFit
    zeros: tuple[Zeros, ...] | None = None
    recordings: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()


def result_from_json(value: Mapping[str, Any]) -> Result:
    """Convert the contents of a result.json to a result. Raises FormError."""
    fit = value.get("fit")
    shooting = isinstance(fit, dict) and "residual_rms_rad" in fit
    kind: type[Result] = ShootingResult if shooting else SettledResult
    found = from_json(kind, value)
    missing = [name for name in found.covariance.names if name not in found.quantities]
    if missing:
        raise FormError(f"has {missing[0]!r} in its covariance, but no such parameter")
    for row, (name, entries) in enumerate(zip(found.covariance.names, found.covariance.matrix, strict=False)):
        if any(variance < 0.0 for variance in entries[row : row + 1]):
            raise FormError(f"has a negative variance of {name!r} in its covariance")
    return found
