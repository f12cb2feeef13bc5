"""Limits on file size, checked before anything is loaded.

A run folder may come from somebody else. A compressed archive of 12 MB can hold 1.7 GB, and a header of 128 bytes can
promise any number of rows: both are checked first.
"""

from pathlib import Path
from zipfile import ZipFile

import numpy as np

from hil.errors import RunFolderError

MOST_ARCHIVE_BYTES = 512 * 2**20
"""Of all arrays of a period.npz together: hours of samples at 4 kHz."""

MOST_CSV_BYTES = 1024 * 2**20

MOST_COMPRESSED = 200.0
"""Times that measured numbers can be compressed; more is no measurement."""


def check_archive(path: Path) -> None:
    """Raise RunFolderError where an .npz would take more memory than any recording's; raises OSError, BadZipFile."""
    with ZipFile(path) as archive:
        entries = archive.infolist()
    claimed, packed = sum(each.file_size for each in entries), sum(each.compress_size for each in entries)
    if claimed > MOST_ARCHIVE_BYTES or claimed > 2**20 + MOST_COMPRESSED * packed:
        raise RunFolderError(
            f"{path} would take {claimed / 2**20:.0f} MB of memory; a settled period takes at most "
            f"{MOST_ARCHIVE_BYTES / 2**20:.0f}. It is not a file written by hil and was not read."
        )


def check_array(path: Path) -> None:
    """Raise RunFolderError where an .npy promises more than the file holds; raises OSError, ValueError."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        start = file.tell()
    promised = dtype.itemsize * int(np.prod([int(each) for each in shape], dtype=object))
    held = path.stat().st_size - start
    if promised > held:
        raise RunFolderError(
            f"{path} cannot be read as a recording: its header declares {promised} bytes but it has {held}."
        )
