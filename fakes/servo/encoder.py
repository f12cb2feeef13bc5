"""Encoder errors: noise, and errors that repeat every turn.

A magnetic encoder whose magnet sits off the shaft's axis errs once a turn; a tilted magnet, or channels that differ in
amplitude or are not in quadrature, err twice a turn.
"""

import math
from random import Random
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from hil.fakes.servo.registers import TICKS_PER_TURN

Ticks = Annotated[float, Field(ge=0, le=TICKS_PER_TURN / 4)]
Phase = Annotated[float, Field(ge=-math.tau, le=math.tau)]

_TURN_PER_TICK = math.tau / TICKS_PER_TURN


class Encoder(BaseModel):
    """Errors of Present Position, in encoder steps (ticks) before rounding; none unless given.

    With t the encoder's own angle [rad] it reads once_ticks sin(t + once_phase) + twice_ticks sin(2 t + twice_phase)
    too much.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    noise_ticks: Ticks = Field(0.0, description="standard deviation of white noise, sample by sample [ticks]")
    once_ticks: Ticks = Field(0.0, description="amplitude of the error that repeats once a turn [ticks]")
    once_phase: Phase = Field(0.0, description="its phase where the encoder reads 0 [rad]")
    twice_ticks: Ticks = Field(0.0, description="amplitude of the error that repeats twice a turn [ticks]")
    twice_phase: Phase = Field(0.0, description="its phase where the encoder reads 0 [rad]")

    @property
    def is_linear(self) -> bool:
        """Whether nothing repeats over the turn."""
        return not (self.once_ticks or self.twice_ticks)

    def error(self, ticks: float) -> float:
        """What repeats every turn, where the encoder should read `ticks` [ticks]."""
        angle = ticks * _TURN_PER_TICK
        return self.once_ticks * math.sin(angle + self.once_phase) + self.twice_ticks * math.sin(
            2.0 * angle + self.twice_phase
        )


PERFECT = Encoder()


class Reading:
    """One servo's encoder, with its noise."""

    def __init__(self, encoder: Encoder, seed: str) -> None:
        self._encoder = encoder
        self._noise = Random(seed) if encoder.noise_ticks else None
        self.is_perfect = encoder == PERFECT
        """Whether it does nothing but round."""

    def steady(self, ticks: float) -> float:
        """What it would read without noise, before rounding, where `ticks` is right."""
        return ticks if self._encoder.is_linear else ticks + self._encoder.error(ticks)

    def sample(self, ticks: float) -> float:
        """What it reads now, before rounding."""
        read = self.steady(ticks)
        return read if self._noise is None else read + self._noise.gauss(0.0, self._encoder.noise_ticks)
