"""Compiled loops whose disk cache is invalidated by any change in the code or constants compiled into them.

numba stores compiled code next to the source file and checks only that file's date. Functions and constants inlined
from other modules could therefore be older than their sources. So the cache is stamped with a hash of the loaded code.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from stat import S_ISDIR
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numba
import numpy as np

PACKAGE = __name__.split(".", maxsplit=1)[0]


def compiled(function: Callable[..., Any], **options: Any) -> Any:
    """Compile `function` to run without the GIL, and cache the result on disk until its code or constants change."""
    dispatcher = _cached(function, nogil=True, error_model="numpy", **options)
    # These attributes of numba are not public. Without a stamp, the cache would only check the date of one file, as
    # numba's own cache does.
    on_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if on_file is not None:
        on_file._source_stamp = code_digest(dispatcher)
    return dispatcher


def _cached(function: Callable[..., Any], **options: Any) -> Any:
    """Compile with a cache on disk, wherever this user may write; without one if that is nowhere."""
    compile_it: Any = numba.njit
    try:
        return compile_it(cache=True, **options)(function)
    except RuntimeError:  # neither next to the source file nor in the user's cache folder, as in many containers
        settings: Any = numba.config
        settings.CACHE_DIR = settings.CACHE_DIR or own_folder()
    try:
        return compile_it(cache=bool(settings.CACHE_DIR), **options)(function)
    except RuntimeError:  # the code is not in a file, as in a zipped wheel
        return compile_it(**options)(function)


def own_folder() -> str:
    """A folder below the temporary one that only this user may write to; "" if there is none.

    The cache contains code, so another user's folder must not be used.
    """
    user = getattr(os, "getuid", int)()
    folder = Path(tempfile.gettempdir()) / f"hil-compiled-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError:
        return ""
    is_own = S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077
    return str(folder) if is_own else ""


def inner(function: Any, **options: Any) -> Any:
    """Compile a function for use in compiled loops: it runs without the GIL and has no C wrapper."""
    compile_it: Any = numba.njit
    return compile_it(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)(function)


def embedded(function: Any, **options: Any) -> Any:
    """Compile as `inner` does, but without the wrapper for calls from Python; this saves an eighth of the compilation
    time.

    Only compiled code may call the result: a call from Python crashes the process.
    """
    return inner(function, no_cpython_wrapper=True, **options)


def only_version(dispatcher: Any) -> Any:
    """Return the machine code of a compiled function that has always been called with the same argument types.

    Calling it skips the lookup of the argument types, which takes 0.1 us per array. Use it only where these types never
    change. Without a compiler (NUMBA_DISABLE_JIT) or with several versions, the function is returned unchanged.
    """
    versions = list(getattr(dispatcher, "overloads", {}).values())
    return versions[0].entry_point if len(versions) == 1 else dispatcher


def code_digest(function: Callable[..., Any]) -> str:
    """Return a hash of the function's code and options, and of all code and constants of this package that it uses."""
    digest = hashlib.sha256()
    seen: set[Callable[..., Any]] = set()
    waiting = [function]
    while waiting:
        compiled_or_not = waiting.pop()
        if compiled_or_not in seen:
            continue
        seen.add(compiled_or_not)
        each = _plain(compiled_or_not)
        digest.update(_options(compiled_or_not).encode())
        digest.update(repr((each.__module__, each.__name__, each.__defaults__)).encode())
        for code in _codes(each.__code__):
            constants = [value for value in code.co_consts if not isinstance(value, CodeType)]
            digest.update(code.co_code + repr((code.co_names, code.co_varnames, constants)).encode())
        for name, value in _used(each):
            if isinstance(_plain(value), FunctionType):
                waiting.append(value)
            else:
                digest.update(f"{name} = {_shown(value)}".encode())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """Return the Python function from which a compiled one was made; return any other value unchanged."""
    return getattr(value, "py_func", value)


def _options(function: Any) -> str:
    """Return the options with which a function is compiled; empty if it is not compiled."""
    options = getattr(function, "targetoptions", {})
    return repr(sorted((name, sorted(each) if isinstance(each, set) else each) for name, each in options.items()))


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object, then the code objects of all functions and comprehensions in it."""
    yield code
    for value in code.co_consts:
        if isinstance(value, CodeType):
            yield from _codes(value)


def _used(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of the package's globals and module attributes that the function may use.

    Libraries are left out, since numba implements numpy's functions itself, and its cache depends on its own version.
    """
    names = sorted({name for code in _codes(function.__code__) for name in code.co_names})
    for name in names:
        value = function.__globals__.get(name)
        if isinstance(value, ModuleType):
            if value.__name__.startswith(PACKAGE):
                yield from ((each, getattr(value, each)) for each in names if hasattr(value, each))
        elif value is not None and _is_own(value):
            yield name, value
    for cell in function.__closure__ or ():
        yield "", cell.cell_contents


def _is_own(value: Any) -> bool:
    """Return whether a value is a constant or is defined in this package."""
    return not callable(value) or getattr(_plain(value), "__module__", "").startswith(PACKAGE)


def _shown(value: Any) -> str:
    """Return a string that identifies a constant uniquely."""
    return repr(value.tolist()) if isinstance(value, np.ndarray) else repr(value)
