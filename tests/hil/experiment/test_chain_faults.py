"""Random faults in runs of spatial arms; benchmarks/spatial/chain_faults.py draws hundreds."""

import pytest

from benchmarks.fault_campaign.arms import Setting
from benchmarks.fault_campaign.attack import Attack, Kind
from benchmarks.fault_campaign.draw import Drawn
from benchmarks.fault_campaign.judge import fed_by_another
from benchmarks.spatial.chain_faults import NAMES, figures, inject
from hil.fakes.bus.faults import Fault, FaultKind

EACH = 3
SLOW = [pytest.param(first, 200, marks=pytest.mark.slow) for first in (3000, 3003)]


@pytest.mark.long
@pytest.mark.parametrize(("first", "rate"), [(3000, 100), *SLOW])
def test_random_faults_end_safe_and_where_possible_lying(first: int, rate: int) -> None:
    outcomes = [inject(Setting(name, rate), seed) for name in NAMES for seed in range(first, first + EACH)]
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
