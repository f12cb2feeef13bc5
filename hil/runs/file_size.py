"""Limits on file size, checked before anything is loaded.

A run folder may come from an untrusted source: a compressed archive of 12 MB can expand to 1.7 GB, and a header of 128
bytes can declare any number of rows.
"""

from pathlib import Path
from zipfile import BadZipFile, ZipFile

import numpy as np

from hil.errors import RunFolderError

MOST_ARCHIVE_BYTES = 512 * 2**20
"""Largest allowed total size of the arrays in a period.npz [bytes]: enough for hours of samples at 4 kHz."""

MOST_CSV_BYTES = 1024 * 2**20

MOST_COMPRESSED = 200.0
"""Largest plausible compression ratio of measured data."""


def check_archive(path: Path) -> None:
    """Raise RunFolderError if an .npz would expand to more than any real recording needs. Also raises OSError,
    BadZipFile.
    """
    with path.open("rb") as file:
        # ZipFile skips data before the archive; numpy would take the file for a pickle and advise loading it.
        if file.read(2) != b"PK":
            raise BadZipFile("it does not begin like an .npz file")
    with ZipFile(path) as archive:
        entries = archive.infolist()
    claimed, packed = sum(each.file_size for each in entries), sum(each.compress_size for each in entries)
    if claimed > MOST_ARCHIVE_BYTES or claimed > 2**20 + MOST_COMPRESSED * packed:
        raise RunFolderError(
            f"{path} would take {claimed / 2**20:.0f} MB of memory; a settled period takes at most "
            f"{MOST_ARCHIVE_BYTES / 2**20:.0f} MB. The file was not written by hil, and was not read."
        )


def check_array(path: Path) -> None:
    """Raise RunFolderError if an .npy declares more data than the file contains. Also raises OSError, ValueError."""
    with path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        start = file.tell()
    if dtype.hasobject:
        raise RunFolderError(f"{path} cannot be read as a recording: it holds Python objects, not numbers.")
    promised = dtype.itemsize * int(np.prod([int(each) for each in shape], dtype=object))
    held = path.stat().st_size - start
    if promised > held:
        raise RunFolderError(
            f"{path} cannot be read as a recording: its header declares {promised} bytes, but there are only {held}."
        )
