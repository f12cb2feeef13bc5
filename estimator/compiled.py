"""Compiled loops whose cache notices a change in any source that is compiled into them.

numba keeps compiled code beside the source and looks at the date of that one file. What a loop inlines from other
modules, and the constants it takes from them, may then be older than the sources: fits would continue with outdated
equations.
"""

import hashlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba

FOLDERS = ("models", "simulation", "chain")


def compiled(function: Callable[..., Any], **options: Any) -> Any:
    """`function` compiled without the interpreter's lock, cached on disk until a source in FOLDERS changes."""
    dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", **options)(function)
    # numba has no public name for this; without it the cache would look at one file's date only, as numba's does.
    on_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if on_file is not None:
        on_file._source_stamp = (on_file._source_stamp, sources_digest(Path(__file__).parent))
    return dispatcher


@cache
def sources_digest(estimator: Path) -> str:
    """Of the text of all sources that compiled loops are made of."""
    digest = hashlib.sha256()
    for path in sorted(path for folder in FOLDERS for path in (estimator / folder).glob("*.py")):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()
