"""The workers of a study: local cores, a running Dask scheduler, or a Slurm queue."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from hil import __version__
from hil.errors import ConfigError, MissingExtra
from hil.study.schema import EngineTable

if TYPE_CHECKING:
    from distributed import Client

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "HIL_THREADS"), "1"
)
"""Environment that limits each worker process to one thread in BLAS, numba and hil."""

_PACKAGES = ("numpy", "scipy", "numba", "distributed")
_CONNECT_S = 10.0
_MOST_DEATHS = 1000
"""Number of worker losses during one run before the run is abandoned; a machine may reboot several times."""


@contextmanager
def workers(engine: EngineTable, scheduler: str | None, count: int | None) -> Iterator["Client"]:
    """Connect to a Dask cluster; scheduler: None for this machine, "tcp://HOST:PORT", or "slurm".

    Raises MissingExtra without Dask, and ConfigError if no scheduler answers, there is no worker, or a worker has other
    versions.
    """
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise MissingExtra("hil study needs Dask: pip install 'hil[study]'.") from error
    dask.config.set({"distributed.scheduler.allowed-failures": _MOST_DEATHS, "distributed.worker.daemon": False})
    wanted = count or engine.workers or os.cpu_count() or 1
    with _cluster(engine, scheduler, wanted) as address:
        try:
            client = Client(address, timeout=f"{_CONNECT_S:g}s", set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler {scheduler}: no Dask scheduler answers there ({type(error).__name__}). Start one with "
                "`dask scheduler`, workers with `dask worker ADDRESS --nthreads 1`."
            ) from error
        with client:
            _check_versions(client, scheduler)
            yield client


@contextmanager
def _cluster(engine: EngineTable, scheduler: str | None, count: int) -> Iterator[Any]:
    """Start or find a cluster; yields what a client connects to, and closes what was started here."""
    memory = f"{engine.worker_memory_gib:g}GiB"
    if scheduler is None:
        from distributed import LocalCluster

        with LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            memory_limit=memory,
            env=ONE_THREAD,
            dashboard_address="127.0.0.1:0",
            host="127.0.0.1",
            silence_logs=50,
        ) as cluster:
            yield cluster
    elif scheduler == "slurm":
        try:
            from dask_jobqueue import SLURMCluster
        except ImportError as error:
            raise MissingExtra("--scheduler slurm needs dask-jobqueue: pip install 'hil[slurm]'.") from error
        prologue = [f"export {name}={value}" for name, value in ONE_THREAD.items()]
        with SLURMCluster(cores=1, processes=1, memory=memory, job_script_prologue=prologue) as cluster:
            cluster.scale(count)
            yield cluster
    else:
        yield scheduler


def _versions() -> dict[str, str]:
    """Versions in this process; Dask runs this function in the workers too."""
    return {"hil": __version__, **{name: version(name) for name in _PACKAGES}}


def _check_versions(client: "Client", scheduler: str | None) -> None:
    """Refuse workers with other package versions, which would give different numbers."""
    try:
        client.wait_for_workers(1, timeout=600 if scheduler == "slurm" else 60)
    except TimeoutError as error:
        raise ConfigError(f"The scheduler {scheduler or 'on this machine'} has no worker.") from error
    here = _versions()
    try:
        everywhere = client.run(_versions)
    except Exception as error:
        raise ConfigError(f"A worker cannot import hil ({error}): install hil {__version__} there.") from error
    for worker, there in everywhere.items():
        other = [f"{name} {there.get(name)} (here {mine})" for name, mine in here.items() if there.get(name) != mine]
        if other:
            raise ConfigError(f"Worker {worker} has {', '.join(other)}: install the same versions everywhere.")
