"""What the stream concludes from the samples of several exchanges or periods, on a scripted bus."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from hil.config.schema import Config
from hil.drivers.state import State
from hil.dry_run.ensemble import Ensemble
from hil.errors import Cause, ExperimentError, SafetyStop
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.experiment import stream as module
from hil.experiment.stream import Stream
from hil.runs.recording import Phase, missed
from tests.support.stream.scripted_bus import JOINTS, Bus, Checks

Make = Callable[..., tuple[Stream, Bus, Checks]]


def at_rest(stream: Stream, bus: Bus, shown: Sequence[float]) -> str:
    """What the stream says at rest if the elbow reports these velocities [rad/s] while no position changes."""
    exchange, left = bus.exchange, iter(shown)

    def exchanging(goals: list[float], *, between: bool = False) -> State:
        return exchange(goals, between=between)._replace(velocity=(0.0, next(left)))

    bus.exchange = exchanging  # type: ignore[method-assign]
    with pytest.raises(ExperimentError) as stop:
        stream._rest()
    is_false = "one of the two readings is wrong" in str(stop.value)
    assert is_false == (isinstance(stop.value, SafetyStop) and stop.value.cause is Cause.FROZEN)
    return "false" if is_false else "moving"


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        ([*[0.0] * 8, 0.5, 0.5], "false"),  # the last two are enough
        ([*[0.0] * 9, 0.5], "moving"),
        ([*[0.0] * 7, 0.5, 0.0, 0.5], "moving"),  # one earlier sample: 3.3 encoder steps
        ([*[0.0] * 6, 0.5, 0.5, 0.0, 0.5], "false"),  # two: 6.5 steps
        ([0.5, *[0.0] * 5, 0.5, 0.0, 0.0, 0.5], "false"),
        ([0.5, *[0.0] * 8, 0.5], "moving"),
        ([*[0.09] * 9, 0.5], "moving"),  # slower than rest_velocity: no motion that could add up
        ([*[-0.5] * 2, *[0.0] * 7, -0.5], "false"),
    ],
)
def test_velocities_are_false_if_they_are_reported_twice_or_add_up_to_several_steps(
    make: Make, shown: list[float], said: str
) -> None:
    """One of 0.5 rad/s is worth 3.3 encoder steps at 100 Hz."""
    stream, bus, _ = make(rate=100.0, rest_samples=20)
    assert at_rest(stream, bus, [0.0] * 10 + shown) == said


def test_the_latest_change_tells_whether_grease_may_still_be_warming_up(make: Make) -> None:
    """While friction warms up, the motion changes by at most 25 % from period to period."""
    stream, _, _ = make()
    stream._correlation = lambda samples: 0.95  # type: ignore[method-assign]
    assert "while grease warms up" in stream._advice([0.9, 0.35, 0.3, 0.24], 8)
    assert "changes most" in stream._advice([0.9, 0.38, 0.32, 0.26], 8)


@pytest.mark.parametrize(("latest", "correlation"), [(0.3, 1.0), (0.1, -1.0)])
def test_the_changes_of_the_three_latest_periods_are_compared(make: Make, latest: float, correlation: float) -> None:
    """The elbow's amplitude is 0.1 and 0.2 rad in the two periods before; the shoulder moves as before."""
    stream, _, _ = make()
    shape = np.random.default_rng(1).standard_normal(8)
    for amplitude in (0.9, 0.5, 0.1, 0.2, latest):
        for angle in shape.tolist():
            still = missed([0.0] * JOINTS, 0.0)
            stream._recorder.keep(0.0, Phase.PERIODIC, 0, -1, still._replace(position=(-angle, amplitude * angle)))
    assert stream._correlation(8) == pytest.approx(correlation)


@pytest.mark.parametrize(
    ("is_chain", "given", "watched_as", "with_given"),
    [
        (False, "planar", "planar", True),
        (False, "chain", "chain", True),
        (True, "chain", "chain", True),
        (True, "planar", "chain", False),
    ],
)
def test_the_model_watched_is_that_of_the_arms_given_or_of_a_spatial_configuration(
    make: Make, monkeypatch: pytest.MonkeyPatch, is_chain: bool, given: str, watched_as: str, with_given: bool
) -> None:
    class Model(Checks):
        def __init__(self, *words: Any, **_: Any) -> None:
            super().__init__()
            self.arms = words[2]

    class ChainModel(Model): ...

    monkeypatch.setattr(module, "ModelWatch", Model)
    monkeypatch.setattr(module, "ChainWatch", ChainModel)
    monkeypatch.setattr(module, "WayDown", Checks)
    monkeypatch.setattr(Config, "is_chain", property(lambda _: is_chain))
    arms = object.__new__(ChainArms if given == "chain" else Ensemble)
    model: Any = make(arms=arms)[0]._model
    assert type(model) is (ChainModel if watched_as == "chain" else Model)
    assert model.arms is (arms if with_given else None)
