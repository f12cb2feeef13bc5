"""Values far from the configuration's or from typical ones are named and lower the verdict."""

import numpy as np
import pytest

from hil.estimator.models.conflicts import conflict_sentences, conflicts, contradicted, lowered


@pytest.mark.parametrize(("ratio", "file_std", "found"), [(0.45, 0.14, True), (0.45, 0.4, False), (1.3, 0.14, False)])
def test_a_torque_ratio_is_compared_with_the_file(ratio: float, file_std: float, found: bool) -> None:
    names, value, std = ("inertia_1", "torque_scale_2"), np.array([1e-3, ratio]), np.array([1e-5, 0.01])
    seen = conflicts(names, value, std, {"torque_scale_2": file_std})
    assert [each.name for each in seen] == (["torque_scale_2"] if found else [])
    assert contradicted(seen, explained=True) == ("with care" if found else "")
    assert contradicted(seen, explained=False) == ("no" if found else "")
    if found:
        said = conflict_sentences(seen, explained=False)
        assert "torque_scale_2 is 0.45 +- 0.01" in said[0] and "torque_constant" in said[0]
        assert "identify again" in said[-1]


def test_an_uncertain_value_contradicts_nothing() -> None:
    names, value = ("torque_scale_2", "zero_2"), np.array([0.45, 0.3])
    assert not conflicts(names, value, np.array([0.4, np.inf]), {})
    assert [each.name for each in conflicts(names, value, np.array([0.4, 0.001]), {})] == ["zero_2"]


def test_what_is_only_typical_does_not_reject_a_result() -> None:
    seen = conflicts(("back_emf_1",), np.array([0.4]), np.array([0.01]), {})
    assert [contradicted(seen, explained=each) for each in (True, False)] == ["", "with care"]
    assert [lowered("yes", each) for each in ("", "with care", "no")] == ["yes", "with care", "no"]
    assert lowered("no", "with care") == "no"
