"""`[experiment]`, `[joint_path]` and `[model]`: the excitation, how it is streamed, and the model terms to fit."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from hil.config.table import Angle, Range, Table
from hil.estimator.models.terms import OPTIONS, Drive, Friction
from hil.fakes.plants.arm import PI
from hil.unit_hints import in_other_units

MIN_RATE = 20
"""Lowest experiment.rate [Hz]."""

DRIFT = 5.0
"""Limit on slow drift between periods, as a multiple of experiment.settle_within."""


class ExperimentConfig(Table):
    """`[experiment]`: the excitation and how it is streamed."""

    rate: float = Field(ge=MIN_RATE, le=4000, description="samples per second")
    period: float = Field(gt=0, le=1000, description="s")
    band: Range | None = Field(
        None, description="Hz: lowest and highest frequency; the harmonics in between are divided among the joints"
    )
    lines: list[list[int]] | None = Field(None, description="excited harmonics of 1/period, one list per joint")
    detection: bool = Field(
        False, description="excite only some of the odd harmonics: the others reveal nonlinear distortion"
    )
    peak_torque: list[PositiveFloat] | None = Field(
        None, description="N m per joint; with pilot = true, found by dry runs"
    )
    pilot: bool = Field(
        False, description="start with a small pilot run, then raise peak_torque as far as the limits allow"
    )
    design: Literal["low_crest", "optimal"] = Field("low_crest", description='"optimal" minimises standard errors')
    ramp: float = Field(1.0, ge=0, le=60, description="s, torque ramp at start and end")
    rest: float = Field(0.5, ge=0, le=60, description="s, time without torque before the motion")
    warm_up: float = Field(
        0.0,
        ge=0,
        le=3600,
        description="s, how long to repeat the motion before the first recorded period, to warm up the joints",
    )
    settle_within: PositiveFloat = Field(
        0.01, lt=1, description="largest RMS difference between settled periods, relative to the motion's RMS"
    )
    max_settling_periods: int = Field(5, ge=1, le=100)
    periods: int = Field(1, ge=1, le=1000, description="number of settled periods to record")
    held_out: bool = Field(True, description="run a second multisine with different phases to validate the model")
    seed: int = Field(1, ge=0, le=2**63 - 1)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        samples = self.rate * self.period
        if abs(samples - round(samples)) > 1e-9 * samples:
            nearest = max(1, round(samples))
            raise ValueError(
                f"rate * period = {samples:g} must be a whole number of samples; the nearest valid value is "
                f"period = {nearest / self.rate:.12g}"
            )
        if (self.band is None) == (self.lines is None):
            raise ValueError("give either band or lines")
        if self.detection and self.band is None:
            raise ValueError(
                "detection = true chooses harmonics from experiment.band; with experiment.lines, omit some odd "
                "harmonics from the lists yourself"
            )
        if self.band is not None:
            low, high = self.band
            if not 0 < low < high < self.rate / 4:
                rule = f"must satisfy 0 < low < high < rate / 4 = {self.rate / 4:g} Hz"
                raise ValueError(f"band = [{low}, {high}]: {rule}{self._meant(self.band)}")
        for lines in self.lines or []:
            if not lines or len(set(lines)) != len(lines) or min(lines) < 1 or max(lines) > samples / 4:
                raise ValueError(f"lines: the harmonics in a list must be distinct and from 1 to {samples // 4:g}")
        return self

    def _meant(self, band: list[float]) -> str:
        """If the band is too high for the sample rate, suggest the unit in which it may have been given."""
        hint = in_other_units(band, "Hz", lambda line: 0.5 / self.period <= line < self.rate / 4)
        return f". {hint}" if hint and band[0] < band[1] else ""

    @property
    def drift_within(self) -> float:
        """Limit on the difference between periods for motion that is still drifting slowly after max_settling_periods.

        Like settle_within, it is relative to the motion's RMS. Warming grease, for example, makes the motion drift.
        """
        return DRIFT * self.settle_within

    @property
    def warm_up_periods(self) -> int:
        """Number of periods of the warm-up."""
        return math.ceil(self.warm_up / self.period - 1e-9)

    @property
    def samples(self) -> int:
        """Samples per period."""
        return round(self.rate * self.period)


class PathConfig(Table):
    """`[joint_path]`: the path that excites a spatial arm. The upper end of experiment.band limits its frequency."""

    centre: list[Angle] = Field(description="rad per joint: centre of the path")
    swing: list[Annotated[float, Field(gt=0, le=4 * PI)]] = Field(
        description="rad per joint: amplitude around the centre"
    )
    speed: list[Annotated[float, Field(gt=0, le=100)]] = Field(description="rad/s per joint: maximum speed")


class ModelConfig(Table):
    """`[model]`: the model terms that the estimator may use."""

    friction: Literal["auto"] | Friction = Field(
        "auto", description='"auto" also tries every term below and keeps those that the data support'
    )
    drive: Drive = "lag"
    presliding: bool = Field(False, description=OPTIONS["presliding"])
    asymmetry: bool = Field(False, description=OPTIONS["asymmetry"])
    ripple: bool = Field(False, description=OPTIONS["ripple"])
    cogging: bool = Field(False, description=OPTIONS["cogging"])
    zeros: bool = Field(False, description=OPTIONS["zeros"])
    torque_scale: bool = Field(False, description=OPTIONS["torque_scale"])
    saturation: bool = Field(False, description=OPTIONS["saturation"])
    cable: bool = Field(False, description=OPTIONS["cable"])
    encoder: bool = Field(False, description=OPTIONS["encoder"])
    lags: bool = Field(False, description=OPTIONS["lags"])
    base_tilt: bool = Field(False, description="tilt of a spatial arm's base, to the extent that gravity reveals it")

    @property
    def fixed_friction(self) -> Friction:
        """The friction model for fits without model selection: "stribeck" if the file says "auto"."""
        return "stribeck" if self.friction == "auto" else self.friction

    @model_validator(mode="after")
    def _auto_has_no_terms(self) -> Self:
        given = [option for option in OPTIONS if option != "torque_scale" and getattr(self, option)]
        if self.friction == "auto" and given:
            raise ValueError(
                f'friction = "auto" chooses {", ".join(given)} itself: remove them, or choose a friction model'
            )
        return self
