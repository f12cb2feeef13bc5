"""Random faults in every bundled configuration and rate; benchmarks/faults.py draws thousands."""

import pytest

from benchmarks.fault_campaign.arms import RATES, names, settings
from benchmarks.fault_campaign.attack import Kind
from benchmarks.fault_campaign.campaign import Outcome
from benchmarks.faults import campaign, figures

INJECTIONS = 300

PERIOD_S = 1.2
"""Of the multisines: shorter than in the script's campaign, for the processor's sake."""

PARTS = 2
"""Number of tests that share them, so that they run side by side."""

NAMED = 0.95

SEEN_LATER = 0.05
"""Share of the injections at most whose time counts from when the fault could be seen, later than it began."""

LATE_AT_20_HZ, LATE_MS = frozenset({Kind.STRANGE_GOAL}), 250.0
"""Another program's goal between two samples is overwritten before the next status: only the motion shows it."""

NOT_STABLE = "fake_inverted at 20 Hz"
"""A setting that cannot be played: a software spring delayed by 50 ms."""


def is_known_as_late(outcome: Outcome) -> bool:
    is_slow = outcome.setting.rate == RATES[0] and outcome.verdict.late_ms <= LATE_MS
    return is_slow and bool(set(outcome.drawn.kinds) & LATE_AT_20_HZ)


@pytest.mark.parametrize("part", range(PARTS))
def test_random_faults_end_safe_recorded_restored_and_named(part: int) -> None:
    outcomes, left_out = campaign(settings()[part::PARTS], INJECTIONS // PARTS, jobs=1, period=PERIOD_S, even=False)
    assert all(why.startswith(NOT_STABLE) for why in left_out), left_out
    bad = [each for each in outcomes if each.verdict.unsafe and not is_known_as_late(each)]
    bad += [each for each in outcomes if each.beyond_limit or each.unreadable or each.not_restored]
    bad += [each for each in outcomes if each.verdict.misleading]
    assert not bad, "\n\n".join(map(str, bad))
    counted = figures(outcomes)
    assert counted["unnamed"] <= (1 - NAMED) * counted["stopped"]
    assert 0.3 * len(outcomes) < counted["stopped"] < 0.9 * len(outcomes), "it meets stops and runs that go on"
    assert counted["seen_later"] <= SEEN_LATER * len(outcomes)


def test_every_shipped_configuration_is_in_it_at_every_rate() -> None:
    assert {(each.name, each.rate) for each in settings()} == {(name, rate) for name in names() for rate in RATES}
    assert len(names()) >= 11
