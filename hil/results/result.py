"""A result: result.json as one frozen dataclass.

schema, method, config, joints
parameters   the base parameters: value, std (null on file where the recording shows nothing of it), unit
extra        what the model needed beside them (friction's shape, drive's lag): value, std, unit
covariance   of parameters and extra together, rows in the order of `names`
fit          residual, in encoder steps, against the encoder's own rounding
validation   free prediction of another multisine and of this one, as fractions of the motion's RMS; residual against
             rounding, whiteness, conditioning; noise, distortion and model error in encoder steps
verdict      trust it or not, the weakest parameter, and why, in sentences
warnings     what looked wrong in the recording, in sentences
model_choice with friction = "auto": the models tried, the one chosen, what it gained and cost
timing       how the stream kept its ticks, and how long the estimation took
arm          what a model needs to be used: gravity, rest pose, and per joint name, servo, mode, limits, torque per
             goal [N m/A, or N m/V in pwm mode]
chain        only of an arm in space: its geometry, and what each base parameter is made of
truth        only on a fake arm: the base parameters it was built with
physical     masses, centres and inertias, where [known] says something
stabiliser   what it gave of the torque, where there was one
steps        with a pilot: what was predicted of each step, and what was seen
zeros, recordings, notes   only of recordings made elsewhere; notes: what was guessed, put right or averaged
"""

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
    """What an identification found, whatever it was estimated from. Fields in the order of result.json.

    parameters, extra: by name, in the order of `covariance.names`. truth: by name [SI].
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
    physical: Physical | None = None

    @property
    def quantities(self) -> dict[str, Quantity]:
        """`parameters` and `extra` together, by name."""
        return {**self.parameters, **self.extra}

    @property
    def values(self) -> dict[str, float]:
        """The same without error bars [SI]."""
        return {name: found.value for name, found in self.quantities.items()}

    def to_json(self) -> dict[str, Any]:
        """As result.json holds it; numbers that are not finite are still themselves (see hil.strict_json)."""
        described: dict[str, Any] = to_json(self)
        return described

    def __repr__(self) -> str:
        return as_text(self._title, self.quantities, self._sentences)

    def _repr_html_(self) -> str:
        return as_html(self._title, self.quantities, self.truth or {}, self._sentences)

    @property
    def _title(self) -> str:
        trust = "" if self.verdict is None else f", trust this model: {self.verdict.trust}"
        residual = ", ".join(f"{value:.3f}" for value in self.fit.residual_rms_ticks)
        return f"{self.joints}-joint arm of {self.config}{trust}; residual {residual} encoder steps RMS"

    @property
    def _sentences(self) -> list[str]:
        judged = [] if self.verdict is None else list(self.verdict.sentences)
        return [*judged, *(f"Warning: {warning}" for warning in self.warnings)]


@dataclass(frozen=True, kw_only=True, repr=False)
class SettledResult(Result):
    """From the settled periods of a run."""

    # field(): a redeclared field would keep the default of the class above.
    fit: SettledFit
    verdict: Verdict = field()
    timing: RunTiming
    arm: ArmFacts = field()
    stabiliser: StabiliserShare | None = None
    steps: tuple[PlayedStep, ...] | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class ShootingResult(Result):
    """From any motion, by multiple shooting: recordings made elsewhere, and runs without a settled period."""

    fit: ShootingFit
    zeros: tuple[Zeros, ...] | None = None
    recordings: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()


def result_from_json(value: Mapping[str, Any]) -> Result:
    """The result in an object of result.json's form; raises FormError."""
    fit = value.get("fit")
    shooting = isinstance(fit, dict) and "residual_rms_rad" in fit
    kind: type[Result] = ShootingResult if shooting else SettledResult
    found = from_json(kind, value)
    missing = [name for name in found.covariance.names if name not in found.quantities]
    if missing:
        raise FormError(f"has {missing[0]!r} in its covariance, which is not a parameter")
    return found
