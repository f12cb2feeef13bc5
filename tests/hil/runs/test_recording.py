"""Recordings of killed runs, stopped runs, and runs on a full disk; closing needs no further disk space."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from hil.drivers.state import Slow, State
from hil.errors import RunFolderError
from hil.runs.recording import Phase, Recorder, load_samples, missed, sample_type

NAN = float("nan")


def state(number: int) -> State:
    n = float(number)
    return State(n, n + 0.5, (n, -n), (n + 1, -n), (n + 2, -n), (n + 3, -n), (0, 128), (False, True))


def test_what_is_kept_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "samples.npy"
    with Recorder(path, 2, 100) as recorder:
        recorder.keep(7.0, Phase.REST, 0, -1, state(1))
        slow = Slow((1.5, NAN), (12.0, NAN), (NAN, 40.0))
        recorder.keep(8.0, Phase.PERIODIC, 1, 3, state(2)._replace(slow=slow))
        recorder.keep(9.0, Phase.BRAKING, 1, -1, missed([0.5, 0.25], 11.0))
        assert len(recorder.samples) == recorder.count == 3
    rows = load_samples(path, 2)
    assert rows["deadline"].tolist() == [7.0, 8.0, 9.0]
    assert rows["time_before_write"].tolist() == [1.0, 2.0, 11.0] and rows["time_after_read"].tolist() == [
        1.5,
        2.5,
        11.0,
    ]
    assert rows["phase"].tolist() == [Phase.REST, Phase.PERIODIC, Phase.BRAKING]
    assert rows["segment"].tolist() == [0, 1, 1] and rows["period"].tolist() == [-1, 3, -1]
    assert rows["goal_current"].tolist() == [[1, -1], [2, -2], [0.5, 0.25]]
    assert rows["current"][1].tolist() == [3, -2] and np.isnan(rows["current"][2]).all()
    assert rows["velocity"][1].tolist() == [4, -2] and rows["position"][1].tolist() == [5, -2]
    assert rows["error"].tolist() == [[0, 128], [0, 128], [0, 0]]
    assert rows["missing"].tolist() == [[0, 1], [0, 1], [1, 1]]
    assert np.isnan(rows["servo_clock"][0]).all() and rows["servo_clock"][1][0] == 1.5
    assert rows["supply_voltage"][1][0] == 12.0 and rows["temperature"][1][1] == 40.0


@pytest.mark.parametrize("count", [0, 1, 99, 100])
def test_the_end_cuts_the_file_to_length_where_it_lies(tmp_path: Path, count: int) -> None:
    path = tmp_path / "samples.npy"
    with Recorder(path, 2, 100) as recorder:
        inode = path.stat().st_ino
        reserved = path.stat().st_blocks * 512
        assert reserved >= 100 * sample_type(2).itemsize, "all the room that may be needed was taken at the start"
        for number in range(count):
            recorder.keep(0.0, Phase.REST, 0, -1, state(number))
        held = recorder.samples
    assert path.stat().st_ino == inode and [each.name for each in tmp_path.iterdir()] == ["samples.npy"]
    assert len(np.load(path)) == count == len(load_samples(path, 2)) == len(recorder.samples)
    assert path.stat().st_size - count * sample_type(2).itemsize in range(64, 640), "the header and nothing else"
    assert recorder.samples["deadline"].shape == (count,)
    recorder.close()
    del held


def test_a_full_disk_at_the_start_is_said_and_one_at_the_end_needs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    recorder = Recorder(tmp_path / "fine.npy", 1, 10)
    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(RunFolderError, match="cannot be written: No space left"):
        Recorder(tmp_path / "samples.npy", 1, 10)
    monkeypatch.setattr(np, "save", full)
    recorder.close()
    assert len(np.load(tmp_path / "fine.npy")) == 0


def test_of_a_killed_run_the_rows_that_were_taken_are_there(tmp_path: Path) -> None:
    path = tmp_path / "samples.npy"
    recorder = Recorder(path, 2, 50)
    for number in range(5):
        recorder.keep(float(number), Phase.REST, 0, -1, state(number))
    assert load_samples(path, 2)["deadline"].tolist() == [0, 1, 2, 3, 4]
    recorder.close()


def test_many_chunks_of_pages(tmp_path: Path) -> None:
    count = 30_000  # 3.6 MB
    with Recorder(tmp_path / "samples.npy", 2, count) as recorder:
        for number in range(count):
            recorder.keep(float(number), Phase.REST, 0, -1, state(number))
    assert np.array_equal(load_samples(tmp_path / "samples.npy", 2)["deadline"], np.arange(count))


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "samples.npy"
    for content in (b"", b"\x93NUMPY\x01\x00", b"nonsense"):
        path.write_bytes(content)
        with pytest.raises(RunFolderError, match="cannot be read as a recording"):
            load_samples(path, 2)
    np.save(path, np.zeros(3))
    with pytest.raises(RunFolderError, match="does not have the row type of a recording of 2 joints"):
        load_samples(path, 2)
