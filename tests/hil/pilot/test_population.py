"""Arms of the population, covering all servo models and orientations, are identified without help."""

from pathlib import Path

import pytest

from benchmarks.population import figures, run

ALWAYS = {12: "XL430-W250"}
"""Seed and model of a hanging arm without current sensors, with encoder noise and ripple."""

SLOW = {30: "XC330-T288", 7: "XM430-W350", 15: "XL330-M288", 34: "XM540-W270"}
"""Seeds of the other models, two on arms that move in a horizontal plane and one on a tilted arm; one has a warming
gear.
"""


@pytest.mark.long
@pytest.mark.parametrize("models", [ALWAYS, pytest.param(SLOW, marks=pytest.mark.slow)], ids=["always", "slow"])
def test_arms_that_nobody_chose_their_torque_for(models: dict[int, str], tmp_path: Path) -> None:
    outcomes = [run(seed, tmp_path / str(seed), quick=True) for seed in models]
    measured = figures(outcomes)
    assert measured["failures"] == {}
    assert measured["beyond_limit"] == 0
    assert [outcome.seed for outcome in outcomes if outcome.trust == "yes" and outcome.wrong] == []
    assert {outcome.name.split("x")[1].split()[0].split("+")[0] for outcome in outcomes} == {*models.values()}
