"""At a low rate, the short segments that are fitted first are made longer, so that they hold enough samples."""

import numpy as np
import pytest

from hil.estimator.data.recording import Recording
from hil.estimator.fit import multiple_shooting
from hil.estimator.models.model import Model


def test_short_segments_hold_enough_samples_at_20_hz(monkeypatch: pytest.MonkeyPatch) -> None:
    lengths: list[float] = []

    def posed(recordings: object, model: object, length: float, **_: object) -> object:
        lengths.append(length)
        if len(lengths) > 1:
            raise InterruptedError
        return type("Posed", (), {"coordinates": lambda *_: None})()

    monkeypatch.setattr(multiple_shooting, "Shooting", posed)
    time = np.arange(200) / 20.0
    recording = Recording(time, np.sin(time)[None, :], np.sin(time)[None, :], np.array([1e-3]), "held")
    with pytest.raises(InterruptedError):
        multiple_shooting.estimate_by_shooting([recording], Model(1, "coulomb", "delay"), np.ones(5), length=1.0)
    assert lengths == pytest.approx([1.0, 0.5])
