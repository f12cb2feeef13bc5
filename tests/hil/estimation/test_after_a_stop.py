"""What is said after a stop: the next command is the one that was stopped, unless its recording can be estimated."""

from pathlib import Path

import pytest

import hil
from hil.experiment.guard import Guard
from tests.support.paths import CONFIGS


@pytest.mark.parametrize("command", ["identify", "record"])
def test_the_command_that_was_stopped_is_named_again(
    tmp_path: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Guard, "look", interrupted)
    with pytest.raises(KeyboardInterrupt) as caught:
        getattr(hil, command)(CONFIGS / "fake_two_link.toml", out=tmp_path / "run")
    notes = caught.value.__notes__
    assert f"hil {command} " in notes[-1] and "no period had settled" in notes[-2], notes
