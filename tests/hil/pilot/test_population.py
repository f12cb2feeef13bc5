"""Five arms of the population, covering all servo models and orientations, are identified without help."""

from pathlib import Path

import pytest

from benchmarks.population import figures, run

SEEDS = [7, 12, 15, 30, 34]
"""Seeds that cover all five models, all orientations, one and two joints, warm-up, and encoder noise and nonlinearity.
"""


@pytest.mark.long
def test_arms_that_nobody_chose_their_torque_for(tmp_path: Path) -> None:
    outcomes = [run(seed, tmp_path / str(seed), quick=True) for seed in SEEDS]
    measured = figures(outcomes)
    assert measured["failures"] == {}
    assert measured["beyond_limit"] == 0
    assert [outcome.seed for outcome in outcomes if outcome.trust == "yes" and outcome.wrong] == []
    assert {outcome.name.split("x")[1].split()[0].split("+")[0] for outcome in outcomes} == {
        "XM430-W350",
        "XM540-W270",
        "XL330-M288",
        "XC330-T288",
        "XL430-W250",
    }
