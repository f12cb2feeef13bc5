from collections.abc import Callable
from pathlib import Path

import pytest

from hil.clearance.doubts import doubts
from hil.config.schema import load_config
from hil.config.varying_delay import varying_delay
from tests.support.paths import CONFIGS


@pytest.fixture
def said(tmp_path: Path) -> Callable[..., str]:
    def at(rate: float, name: str = "xl430_two_link", period: float = 100.0, band: str = "[0.1, 5.0]") -> str:
        text = (CONFIGS / f"{name}.toml").read_text(encoding="utf-8")
        for key, value in (("rate", rate), ("period", period), ("band", band)):
            start = text.index(f"\n{key} = ") + 1
            text = text.replace(text[start : text.index("\n", start)], f"{key} = {value}")
        path = tmp_path / "arm.toml"
        path.write_text(text, encoding="utf-8")
        config = load_config(path)
        found = varying_delay(config)
        assert (found in list(doubts(config))) == bool(found)
        return found

    return at


@pytest.mark.parametrize(
    ("rate", "beat", "choices"),
    [
        (333, "once a second", "250 or 500"),
        (331, "7 times", "250 or 500"),
        (167, "2 times", "125 or 200"),
        (90, "10 times", "50 or 100"),
        (999, "once a second", "500 or 1000"),
        (1001, "once a second", "1000"),
    ],
)
def test_a_slow_beat_is_named_with_rates_that_avoid_it(
    said: Callable[..., str], rate: int, beat: str, choices: str
) -> None:
    found = said(rate)
    assert beat in found
    assert found.endswith(f"such as {choices}.")
    for choice in choices.split(" or "):
        assert said(float(choice)) == ""


@pytest.mark.parametrize("rate", [250, 300, 320, 400, 500, 700, 1000])
def test_a_constant_delay_or_a_fast_beat_is_not_mentioned(said: Callable[..., str], rate: int) -> None:
    assert said(rate) == ""


def test_it_depends_on_the_band_and_on_the_drive_mode(said: Callable[..., str]) -> None:
    assert said(331, band="[0.1, 1.5]") == ""
    assert said(331, band="[0.1, 2.0]")
    assert said(333, "xm430_two_link") == ""
