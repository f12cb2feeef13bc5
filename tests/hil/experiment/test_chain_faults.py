"""Random faults in runs of spatial arms; benchmarks/spatial/chain_faults.py draws hundreds."""

import pytest

from benchmarks.fault_campaign.arms import Setting
from benchmarks.spatial.chain_faults import NAMES, figures, inject

EACH = 6
FIRST = 3000
RATE = 200


@pytest.mark.long
def test_random_faults_end_safe_and_where_possible_lying() -> None:
    outcomes = [inject(Setting(name, RATE), seed) for name in NAMES for seed in range(FIRST, FIRST + EACH)]
    told = "\n\n".join(map(str, outcomes))
    counted = figures(outcomes)
    assert not any(counted[bad] for bad in ("misleading", "unreadable", "not_restored")), told
    assert not counted["unsafe"], told
    assert counted["lying"] == counted["could_command"] > 0, told
