"""Run independent jobs on the workers. Only a few jobs are submitted at a time, results are returned as they finish,
and the jobs of workers that die are repeated.
"""

import math
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Generic, TypeVar
from uuid import uuid4

from hil.errors import SchedulerLost
from hil.study.engine import workers
from hil.study.schema import EngineTable

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")

_AHEAD = 8
"""Number of jobs given to each worker in addition to its current one: enough to keep it busy, few enough to limit
memory use.
"""


_TASK_S, _MOST_IN_A_TASK = 0.1, 50
"""Target duration of a task [s] and largest number of jobs in it. Jobs are combined because each task has an overhead
of a few ms.
"""


_COUNTED_EVERY_S = 1.0
"""Interval at which the scheduler is queried for the number of workers."""


@dataclass(frozen=True)
class Ended(Generic[Item, Result]):
    """A job that has ended with a result or an error: an exception that it raised, or the loss of its workers."""

    number: int
    item: Item
    result: Result | None
    error: BaseException | None


def run_jobs(
    client: "Client", function: Callable[[Item], Result], items: Iterable[tuple[int, Item]]
) -> Iterator[Ended[Item, Result]]:
    """Call `function` on each item, on whichever worker is free; yield the jobs as they end.

    Args:
        client: a client from `hil.study.engine.workers`.
        function: must be importable by a worker, or picklable with everything it refers to.
        items: items, each with a number that identifies its job; consumed as workers become free.

    Raises:
        SchedulerLost: the scheduler no longer responds.
    """
    from distributed import as_completed

    try:
        flight = _Flight(client, function, iter(items))
        futures: Any = as_completed(flight.start(flight.room), loop=client.loop, with_results=True, raise_errors=False)
        for batch in futures.batches():
            futures.update(flight.start(len(batch) + max(0, flight.room)))
            for future, result in batch:
                if future.cancelled() or isinstance(result, CancelledError):
                    raise SchedulerLost(_LOST)
                again, ended = flight.end(future.key, result, lost=future.status == "error")
                future.release()
                futures.update(again)
                yield from ended
    except (CancelledError, OSError, TimeoutError) as error:
        raise SchedulerLost(_LOST) from error


class _Flight(Generic[Item, Result]):
    """Tasks in progress: one job each, or several if jobs are short compared with the overhead of a task."""

    def __init__(
        self, client: "Client", function: Callable[[Item], Result], waiting: Iterator[tuple[int, Item]]
    ) -> None:
        self._client = client
        self._function = function
        self._waiting = waiting
        self._size = 1
        self._submitted = 0
        # A scheduler has a single name space: two studies on it must not receive each other's results.
        self._name = f"job-{uuid4().hex[:12]}"
        self._tasks: dict[str, list[tuple[int, Item]]] = {}
        self._window, self._counted = 0, -math.inf

    @property
    def room(self) -> int:
        """Number of further tasks that may be submitted. Workers can join at any time; they get tasks once they have
        been counted.
        """
        if time.monotonic() - self._counted > _COUNTED_EVERY_S:
            workers = self._client.scheduler_info(n_workers=-1)["workers"]
            self._window, self._counted = max(1, len(workers)) * (1 + _AHEAD), time.monotonic()
        return self._window - len(self._tasks)

    def start(self, count: int) -> list[Any]:
        """Submit up to `count` further tasks while there are jobs left; return their futures."""
        taken = (list(islice(self._waiting, self._size)) for _ in range(count))
        return self._submit([jobs for jobs in taken if jobs])

    def _submit(self, tasks: list[list[tuple[int, Item]]]) -> list[Any]:
        if not tasks:
            return []
        keys = [f"{self._name}-{self._submitted + index}" for index in range(len(tasks))]
        self._submitted += len(tasks)
        self._tasks.update(zip(keys, tasks, strict=True))
        items = [[item for _, item in jobs] for jobs in tasks]
        futures: list[Any] = self._client.map(_call, [self._function] * len(tasks), items, key=keys, pure=False)
        return futures

    def end(self, key: str, result: Any, *, lost: bool) -> tuple[list[Any], list[Ended[Item, Result]]]:
        """Record the end of a task; return the futures of the jobs that are repeated, and the jobs that have ended."""
        jobs = self._tasks.pop(key)
        if lost and len(jobs) > 1:
            return self._submit([[job] for job in jobs]), []  # one of the jobs kills its worker: find out which
        if lost:
            return [], [Ended(*jobs[0], None, result[1])]
        outcomes, seconds = result
        self._size = max(1, min(_MOST_IN_A_TASK, int(_TASK_S * len(jobs) / max(seconds, 1e-6))))
        return [], [Ended(*job, *outcome) for job, outcome in zip(jobs, outcomes, strict=True)]


def _call(
    function: Callable[[Item], Result], items: list[Item]
) -> tuple[list[tuple[Result | None, Exception | None]], float]:
    """Called on a worker: return the result or error of each job, and their total duration [s]."""
    began, outcomes = time.perf_counter(), list[tuple[Result | None, Exception | None]]()
    for item in items:
        try:
            outcomes.append((function(item), None))
        except Exception as error:
            outcomes.append((None, error))
    return outcomes, time.perf_counter() - began


_LOST = "The scheduler no longer responds. Finished runs are kept: restart it, then continue with --resume."


def each(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    count: int | None = None,
    scheduler: str | None = None,
    tell: Callable[[Result], None] = lambda _: None,
) -> list[Result]:
    """The results of `function` on each item, in the items' order, computed by the workers of a study.

    Args:
        function: as for `run_jobs`.
        items: the argument of each call.
        count: number of workers; one per core unless given; 0 computes in this process.
        scheduler: as for `hil.study.engine.workers`.
        tell: called with each result as it arrives.

    Raises:
        Exception: the first that `function` raised.
        ConfigError, MissingExtra, SchedulerLost: as for `workers` and `run_jobs`.
    """
    found: dict[int, Any] = {}
    if count == 0:
        for number, item in enumerate(items):
            found[number] = function(item)
            tell(found[number])
        return list(found.values())
    with workers(EngineTable(), scheduler, count) as client:
        for ended in run_jobs(client, function, enumerate(items)):
            if ended.error is not None:
                raise ended.error
            found[ended.number] = ended.result
            tell(found[ended.number])
    return [found[number] for number in sorted(found)]
