"""The workers of a study: local cores, a running Dask scheduler, or a Slurm queue."""

import logging
import os
import re
import sys
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

from hil import __version__
from hil.errors import ConfigError, MissingExtra
from hil.study.schema import EngineTable

if TYPE_CHECKING:
    from distributed import Client

__all__ = ["executor", "versions", "workers"]

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "HIL_THREADS"), "1"
)
"""Environment variables that limit each worker process to one thread in BLAS, numba and hil."""

_DASK: dict[str, Any] = {
    "distributed.worker.daemon": False,
    # Dask's own logs and profiles, which grow with every task for hours before they reach their maximum length.
    "distributed.worker.profile.enabled": False,
    "distributed.admin.log-length": 100,
    "distributed.admin.low-level-log-length": 100,
    "distributed.admin.system-monitor.log-length": 240,
}

_ADDRESS = re.compile(r"([a-z]+://)?[^\s/]+:\d{1,5}")

_PACKAGES = ("numpy", "scipy", "numba", "distributed")
_NO_DASK = "hil study needs Dask: pip install 'hil[study]'."
_CONNECT_S = 10.0
_MOST_DEATHS = 10
"""Number of worker losses after which a run counts as failed. A run that needs too much memory kills every worker that
attempts it.
"""


@contextmanager
def workers(engine: EngineTable, scheduler: str | None, count: int | None) -> Iterator["Client"]:
    """Connect to a Dask cluster. scheduler: None for this machine, "tcp://HOST:PORT", or "slurm".

    Raises MissingExtra if Dask is not installed, and ConfigError if no scheduler answers, there is no worker, or a
    worker has different versions of hil or of Python packages.
    """
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise MissingExtra(_NO_DASK) from error
    dask.config.set({**_DASK, "distributed.scheduler.allowed-failures": _MOST_DEATHS})
    _silence()
    wanted = count or engine.workers or os.cpu_count() or 1
    with _cluster(engine, scheduler, wanted) as address:
        try:
            client = Client(address, timeout=f"{_CONNECT_S:g}s", set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler {scheduler}: no Dask scheduler answers there ({type(error).__name__}). Start one with "
                "`dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`."
            ) from error
        with client:
            _check_versions(client, scheduler)
            yield client


def _silence() -> None:
    silent = ("distributed", "tornado", "asyncio")
    for name in [each for each in logging.root.manager.loggerDict if each.split(".")[0] in silent]:
        logging.getLogger(name).setLevel(logging.CRITICAL)


@contextmanager
def _cluster(engine: EngineTable, scheduler: str | None, count: int) -> Iterator[Any]:
    """Start or find a cluster and yield what a client connects to; afterwards, close whatever was started here."""
    memory = f"{engine.worker_memory_gib:g}GiB"
    if scheduler is None:
        with _local(count, memory) as cluster:
            yield cluster
    elif scheduler == "slurm":
        from hil.study.slurm import slurm_cluster

        with slurm_cluster(count, memory, ONE_THREAD) as cluster:
            yield cluster
    else:
        if not _ADDRESS.fullmatch(scheduler):
            raise ConfigError(f'--scheduler {scheduler}: give its address, such as tcp://HOST:8786, or "slurm".')
        yield scheduler


def _local(count: int, memory: str) -> Any:
    from distributed import LocalCluster

    try:
        return LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=memory,
            env=ONE_THREAD,
            dashboard_address="127.0.0.1:0",
            host="127.0.0.1",
            silence_logs=50,
        )
    except RuntimeError as error:
        raise ConfigError(
            f"The workers did not start ({error}). A script must start them under `if __name__ == "
            '"__main__":`, since each worker imports it; if memory is short, request fewer workers (--workers).'
        ) from error


@contextmanager
def executor(scheduler: str | None = None, count: int | None = None) -> Iterator[Executor]:
    """Yield the workers as a concurrent.futures executor, for `executor=` of a dry run or an estimate.

    Args:
        scheduler: as for `workers`.
        count: number of workers; one per core unless given.

    Raises:
        ConfigError, MissingExtra: as for `workers`.
    """
    with workers(EngineTable(), scheduler, count) as client:
        yield client.get_executor(pure=False)


def versions() -> dict[str, str]:
    """Versions of everything that affects numerical results, as installed where this function runs: here, or on a Dask
    worker.
    """
    return {"hil": __version__, **_package_versions()}


@cache
def _package_versions() -> dict[str, str]:
    python = f"{sys.version_info.major}.{sys.version_info.minor}"
    try:
        return {"python": python, **{name: version(name) for name in _PACKAGES}}
    except PackageNotFoundError as error:
        raise MissingExtra(_NO_DASK) from error


def _check_versions(client: "Client", scheduler: str | None) -> None:
    """Refuse workers with other package versions, since their results could differ."""
    try:
        client.wait_for_workers(1, timeout=600 if scheduler == "slurm" else 60)
    except TimeoutError as error:
        raise ConfigError(f"The scheduler {scheduler or 'on this machine'} has no workers.") from error
    here = versions()
    try:
        everywhere = client.run(versions)
    except Exception as error:
        raise ConfigError(f"A worker cannot import hil ({error}): install hil {__version__} there.") from error
    for worker, there in everywhere.items():
        other = [f"{name} {there.get(name)} (here {mine})" for name, mine in here.items() if there.get(name) != mine]
        if other:
            raise ConfigError(f"Worker {worker} has {', '.join(other)}: install the same versions everywhere.")
