"""Random faults in runs of spatial arms; benchmarks/spatial/chain_faults.py draws hundreds."""

import pytest

from benchmarks.fault_campaign.arms import Setting
from benchmarks.fault_campaign.attack import Attack, Kind
from benchmarks.fault_campaign.draw import Drawn
from benchmarks.fault_campaign.judge import fed_by_another
from benchmarks.spatial.chain_faults import NAMES, figures, inject
from hil.fakes.bus.faults import Fault, FaultKind

SLOW = [pytest.param(first, 3, rate, marks=pytest.mark.slow) for first, rate in ((3000, 100), (3000, 200), (3003, 200))]
"""Of the first, CI has two injections of each arm, among them stops of both and one that can be lowered."""


@pytest.mark.long
@pytest.mark.parametrize(("first", "each", "rate"), [(3001, 2, 100), *SLOW])
def test_random_faults_end_safe_and_where_possible_lying(first: int, each: int, rate: int) -> None:
    outcomes = [inject(Setting(name, rate), seed) for name in NAMES for seed in range(first, first + each)]
    told = "\n\n".join(map(str, outcomes))
    counted = figures(outcomes)
    assert not any(counted[bad] for bad in ("misleading", "unreadable", "not_restored")), told
    assert not counted["unsafe"], told
    assert counted["lying"] == counted["could_command"] > 0, told


@pytest.mark.parametrize(
    ("apart", "chance", "at", "fed_until"), [(0.024, 1.0, 3.0, 5.0), (0.05, 1.0, 3.0, 0.0), (0.024, 0.5, 3.0, 0.0)]
)
def test_a_killed_program_is_not_blamed_for_watchdogs_that_nothing_lets_trip(
    apart: float, chance: float, at: float, fed_until: float
) -> None:
    killed = Attack(Kind.KILLED, 4.0, 4.0)
    other = Fault(kind=FaultKind.OTHER_MASTER, at=at, duration=9.0, probability=chance, amount=apart)
    assert max(0.0, fed_by_another(Drawn((killed,), (other,)), 5.0)[1]) == fed_until
    assert fed_by_another(Drawn((), (other,)), 5.0)[1] < 0.0, "it is not killed"
