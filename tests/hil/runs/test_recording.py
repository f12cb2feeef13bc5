"""Recordings of killed runs, stopped runs, and runs on a full disk; closing needs no further disk space."""

import errno
import mmap
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hil.drivers.state import Slow, State
from hil.errors import RunFolderError
from hil.runs import recording
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
        assert reserved >= 100 * sample_type(2).itemsize, "all the space that may be needed was allocated at the start"
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
    with pytest.raises(RunFolderError, match=r"cannot be written: No space left on device\. Free some space"):
        Recorder(tmp_path / "samples.npy", 1, 10)
    monkeypatch.setattr(np, "save", full)
    recorder.close()
    assert len(np.load(tmp_path / "fine.npy")) == 0


@pytest.mark.parametrize("reason", ["", "limit exceeded"])
def test_samples_outlive_their_folder(tmp_path: Path, reason: str) -> None:
    """A run folder that is removed while it is written to: the samples are saved again, and the message says so."""
    path = tmp_path / "run" / "samples.npy"
    path.parent.mkdir()
    (path.parent / "config.toml").write_text("[port]", encoding="utf-8")
    with pytest.raises(ValueError if reason else RunFolderError) as caught, Recorder(path, 2, 100) as recorder:
        recorder.keep(7.0, Phase.REST, 0, -1, state(1))
        shutil.rmtree(path.parent)
        recorder.keep(8.0, Phase.REST, 0, -1, state(2))
        if reason:
            raise ValueError(reason)
    said = "\n".join((str(caught.value), *getattr(caught.value, "__notes__", ())))
    assert (
        said.startswith(reason)
        and "was removed or renamed" in said
        and f"2 samples have been saved again in {path.parent}" in said
    )
    assert reason or caught.value.exit_code == 1, "the input was right"
    assert (path.parent / "config.toml").read_text(encoding="utf-8") == "[port]"
    assert load_samples(path, 2)["deadline"].tolist() == [7.0, 8.0]


def test_samples_outlive_a_file_in_place_of_their_folder(tmp_path: Path) -> None:
    path = tmp_path / "run" / "samples.npy"
    path.parent.mkdir()
    with (
        pytest.raises(RunFolderError, match=r"1 samples have been saved again in .*run-saved"),
        Recorder(path, 2, 9) as recorder,
    ):
        recorder.keep(7.0, Phase.REST, 0, -1, state(1))
        shutil.rmtree(path.parent)
        path.parent.touch()
    assert load_samples(tmp_path / "run-saved" / "samples.npy", 2)["deadline"].tolist() == [7.0]


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
    for content, said in (
        (np.zeros(3), "is not a recording by this version"),
        (np.zeros(3, dtype=sample_type(1)), "the config.toml next to it are from different runs: 1 and"),
        (np.array([{}, None]), "it holds Python objects, not numbers"),
    ):
        np.save(path, content)
        with pytest.raises(RunFolderError, match=said):
            load_samples(path, 2)


def test_phases_are_numbered_as_in_recordings_made_before() -> None:
    names = [
        "NOT_RECORDED",
        "REST",
        "RAMP_IN",
        "PERIODIC",
        "RAMP_OUT",
        "COMING_TO_REST",
        "BRAKING",
        "LOWERING",
        "WARM_UP",
    ]
    assert [(phase.name, phase.value) for phase in Phase] == [(name, number) for number, name in enumerate(names)]


class AtOnce:
    """A background thread that does its work on request."""

    made: list["AtOnce"]

    def __init__(self, act: Callable[[int], None], most: int) -> None:
        self.act, self.most, self.patience = act, most, 0.0
        self.asked: list[int] = []
        AtOnce.made.append(self)

    def put(self, item: int) -> None:
        self.asked.append(item)
        self.act(item)

    def close(self, patience: float) -> None:
        self.patience = patience


def test_pages_are_mapped_a_chunk_ahead_by_the_background(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mapped: list[tuple[int, int, int]] = []
    kernel = SimpleNamespace(madvise=lambda start, size, advice: mapped.append((start.value, size.value, advice)))
    AtOnce.made = []
    monkeypatch.setattr(recording, "_libc", kernel)
    monkeypatch.setattr(recording, "Background", AtOnce)
    row = sample_type(2).itemsize
    chunk = (1 << 20) // row
    with Recorder(tmp_path / "samples.npy", 2, 2 * chunk + 5) as recorder:
        (background,) = AtOnce.made
        assert background.most == 4 and len(mapped) == 1, "the first chunk is mapped before the experiment"
        first = recorder._samples.ctypes.data
        for number in range(2 * chunk + 5):
            recorder.keep(0.0, Phase.REST, 0, -1, state(number))
            assert background.asked == [chunk * each for each in range(1, number // chunk + 2)]
    assert background.patience == 1.0
    starts = [first + chunk * row * each for each in range(3)]
    ends = [*starts[1:], first + (2 * chunk + 5) * row]
    assert len(mapped) == 3, "there is nothing beyond the last row"
    for (page, size, advice), start, end in zip(mapped, starts, ends, strict=True):
        assert page == start - start % mmap.PAGESIZE and page + size == end and advice == 23


def test_rows_larger_than_a_chunk_are_mapped_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    AtOnce.made = []
    monkeypatch.setattr(recording, "Background", AtOnce)
    monkeypatch.setattr(recording, "_CHUNK_BYTES", 1)
    with Recorder(tmp_path / "samples.npy", 2, 3) as recorder:
        recorder.keep(0.0, Phase.REST, 0, -1, state(0))
        recorder.keep(0.0, Phase.REST, 0, -1, state(1))
    assert AtOnce.made[0].asked == [1, 2]


def test_the_whole_file_is_reserved_and_an_empty_one_is_not_mapped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "posix_fallocate", lambda _, start, size: asked.append((start, size)))
    path = tmp_path / "samples.npy"
    recorder = Recorder(path, 2, 100)
    assert asked == [(0, path.stat().st_size)]
    recorder.close()
    assert recorder.samples.shape == (0,) and recorder.samples.dtype == sample_type(2)


def test_a_recording_closed_twice_is_not_touched_again(tmp_path: Path) -> None:
    path = tmp_path / "samples.npy"
    recorder = Recorder(path, 2, 9)
    recorder.keep(7.0, Phase.REST, 0, -1, state(1))
    recorder.close()
    path.unlink()
    recorder.close()
    assert not path.exists()


def test_small_files_are_saved_again_even_if_the_parent_is_gone_too(tmp_path: Path) -> None:
    path = tmp_path / "runs" / "run" / "samples.npy"
    path.parent.mkdir(parents=True)
    for name, size in (("small", 3 << 20), ("large", 5 << 20)):
        with (path.parent / name).open("wb") as file:
            file.truncate(size)
    with pytest.raises(RunFolderError, match="saved again"), Recorder(path, 2, 9) as recorder:
        recorder.keep(7.0, Phase.REST, 0, -1, state(1))
        shutil.rmtree(tmp_path / "runs")
    assert sorted(each.name for each in path.parent.iterdir()) == ["samples.npy", "small"]


def test_the_header_of_a_cut_recording_says_what_numpy_would_write(tmp_path: Path) -> None:
    path = tmp_path / "samples.npy"
    with Recorder(path, 2, 9) as recorder:
        recorder.keep(7.0, Phase.REST, 0, -1, state(1))
    with path.open("rb") as file:
        assert np.lib.format.read_magic(file) == (1, 0)
        assert np.lib.format.read_array_header_1_0(file) == ((1,), False, sample_type(2))
