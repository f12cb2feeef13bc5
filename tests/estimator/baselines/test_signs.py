"""Reversed columns are found and named; a recording with correct signs raises no suspicion."""

from dataclasses import replace

import numpy as np
import pytest

from hil.config.csv_columns import load_recording_config
from hil.estimator.baselines.signs import Signs, suspect_signs
from hil.estimator.data.recording import Recording
from hil.recordings.convert import convert
from hil.recordings.csv_file import read_csv_table
from tests.support.paths import CONFIGS, DATA


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Both joints driven, four and ten rad/s."""
    columns = load_recording_config(CONFIGS / "recordings" / "dfki_double_pendulum.toml").columns
    return convert(read_csv_table(DATA / "dfki_double_pendulum" / "c1_sinusoids_143601.csv"), columns).recordings[0]


def turned(recording: Recording, torque: tuple[int, int], position: tuple[int, int]) -> Recording:
    return replace(
        recording,
        torque=recording.torque * np.array(torque)[:, None],
        position=recording.position * np.array(position)[:, None],
    )


def test_right_signs_raise_no_suspicion(recording: Recording) -> None:
    assert suspect_signs([recording]) is None
    assert suspect_signs([turned(recording, (-1, -1), (-1, -1))]) is None, (
        "a mirrored arm is equivalent, so there is no evidence"
    )


@pytest.mark.parametrize(
    ("torque", "position"), [((1, -1), (1, 1)), ((-1, 1), (1, 1)), ((-1, -1), (1, 1)), ((1, 1), (1, -1))]
)
def test_a_reversed_column_is_named(recording: Recording, torque: tuple[int, int], position: tuple[int, int]) -> None:
    suspicion = suspect_signs([turned(recording, torque, position)])
    assert suspicion is not None
    assert suspicion.signs == Signs(torque, position)
    assert suspicion.residual <= suspicion.residual_given


def test_all_torques_reversed_shows_in_negative_inertia(recording: Recording) -> None:
    suspicion = suspect_signs([turned(recording, (-1, -1), (1, 1))])
    assert suspicion is not None
    assert any(name.startswith("inertia") for name in suspicion.impossible)


def test_the_words() -> None:
    assert Signs((1, -1), (1, -1)).reversed_columns == ("the torque of joint 2", "the position of joint 2")


def test_too_short_a_recording_says_nothing(recording: Recording) -> None:
    short = replace(
        recording,
        time=recording.time[:60],
        torque=recording.torque[:, :60],
        position=recording.position[:, :60],
    )
    assert suspect_signs([short]) is None
