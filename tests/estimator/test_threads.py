"""The number of threads used for independent work."""

import os

import pytest

from hil.estimator.threads import VARIABLE, thread_count


def test_a_core_each_unless_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert thread_count() == (os.cpu_count() or 1)
    assert thread_count(1) == 1
    monkeypatch.setenv(VARIABLE, "3")
    assert (thread_count(), thread_count(2)) == (3, 2)


@pytest.mark.parametrize("told", ["", "0", "-1", "many"])
def test_nonsense_changes_nothing(told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, told)
    assert thread_count() == (os.cpu_count() or 1)
