"""Goals beyond a limit are clamped even if they are within one slew step of the former goal."""

from collections.abc import Callable

import pytest

from hil.config.schema import Config
from hil.experiment.command_limits import CommandLimits

Arm = Callable[..., Config]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_goal_just_beyond_its_limit_is_clamped(arm: Arm, sign: float) -> None:
    """The joints' limits are 1.2 and 0.8 A; a goal may change by 0.25 A from one cycle to the next."""
    commands = CommandLimits(arm())
    commands.holding([sign * 1.1, -sign * 0.7])
    assert commands.clamp([sign * 1.21, -sign * 0.81]) == [sign * 1.2, -sign * 0.8]
    assert commands.clamp([sign * 1.3, -sign * 0.7]) == [sign * 1.2, -sign * 0.7]
