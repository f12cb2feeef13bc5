"""A forked process does what a new interpreter does, and ends as one ends."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.processes import forked

STATE = """
import json, os, pathlib, signal, sys, threading
handlers = [str(signal.getsignal(each)) for each in sorted(signal.valid_signals())]
streams = [
    (each.name, each.mode, each.encoding, each.errors, each.line_buffering, each.isatty(), os.fstat(number).st_mode)
    for number, each in enumerate((sys.stdin, sys.stdout, sys.stderr))
]
its = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
print(json.dumps([os.getcwd(), its, sys.argv, __name__, handlers, streams, threading.active_count()]))
print([os.getsid(0) == os.getpid(), os.getpgid(0) == os.getpid(), sorted(os.listdir("/proc/self/fd"))[:3]])
"""
ENDS = {
    "nothing said": "pass",
    "code": "raise SystemExit(3)",
    "large code": "raise SystemExit(256 + 7)",
    "message": "import sys; sys.exit('no')",
    "exception": "int('x')",
    "Ctrl-C that nobody handles": "raise KeyboardInterrupt",
    "signal": "import os, signal; os.kill(os.getpid(), signal.SIGTERM)",
    "at exit": "import atexit; atexit.register(print, 'end'); print('begin')",
    "thread": "import threading, time; threading.Thread(target=lambda: (time.sleep(0.1), print('end'))).start()",
    "child": "import os; os.fork() or os._exit(0); print(os.waitstatus_to_exitcode(os.wait()[1]))",
}


def both(words: list[str], **options: Any) -> list[subprocess.CompletedProcess[str]]:
    """The same words run by a new interpreter and by a forked process."""
    new = subprocess.run([sys.executable, *words], text=True, check=False, **options)
    return [new, forked.run(words, text=True, **options)]


@pytest.mark.parametrize("session", [False, True])
def test_it_finds_what_a_new_interpreter_finds(tmp_path: Path, session: bool) -> None:
    environment = {**os.environ, "ONLY_HERE": "1"}
    new, ours = both(
        [forked.CODE, STATE, "a b", "-c"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=tmp_path,
        env=environment,
        start_new_session=session,
    )
    assert ours.stdout == new.stdout and "ONLY_HERE" in ours.stdout
    assert ours.stderr == new.stderr == ""


@pytest.mark.parametrize("end", ENDS)
def test_it_ends_as_a_new_interpreter_ends(end: str) -> None:
    new, ours = both([forked.CODE, ENDS[end]], capture_output=True)
    assert (ours.returncode, ours.stdout) == (new.returncode, new.stdout)
    assert ours.stderr.splitlines()[-1:] == new.stderr.splitlines()[-1:]


def test_output_that_cannot_be_written_changes_the_code() -> None:
    with Path("/dev/full").open("w") as full:
        new, ours = both([forked.CODE, "print('lost')"], stdout=full, stderr=subprocess.PIPE)
    assert ours.returncode == new.returncode != 0


def test_it_can_be_stopped_killed_and_waited_for() -> None:
    with forked.start([forked.CODE, "import time; print('up', flush=True); time.sleep(60)"], stdout=-1) as process:
        assert process.stdout is not None and process.stdout.readline() == b"up\n"
        assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.01)
        process.kill()
        assert process.wait() == -signal.SIGKILL == process.poll()
    with pytest.raises(subprocess.TimeoutExpired):
        forked.run([forked.CODE, "import time; time.sleep(60)"], capture_output=True, timeout=0.1)
