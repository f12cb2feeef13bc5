"""What is said of settings that differ from those before the run."""

import pytest

from hil.drivers.joint import Joint
from hil.drivers.servo_model import servo_model
from hil.setup.changed_settings import changed_settings

SHOULDER, ELBOW = (Joint(name, number, servo_model("XM430-W350")) for number, name in ((1, "shoulder"), (2, "elbow")))
LIMIT = "Current Limit"


@pytest.mark.parametrize(("shoulder", "elbow"), [(298, 447), (596, 447), (298, 100)])
def test_a_servo_with_anothers_settings_may_have_its_id(shoulder: int, elbow: int) -> None:
    before = {(SHOULDER, LIMIT): 447, (ELBOW, LIMIT): 298}
    after = {(SHOULDER, LIMIT): shoulder, (ELBOW, LIMIT): elbow}
    assert "their IDs may have been swapped" in changed_settings(before, after)


@pytest.mark.parametrize(("before", "after"), [((447, 298), (447, 100)), ((447, 447), (447, 100)), ((0, 1), (1, 1))])
def test_one_that_differs_from_all_before_has_not(before: tuple[int, int], after: tuple[int, int]) -> None:
    settings = [dict(zip(((SHOULDER, LIMIT), (ELBOW, LIMIT)), each, strict=True)) for each in (before, after)]
    said = changed_settings(settings[0], settings[1])
    assert LIMIT in said and ("swapped" in said) == (before == (0, 1))
