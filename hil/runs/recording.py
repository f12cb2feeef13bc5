"""Samples written to disk as they are taken: a preallocated, memory-mapped `.npy` of a structured type.

The samples survive if the process is killed. A row whose phase is 0 has not been recorded.
"""

import contextlib
import ctypes
import mmap
import os
import struct
from collections.abc import Sequence
from enum import IntEnum
from io import BytesIO
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.drivers.state import State
from hil.errors import RunFolderError, not_written
from hil.runs.background import Background
from hil.runs.file_size import check_array

_CHUNK_BYTES = 1 << 20
_SMALL_BYTES = 4 << 20  # largest file next to the recording whose contents are kept in memory during the run
_POPULATE_WRITE = 23  # MADV_POPULATE_WRITE
_TOUCH_S = 1.0
_libc = ctypes.CDLL(None)


class Phase(IntEnum):
    """Phase of the experiment in which a sample was taken."""

    NOT_RECORDED = 0
    REST = 1
    RAMP_IN = 2
    PERIODIC = 3
    RAMP_OUT = 4
    COMING_TO_REST = 5
    BRAKING = 6
    LOWERING = 7
    WARM_UP = 8


def sample_type(joints: int) -> np.dtype[np.void]:
    """NumPy type of one row of a recording.

    It contains times [s], phase, segment and period of the experiment, and, for each joint, goal and measured current
    [A], velocity [rad/s], position [rad], the servo's error byte and whether its reply is missing (the measured values
    are then NaN). A few times a second, it also contains either the servo's clock [s] or its supply voltage [V] and
    temperature [degrees C], in turn; these are NaN in all other rows.
    """
    each = (joints,)
    return np.dtype(
        [
            ("deadline", "<f8"),
            ("time_before_write", "<f8"),
            ("time_after_read", "<f8"),
            ("phase", "u1"),
            ("segment", "u1"),
            ("period", "<i2"),
            ("goal_current", "<f8", each),
            ("current", "<f8", each),
            ("velocity", "<f8", each),
            ("position", "<f8", each),
            ("error", "u1", each),
            ("missing", "u1", each),
            ("servo_clock", "<f4", each),
            ("supply_voltage", "<f4", each),
            ("temperature", "<f4", each),
        ]
    )


