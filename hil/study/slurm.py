"""Workers as jobs of a Slurm queue, through dask-jobqueue."""

import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from hil.errors import ConfigError, MissingExtra

_ANSWERED_WITHIN_S = 30.0
_CLOSED_WITHIN_S = 10.0
_EVERY_S = 0.2


@contextmanager
def slurm_cluster(count: int, memory: str, environment: Mapping[str, str]) -> Iterator[Any]:
    """A Dask cluster whose `count` workers have been submitted to Slurm.

    Args:
        count: number of workers, each a job with one core.
        memory: memory of each worker, such as "2GiB".
        environment: environment variables of each worker.

    Raises:
        MissingExtra: dask-jobqueue is not installed.
        ConfigError: this machine cannot submit Slurm jobs, or the queue rejects them.
    """
    try:
        from dask_jobqueue import SLURMCluster
        from dask_jobqueue.slurm import SLURMJob
    except ImportError as error:
        raise MissingExtra("--scheduler slurm needs dask-jobqueue: pip install 'hil[slurm]'.") from error
    if shutil.which("sbatch") is None:
        raise ConfigError(
            "--scheduler slurm: sbatch was not found. Start the study on a machine that submits Slurm jobs."
        )
    answers: list[str | None] = []

    class Job(SLURMJob):  # type: ignore[misc]
        """Stores the queue's answer: dask-jobqueue only logs it, and waits for workers that never start."""

        async def _submit_job(self, script_filename: str) -> Any:
            try:
                answer = await super()._submit_job(script_filename)
            except (OSError, RuntimeError) as error:
                answers.append(str(error))
                raise
            answers.append(None)
            return answer

    class Cluster(SLURMCluster):  # type: ignore[misc]
        job_cls = Job

    prologue = [f"export {name}={value}" for name, value in environment.items()]
    try:
        cluster = Cluster(cores=1, processes=1, memory=memory, job_script_prologue=prologue)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise ConfigError(f"--scheduler slurm: dask-jobqueue cannot start: {error}") from error
    cluster.scale(count)
    try:
        _wait_for_answer(answers)
        yield cluster
    finally:
        with suppress(Exception):  # jobs that the queue refused fail again when they are cancelled
            cluster.close(timeout=_CLOSED_WITHIN_S)


def _wait_for_answer(answers: list[str | None]) -> None:
    """Wait for the queue's answer to the first submission. Raises ConfigError if the queue rejected it."""
    until = time.monotonic() + _ANSWERED_WITHIN_S
    while not answers and time.monotonic() < until:
        time.sleep(_EVERY_S)
    refusal = answers[0] if answers else None
    if refusal is not None:
        lines = [line for line in refusal.splitlines() if line.strip()] or ["no reason given"]
        raise ConfigError(f"--scheduler slurm: the queue rejected the workers: {lines[-1].strip()}")
