"""SIGKILL in the middle of an experiment: only the servos' own watchdogs are left. benchmarks/kills.py does fifty."""

from pathlib import Path

from benchmarks.kills import kill_campaign


def test_a_killed_program_leaves_servos_that_stop_themselves(tmp_path: Path) -> None:
    kills = kill_campaign(2, tmp_path)
    assert kills
    assert all(kill.safe for kill in kills), kills