class Recorder:
    """Records up to `capacity` samples in `path`. A context manager; on exit it truncates the file to the recorded
    rows.
    """

    def __init__(self, path: Path, joints: int, capacity: int) -> None:
        self._path = path
        front = f"<dddBBh{4 * joints}d{2 * joints}B"
        self._row = struct.Struct(f"{front}{3 * joints}f")
        # In most rows the last values are NaN: they are packed once, then copied.
        self._row_without_slow = struct.Struct(f"{front}{12 * joints}s")
        self._nothing_slow = (struct.pack(f"<{3 * joints}f", *[float("nan")] * (3 * joints)),)
        dtype = sample_type(joints)
        assert self._row.size == dtype.itemsize
        try:
            self._samples: NDArray[np.void] = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=(capacity,))
            _reserve(path)
            self._beside = _small_files(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                path.unlink()  # a part of it could not be reserved
            raise not_written(path, error) from error
        self._bytes = memoryview(self._samples.view(np.uint8).data)
        self._rows_a_chunk = max(1, _CHUNK_BYTES // self._row.size)
        self._touched = Background(self._touch, 4)
        self._next_chunk = 0
        self._touch(0)
        self.count = 0

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _traceback: object) -> None:
        try:
            self.close()
        except RunFolderError as lost:
            if error is None:
                raise
            error.add_note(str(lost))  # the reason for the end comes first

    @property
    def samples(self) -> NDArray[np.void]:
        return self._samples[: self.count]

    def keep(self, deadline: float, phase: Phase, segment: int, period: int, state: State) -> None:
        """Record one sample: its deadline [s], its phase, segment and period in the experiment, and the measured
        state.
        """
        count = self.count
        if count == self._next_chunk:
            self._next_chunk += self._rows_a_chunk
            self._touched.put(self._next_chunk)
        before, after, goal_current, current, velocity, position, error, missing, slow, _, _ = state
        row = self._row_without_slow if slow is None else self._row
        row.pack_into(
            self._bytes,
            count * row.size,
            deadline,
            before,
            after,
            phase,
            segment,
            period,
            *goal_current,
            *current,
            *velocity,
            *position,
            *error,
            *missing,
            *(self._nothing_slow if slow is None else chain(*slow)),
        )
        self.count = count + 1

    def close(self) -> None:
        """Truncate the file to the recorded rows; may be called repeatedly.

        Raises RunFolderError if this fails. If the file was removed or renamed in the meantime, its rows are first
        saved in a new file, together with the configuration and other files that were next to it when the recording
        began.
        """
        if self._bytes.nbytes == 0:
            return
        self._touched.close(_TOUCH_S)
        self._bytes.release()
        self._bytes = memoryview(b"")
        try:
            self._samples = _cut(self._path, self._samples, self.count)
        except (FileNotFoundError, NotADirectoryError):
            self._samples = self.samples.copy()
            lost = self._save_again()
        except OSError as error:
            lost = RunFolderError(
                f"{self._path} cannot be truncated to its {self.count} samples ({error.strerror}), "
                "but holds all of them."
            )
        else:
            return
        lost.exit_code = 1  # the input was valid
        raise lost from None

    def _save_again(self) -> RunFolderError:
        former = folder = self._path.parent
        said = f"{former} was removed or renamed while the run was being recorded"
        if former.exists() and not former.is_dir():
            folder = former.with_name(f"{former.name}-saved")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            np.save(folder / self._path.name, self._samples)
            for name, contents in self._beside.items():
                if not (folder / name).exists():
                    (folder / name).write_bytes(contents)
        except OSError as error:
            return RunFolderError(f"{said}, and its samples cannot be saved to a new file: {error.strerror}.")
        return RunFolderError(
            f"{said}. The run's {self.count} samples have been saved again in {folder}, with the configuration as it "
            "was when the recording began."
        )

    def _touch(self, first: int) -> None:
        """Map the pages of a chunk of rows before they are needed: the first write to a page can take 0.4 ms."""
        size = self._row.size
        chunk = self._bytes[first * size : (first + self._rows_a_chunk) * size]
        if not chunk.nbytes:
            return
        start = np.frombuffer(chunk, np.uint8).ctypes.data
        page = start - start % mmap.PAGESIZE
        # Kernels before 5.14 do not support this; the pages are then mapped by the writes themselves.
        _libc.madvise(ctypes.c_void_p(page), ctypes.c_size_t(start + chunk.nbytes - page), _POPULATE_WRITE)


def _small_files(path: Path) -> dict[str, bytes]:
    """Contents of the readable files next to the recording `path`, such as the configuration, by name."""
    found = {}
    for each in path.parent.iterdir():
        with contextlib.suppress(OSError):
            if each != path and each.is_file() and each.stat().st_size <= _SMALL_BYTES:
                found[each.name] = each.read_bytes()
    return found


def _cut(path: Path, samples: NDArray[np.void], count: int) -> NDArray[np.void]:
    """Truncate the file to `count` rows in place, without a copy or further disk space."""
    header = _header(samples.dtype, count, _header_size(path))
    with path.open("r+b") as file:
        # In this order the file is always a valid recording: rows beyond the header's count are ignored.
        file.write(header)
        file.flush()
        file.truncate(len(header) + count * samples.dtype.itemsize)
    # The former mapping must not be used beyond the new end of the file.
    return np.lib.format.open_memmap(path, mode="r+") if count else samples[:0].copy()


def _header_size(path: Path) -> int:
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        read(file)
        return file.tell()


def _header(dtype: np.dtype[np.void], count: int, size: int) -> bytes:
    """The header of an `.npy` with `count` rows, padded to `size` bytes."""
    written = BytesIO()
    np.lib.format.write_array_header_1_0(
        written, {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": (count,)}
    )
    text = written.getvalue()[10:].rstrip(b" \n")
    length = size - 10
    return written.getvalue()[:8] + length.to_bytes(2, "little") + text.ljust(length - 1) + b"\n"


def _reserve(path: Path) -> None:
    """Allocate the disk space: writing to a mapped page would kill the process if the disk were full."""
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)


def missed(goal_current: Sequence[float], now: float) -> State:
    """The sample for a missed deadline: the previous goals stay in effect, and nothing is measured."""
    nothing = (float("nan"),) * len(goal_current)
    return State(
        now, now, tuple(goal_current), nothing, nothing, nothing, (0,) * len(goal_current), (True,) * len(goal_current)
    )


def load_samples(path: Path, joints: int) -> NDArray[np.void]:
    """The recorded rows of a `samples.npy`, which may come from a process that was killed. Raises RunFolderError."""
    try:
        check_array(path)
        samples = np.load(path, allow_pickle=False, mmap_mode="r")
    except (OSError, ValueError, EOFError) as error:
        raise RunFolderError(f"{path} cannot be read as a recording: {str(error).rstrip('.')}.") from error
    expected = sample_type(joints)
    if samples.dtype != expected:
        count = samples.dtype["position"].shape if "position" in (samples.dtype.names or ()) else ()
        if count and count != (joints,):
            raise RunFolderError(
                f"{path} and the config.toml next to it are from different runs: {count[0]} and {joints} joints."
            )
        raise RunFolderError(f"{path} is not a recording by this version of hil: its columns differ.")
    recorded: NDArray[np.void] = samples[samples["phase"] != Phase.NOT_RECORDED]
    return recorded
