"""The arm on which sessions are tested."""

from typing import Any

import pytest
import serial

from tests.support.bench import Bench


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Every opened port leads to the same arm."""
    made = Bench()
    opened = serial.serial_for_url

    def again(*args: Any, **kwargs: Any) -> Any:
        if made.port is None:
            made.take(opened(*args, **kwargs))
        elif not made.port.is_open:
            made.port.open()
        return made.port

    monkeypatch.setattr(serial, "serial_for_url", again)
    return made
