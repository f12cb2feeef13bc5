"""Arms of the population, covering all servo models and orientations, are identified without help."""

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.drawn_arms.population_arms import draw
from benchmarks.population import figures, outcome_of, run
from tests.support.edits import replaced

ALWAYS = {12: "XL430-W250"}
"""Seed and model of a hanging arm without current sensors, with encoder noise and ripple."""

SLOW = {30: "XC330-T288", 7: "XM430-W350", 15: "XL330-M288", 34: "XM540-W270"}
"""Seeds of the other models, two on arms that move in a horizontal plane and one on a tilted arm; one has a warming
gear.
"""


def test_an_arm_that_is_given_its_torque_is_judged(tmp_path: Path) -> None:
    """Without the pilot and its runs, which test_steps.py covers for one arm and the slow test for those below."""
    (seed,) = ALWAYS
    arm = draw(seed)
    given = (
        ("pilot = true", "peak_torque = [0.15]\nheld_out = false"),
        ("rate = 400.0", "rate = 100.0"),
        ("period = 10.0", "period = 4.0"),
        ("band = [0.1,", "band = [0.25,"),
        ('friction = "auto"', 'friction = "stribeck"'),
    )
    outcome = outcome_of(seed, replace(arm, toml=replaced(arm.toml, *given)), tmp_path)
    assert outcome.finished and outcome.steps == 1 and outcome.beyond == 0.0
    assert outcome.trust in {"yes", "with care"} and not outcome.wrong


@pytest.mark.slow
@pytest.mark.parametrize("models", [ALWAYS, SLOW], ids=["always", "slow"])
def test_arms_that_nobody_chose_their_torque_for(models: dict[int, str], tmp_path: Path) -> None:
    outcomes = [run(seed, tmp_path / str(seed), quick=True) for seed in models]
    measured = figures(outcomes)
    assert measured["failures"] == {}
    assert measured["beyond_limit"] == 0
    assert [outcome.seed for outcome in outcomes if outcome.trust == "yes" and outcome.wrong] == []
    assert {outcome.name.split("x")[1].split()[0].split("+")[0] for outcome in outcomes} == {*models.values()}
