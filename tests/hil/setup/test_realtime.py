"""Real-time settings: whatever was granted, everything is restored afterwards."""

import gc
import os
import sys
from contextlib import suppress

import pytest

from hil.setup.realtime import real_time


def settings() -> tuple[object, ...]:
    parameter = os.sched_getparam(0).sched_priority
    return os.sched_getscheduler(0), parameter, os.sched_getaffinity(0), gc.isenabled(), sys.getswitchinterval()


@pytest.mark.parametrize("fail", [False, True])
def test_everything_is_taken_back(fail: bool) -> None:
    before, frozen = settings(), gc.get_freeze_count()
    with suppress(ZeroDivisionError), real_time() as granted:
        assert not gc.isenabled()
        assert sys.getswitchinterval() < 1e-3
        assert [each.name for each in granted] == [
            "no garbage collection",
            "locked memory",
            "timer slack",
            "short thread switch interval",
            "real-time scheduling",
            "own core",
        ]
        assert all(each.given or each.note for each in granted)
        1 / (not fail)
    assert settings() == before
    assert gc.get_freeze_count() <= frozen


def test_what_is_not_permitted_is_said_and_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with real_time() as granted:
        *_, fifo, core = granted
        assert str(fifo) == "real-time scheduling: no (Operation not permitted; needs `ulimit -r 20` or root)"
        # Without SCHED_FIFO, a pinned loop would have to wait for other tasks on its core.
        assert not core.given
