"""Three hundred faults over all phases of an experiment; the figure is benchmarks/faults.py with ten times as many."""

from random import Random

import pytest

from benchmarks.faults import PHASES, Campaign, Outcome, inject, kinds, prepare

INJECTIONS = 300


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return prepare()


@pytest.fixture(scope="module")
def outcomes(campaign: Campaign) -> list[Outcome]:
    every = [(kind, phase, seed) for seed in (100, 101) for phase in PHASES for kind in kinds()]
    return [inject(campaign, *each) for each in Random(1).sample(every, INJECTIONS)]


@pytest.mark.parametrize("wrong", ["unsafe", "beyond", "unreadable", "unnamed"])
def test_every_fault_in_every_phase_ends_safe_recorded_and_named(outcomes: list[Outcome], wrong: str) -> None:
    found = [f"{each.fault} in {each.phase}: {each.message[-300:]}" for each in outcomes if getattr(each, wrong)]
    assert not found
    assert len(outcomes) == INJECTIONS


def test_the_campaign_meets_stops_and_runs_that_go_on(outcomes: list[Outcome]) -> None:
    stopped = sum(bool(each.message) for each in outcomes)
    assert 0.3 * INJECTIONS < stopped < 0.9 * INJECTIONS
