"""Request Linux real-time settings for the control loop, and report whether each was granted.

no garbage collection  Python's collector is off inside the loop, and existing objects are frozen
locked memory          mlockall: no page of this process is swapped in during a cycle
timer slack            the kernel may delay a wake-up by 1 ns instead of 50 us
short switch interval  another Python thread (the progress bar) releases the interpreter after 50 us, not 5 ms
real-time scheduling   SCHED_FIFO: only other real-time tasks may preempt the loop
own core               the loop stays on one core and keeps its caches; only together with SCHED_FIFO, because
                       otherwise a pinned loop has to wait for other tasks on its core

Scheduling, core and timer slack apply only to the calling thread. All settings are restored at the end.
"""

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from hil.drivers.clock import Clock, WallClock

PRIORITY = 20
"""Priority for SCHED_FIFO (1 to 99): above ordinary tasks, below the kernel threads (50) that serve the serial port."""

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_SWITCH_INTERVAL_S = 50e-6


class Granted(NamedTuple):
    """One requested real-time setting: whether it was granted, and if not, why and how to enable it."""

    name: str
    given: bool
    note: str = ""

    def __str__(self) -> str:
        return f"{self.name}: {'yes' if self.given else 'no'}{f' ({self.note})' if self.note else ''}"


@contextmanager
def real_time() -> Iterator[list[Granted]]:
    """Request all settings. Yields the list of settings and whether each was granted.

    Slow requests come first, before the priority is raised.
    """
    with ExitStack() as undo:
        yield [step(undo) for step in (_no_collection, _lock_memory, _timer_slack, _short_turns, _fifo, _own_core)]


@contextmanager
def on_time(clock: Clock) -> Iterator[list[Granted]]:
    """With a wall clock, act as `real_time` does. With a virtual clock, nothing is requested: nothing can be late."""
    if isinstance(clock, WallClock):
        with real_time() as granted:
            yield granted
    else:
        yield []


def _fifo(undo: ExitStack) -> Granted:
    name = "real-time scheduling"
    before, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        # RESET_ON_FORK: child processes must not inherit the priority.
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except OSError as error:
        return Granted(name, False, f"{error.strerror}; needs `ulimit -r {PRIORITY}` or root")
    undo.callback(os.sched_setscheduler, 0, before & ~os.SCHED_RESET_ON_FORK, parameter)
    return Granted(name, True, f"SCHED_FIFO, priority {PRIORITY}")


def _own_core(undo: ExitStack) -> Granted:
    name = "own core"
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        return Granted(name, False, "only with real-time scheduling")
    before = os.sched_getaffinity(0)
    # The last core, because interrupts are mostly handled by the first.
    core = max(before)
    try:
        os.sched_setaffinity(0, {core})
    except OSError as error:
        return Granted(name, False, str(error.strerror))
    undo.callback(os.sched_setaffinity, 0, before)
    return Granted(name, True, f"core {core} of {len(before)}")


def _lock_memory(undo: ExitStack) -> Granted:
    name = "locked memory"
    # ONFAULT locks pages when first touched instead of loading everything that is mapped, such as LLVM.
    refused = _libc("mlockall", _MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT)
    if refused:
        return Granted(name, False, f"{refused}; needs `ulimit -l unlimited` or root")
    undo.callback(_libc, "munlockall")
    return Granted(name, True)


def _timer_slack(undo: ExitStack) -> Granted:
    name = "timer slack"
    before = ctypes.CDLL(None).prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    refused = _libc("prctl", _PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if refused:
        return Granted(name, False, refused)
    undo.callback(_libc, "prctl", _PR_SET_TIMERSLACK, max(before, 1), 0, 0, 0)
    return Granted(name, True, "1 ns")


def _no_collection(undo: ExitStack) -> Granted:
    was_on = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    undo.callback(_restore_collection, was_on)
    return Granted("no garbage collection", True)


def _restore_collection(was_on: bool) -> None:
    gc.unfreeze()
    if was_on:
        gc.enable()


def _short_turns(undo: ExitStack) -> Granted:
    undo.callback(sys.setswitchinterval, sys.getswitchinterval())
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    return Granted("short thread switch interval", True, f"{_SWITCH_INTERVAL_S * 1e6:.0f} us")


def _libc(function: str, *arguments: int) -> str:
    """Call a function of the C library; return an error message, or an empty string on success."""
    call: Callable[..., int] = getattr(ctypes.CDLL(None, use_errno=True), function)
    if call(*map(ctypes.c_ulong, arguments)) == 0:
        return ""
    return os.strerror(ctypes.get_errno())
