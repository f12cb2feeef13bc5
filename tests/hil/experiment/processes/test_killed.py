"""SIGKILL during an experiment: only the servos' own watchdogs remain.

benchmarks/safety/kills.py repeats it fifty times.
"""

from contextlib import nullcontext
from pathlib import Path

import pytest

from hil.config.schema import Config
from tests.support.stops import kills
from tests.support.stops.kills import Kill, fake_arm, kill_campaign

BUSY_S = 5.0


@pytest.mark.parametrize("kills_wanted", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_a_killed_program_leaves_servos_that_stop_themselves(tmp_path: Path, kills_wanted: int) -> None:
    # When the watchdogs trip is tested in virtual time: a busy computer may ask later.
    done = kill_campaign(kills_wanted, tmp_path, answered_before=BUSY_S)
    assert sum(kill.counts(BUSY_S) for kill in done) == kills_wanted
    unsafe = [kill for kill in done if not kill.safe]
    assert not unsafe, "\n".join(f"{kill.watchdogs} {kill.torque} {kill.goals} {kill.ended}" for kill in unsafe)


def test_a_kill_that_finds_current_or_an_armed_watchdog_is_not_safe() -> None:
    assert Kill([255, -1], [1, 1], [0, 0], 0.106).safe
    assert not Kill([255, 4], [1, 1], [0, 0], 0.106).safe
    assert not Kill([255, 255], [1, 1], [0, 3], 0.106).safe
    assert Kill([0, 255], [0, 1], [3, 0], 0.106).safe, "a goal without torque moves nothing"
    assert not Kill([255, 255], [1, 1], [0, 0], 0.130).counts()


def test_the_campaign_says_why_an_experiment_would_not_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    link = tmp_path / "arm"

    def wrong_pose(_: Path) -> Config:
        config = pty_config(link)
        return config.model_copy(update={"arm": config.arm.model_copy(update={"rest_pose": [0.0, 0.0]})})

    pty_config = kills.pty_config
    monkeypatch.setattr(kills, "pty_config", wrong_pose)
    monkeypatch.setattr(kills, "fake_arm", nullcontext)  # one arm serves all attempts, which change nothing
    with (
        fake_arm(link),
        pytest.raises(RuntimeError, match=r"0 of 3 kills count(.|\n)*'shoulder'.*arm\.rest_pose is 0\.000"),
    ):
        kill_campaign(1, tmp_path)
