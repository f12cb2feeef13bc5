"""Compiled loops whose cache is invalidated by a change in any source file compiled into them.

numba stores compiled code next to the source and only checks the date of that one file. Code inlined from other
modules, and constants taken from them, could therefore be older than their sources, and a fit would use outdated
equations.
"""

import hashlib
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numba

FOLDERS = ("models", "simulation", "chain")


def compiled(function: Callable[..., Any], sources: Sequence[Path] = (), **options: Any) -> Any:
    """Compile `function` without the GIL, cached on disk until `sources` or a file in FOLDERS change."""
    dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    own = [hashlib.sha256(path.read_bytes()).hexdigest() for path in sources]
    # numba has no public name for this; without it the cache would only check the date of one file, as numba's own
    # cache does.
    on_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if on_file is not None:
        on_file._source_stamp = (on_file._source_stamp, sources_digest(Path(__file__).parent), *own)
    return dispatcher


def only_version(dispatcher: Any) -> Any:
    """Return the machine code of a compiled function that has been called with arguments of one set of types.

    Calling it skips the lookup of the arguments' types, which takes 0.1 us per array: as long as a small loop itself.
    Use it only where the arguments' types never change. Without a compiler (NUMBA_DISABLE_JIT), and if there are
    several versions, the function is returned as it is.
    """
    versions = list(getattr(dispatcher, "overloads", {}).values())
    return versions[0].entry_point if len(versions) == 1 else dispatcher


@cache
def sources_digest(estimator: Path) -> str:
    """Return a hash of all source files in FOLDERS and their subfolders."""
    digest = hashlib.sha256()
    for path in sorted(path for folder in FOLDERS for path in (estimator / folder).rglob("*.py")):
        digest.update(path.relative_to(estimator).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()
