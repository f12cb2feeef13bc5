"""The interval of a friction curve is drawn only where it can be seen."""

import numpy as np

from hil.report.sections.friction import model_curve


def test_an_interval_narrower_than_the_line_is_said_and_not_drawn() -> None:
    at = np.linspace(-1.0, 1.0, 5)
    wide, said = model_curve(at, at, at - 0.1, at + 0.1)
    assert [each.name for each in wide] == ["95 % interval", "model"]
    assert not said
    narrow, said = model_curve(at, at, at - 1e-3, at + 1e-3)
    assert [each.name for each in narrow] == ["model"]
    assert "narrower than the line" in said
