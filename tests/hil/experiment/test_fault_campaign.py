"""Three hundred random faults over every shipped configuration and rate; benchmarks/faults.py draws thousands."""

import pytest

from benchmarks.fault_campaign.arms import RATES, names, settings
from benchmarks.faults import campaign

INJECTIONS = 300
PARTS = 2
"""Tests that share them out, so that they run side by side."""

NOT_STABLE = "fake_inverted at 20 Hz"
NOT_SETTLED = "fake_horizontal at 20 Hz"
"""What cannot be played there at all: a spring in software 50 ms late, and an arm that nothing brings back."""


@pytest.mark.parametrize("part", range(PARTS))
def test_random_faults_end_safe_recorded_restored_and_named(part: int) -> None:
    chosen = settings()[part::PARTS]
    outcomes, left_out = campaign(chosen, INJECTIONS // PARTS, jobs=1)
    assert all(why.startswith((NOT_STABLE, NOT_SETTLED)) for why in left_out), left_out
    bad = [str(each) for each in outcomes if not each.is_good]
    assert not bad, f"{len(bad)} of {len(outcomes)}:\n" + "\n\n".join(bad)
    stopped = sum(each.code != 0 for each in outcomes)
    assert 0.3 * len(outcomes) < stopped < 0.9 * len(outcomes), "it meets stops and runs that go on"


def test_every_shipped_configuration_is_in_it_at_every_rate() -> None:
    assert {(each.name, each.rate) for each in settings()} == {(name, rate) for name in names() for rate in RATES}
    assert len(names()) >= 11
