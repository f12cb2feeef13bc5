"""Encoder errors: noise, and errors that are periodic over a turn.

In a magnetic encoder, an off-axis magnet causes an error with a period of one turn. A tilted magnet, or channels that
differ in amplitude or are not in quadrature, cause an error with a period of half a turn.
"""

import math
from random import Random
from typing import Annotated

from pydantic import Field

from hil.fakes.plants.arm import PI
from hil.fakes.servo.registers import TICKS_PER_TURN
from hil.toml_errors import Described

Ticks = Annotated[float, Field(ge=0, le=TICKS_PER_TURN / 4)]
Phase = Annotated[float, Field(ge=-2 * PI, le=2 * PI)]

_TURN_PER_TICK = math.tau / TICKS_PER_TURN


class Encoder(Described):
    """Errors of Present Position in encoder steps (ticks) before rounding; none by default.

    At the encoder angle t [rad] the reading is too high by once_ticks sin(t + once_phase) + twice_ticks sin(2 t +
    twice_phase).
    """

    noise_ticks: Ticks = Field(0.0, description="standard deviation of white noise [ticks]")
    once_ticks: Ticks = Field(0.0, description="amplitude of the error with one period per turn [ticks]")
    once_phase: Phase = Field(0.0, description="phase of the once-per-turn error where the encoder reads 0 [rad]")
    twice_ticks: Ticks = Field(0.0, description="amplitude of the error with two periods per turn [ticks]")
    twice_phase: Phase = Field(0.0, description="phase of the twice-per-turn error where the encoder reads 0 [rad]")

    @property
    def is_linear(self) -> bool:
        """Whether there is no periodic error."""
        return not (self.once_ticks or self.twice_ticks)

    def error(self, ticks: float) -> float:
        """Return the periodic error [ticks] at the angle where a perfect encoder would read `ticks`."""
        angle = ticks * _TURN_PER_TICK
        return self.once_ticks * math.sin(angle + self.once_phase) + self.twice_ticks * math.sin(
            2.0 * angle + self.twice_phase
        )


PERFECT = Encoder()


class Reading:
    """One servo's encoder, including its noise generator."""

    def __init__(self, encoder: Encoder, seed: str) -> None:
        self._encoder = encoder
        self._noise = Random(seed) if encoder.noise_ticks else None
        self.is_perfect = encoder == PERFECT
        """Whether the encoder's only error is rounding."""

    def steady(self, ticks: float) -> float:
        """Return the reading [ticks] without noise, before rounding, if a perfect encoder would read `ticks`."""
        return ticks if self._encoder.is_linear else ticks + self._encoder.error(ticks)

    def sample(self, ticks: float) -> float:
        """Return one reading [ticks] with noise, before rounding, if a perfect encoder would read `ticks`."""
        read = self.steady(ticks)
        return read if self._noise is None else read + self._noise.gauss(0.0, self._encoder.noise_ticks)
