"""The arm and the plan of every run in this folder."""

import pytest

from hil.config.schema import parse_config
from hil.plan.plan import Plan, make_plan
from tests.support.edits import replaced
from tests.support.paths import CONFIGS
from tests.support.stops.stopped_runs import SHORTER, Arm


@pytest.fixture
def arm(arm: Arm) -> Arm:
    return lambda *changes, **options: arm(*SHORTER, *changes, **options)


@pytest.fixture(scope="session")
def plan() -> Plan:
    """The plan of every run here, shared because designing it takes longer than playing it."""
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    text = text.replace("period = 10.0 ", "period = 2.0 ").replace("band = [0.1, 5.0]", "band = [0.5, 6.0]")
    text = replaced(text, *SHORTER)
    return make_plan(parse_config(text, CONFIGS)).first_segment()
