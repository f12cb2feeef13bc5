"""The process from which others are forked: it has imported what they need, and never has a second thread.

    python -m tests.support.processes.server SOCKET MODULE...

A fork of a process with threads, such as the one that runs the tests, may wait forever for a lock that another thread
held. Here nothing is compiled and BLAS has one thread, so there is none.
"""

import atexit
import gc
import importlib
import io
import json
import os
import runpy
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

CODE = "-c"
"""In place of a module's name: the next word is the code to be run, as with `python -c`."""

MOST_BYTES = 1 << 20
"""Longer than any request: arguments and environment."""


def main() -> None:
    """Serve; in a forked process, do what `python -m` does with its words, and end as an interpreter ends."""
    control = socket.socket(fileno=int(sys.argv[1]))
    for name in sys.argv[2:]:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()  # otherwise each fork would search all of it for garbage, and copy it on the way
    code: Any = 0
    try:
        _run(*_asked(control))
    except SystemExit as ended:
        code = ended.code or 0
        if not isinstance(code, int):
            raise
    _end(code)


def _run(module: str, *words: str) -> None:
    if module.endswith(".py"):
        sys.argv, sys.path[0] = [module, *words], str(Path(module).parent)
        runpy.run_path(module, run_name="__main__")
    elif module == CODE:
        sys.argv = [CODE, *words[1:]]
        exec(compile(words[0], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.argv = ["", *words]
        runpy.run_module(module, run_name="__main__", alter_sys=True)


def _end(code: int) -> NoReturn:
    """End as an interpreter does, but without taking hundreds of modules apart, which takes 0.1 s.

    An exception, which it prints, and output that cannot be written, which changes its exit code, are left to it.
    """
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        sys.exit(code)
    os._exit(code & 0xFF)


def _asked(control: socket.socket) -> list[str]:
    """Answer the requests. Returns only in a forked process: its words."""
    control.send(b"ready")
    while True:
        data, descriptors = b"", list[int]()
        with suppress(KeyboardInterrupt, ConnectionError):  # Ctrl-C ends the tests, and they end this
            data, descriptors, _, _ = socket.recv_fds(control, MOST_BYTES, 3)
        if not data:
            os._exit(0)
        request: dict[str, Any] = json.loads(data)
        if "reap" in request:
            child, status = os.waitpid(request["reap"], os.WNOHANG)
            control.send(json.dumps(os.waitstatus_to_exitcode(status) if child else None).encode())
            continue
        child = os.fork()
        if not child:
            control.close()
            _become(request, descriptors)
            return list(request["words"])
        for each in descriptors:
            os.close(each)
        control.send(json.dumps(child).encode())


def _become(request: dict[str, Any], descriptors: list[int]) -> None:
    """Give this process the standard streams, session, folder and environment of the one that was asked for."""
    if request["session"]:
        os.setsid()
    for number, (each, name) in enumerate(zip(descriptors, ("stdin", "stdout", "stderr"), strict=True)):
        os.dup2(each, number)
        os.close(each)
        stream = _opened(number, name, getattr(sys, name))
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    added = request["environment"].get("PYTHONPATH", "")
    sys.path[:1] = [str(request["folder"]), *filter(None, added.split(os.pathsep))]


def _opened(number: int, name: str, like: Any) -> io.TextIOWrapper:
    """A standard stream, made as an interpreter makes it when it starts. like: this process's own."""
    unbuffered = bool(number) and like.write_through
    raw: Any = io.FileIO(number, "w" if number else "r", closefd=False)
    raw.name = f"<{name}>"
    buffer = raw if unbuffered else io.BufferedWriter(raw) if number else io.BufferedReader(raw)
    stream: Any = io.TextIOWrapper(
        buffer,
        encoding=like.encoding,
        errors=like.errors,
        newline="\n" if number else None,
        line_buffering=not unbuffered and (raw.isatty() or name == "stderr"),
        write_through=unbuffered,
    )
    stream.mode = raw.mode[0]
    return stream  # type: ignore[no-any-return]


if __name__ == "__main__":
    main()
