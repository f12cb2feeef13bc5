"""Three hundred faults over all phases of an experiment; the figure is benchmarks/faults.py with ten times as many."""

from random import Random

import pytest

from benchmarks.faults import PHASES, Campaign, inject, kinds, prepare

INJECTIONS = 300
PARTS = 2
"""Tests that share them out, so that they run side by side."""


@pytest.fixture(scope="module")
def campaign() -> Campaign:
    return prepare()


@pytest.mark.parametrize("part", range(PARTS))
def test_every_fault_in_every_phase_ends_safe_recorded_and_named(campaign: Campaign, part: int) -> None:
    every = [(kind, phase, seed) for seed in (100, 101) for phase in PHASES for kind in kinds()]
    chosen = Random(1).sample(every, INJECTIONS)[part::PARTS]
    outcomes = [inject(campaign, *each) for each in chosen]
    for wrong in ("unsafe", "beyond", "unreadable", "unnamed"):
        found = [f"{each.fault} in {each.phase}: {each.message[-300:]}" for each in outcomes if getattr(each, wrong)]
        assert not found, wrong
    assert len(outcomes) == INJECTIONS // PARTS
    stopped = sum(bool(each.message) for each in outcomes)
    assert 0.3 * len(outcomes) < stopped < 0.9 * len(outcomes), "it meets stops and runs that go on"
    assert {each.way.partition(",")[0] for each in outcomes if each.message} == {"planned", "passed"}
