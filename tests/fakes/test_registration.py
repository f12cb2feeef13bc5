"""The URL fake:// is only registered with pyserial when a fake is opened."""

from collections.abc import Iterator

import pytest
import serial

from hil import fakes
from hil.config.schema import port_url


@pytest.fixture
def handlers(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    untouched = [each for each in serial.protocol_handler_packages if each != fakes.__name__]
    monkeypatch.setattr(serial, "protocol_handler_packages", untouched)
    yield untouched


@pytest.mark.parametrize("url", ["/dev/ttyUSB0", "COM3", "socket://localhost:4000", "loop://"])
def test_the_way_to_a_real_arm_leaves_pyserial_as_it_is(url: str, handlers: list[str]) -> None:
    fakes.register_for(url)
    assert port_url(url) == url
    assert fakes.__name__ not in handlers


def test_a_fake_is_registered_once(handlers: list[str]) -> None:
    for _ in range(2):
        fakes.register_for("fake://configs/fake_two_link.toml")
    assert handlers.count(fakes.__name__) == 1
