"""What the verdict says about the parameters when a model error has no known cause."""

from math import inf
from types import SimpleNamespace
from typing import Any

import pytest

from hil.estimator.models.conflicts import Trust
from hil.estimator.selection.verdict import _spoilt


@pytest.mark.parametrize(("trust", "said"), [("with care", "several standard errors are possible"), ("yes", "include")])
def test_standard_errors_are_not_called_bounds(trust: Trust, said: str) -> None:
    """An arm with backlash: "the others stay within 2 %" was said of a gravity_1 that was 2.7 % (2.1 of them) off."""
    validation: Any = SimpleNamespace(relative_std={"armature_1": inf, "coulomb_1": 0.03, "gravity_1": 0.0135})
    sentence = _spoilt(validation, trust)
    assert said in sentence and "coulomb_1 (3 %)" in sentence and "stay within" not in sentence
    assert "armature_1 (not determined)" in sentence and "inf" not in sentence
